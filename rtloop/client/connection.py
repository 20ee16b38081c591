"""`rtloop.connect`: a running loop from Python and notebooks, over the control API."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtloop.client.control import Client
from rtloop.client.control_socket import find_control_socket
from rtloop.errors import ConfigError, RtloopError

if TYPE_CHECKING:  # Their import takes half a second, which only captures and retunings need.
    from rtloop.client.capture.conditions import Condition
    from rtloop.client.retuning import Proposal
    from rtloop.recording.load import Recording

RESPONSE_TIMES, RESPONSE_MARGIN_S = 3.0, 60.0
"""Longest wait for a response measurement: its duration times the first, plus the second."""


class Connection:
    """A connection to a running loop. Commands return the tick at which they took effect.

    The service records each command under the name of this connection, and the first command takes the lock. While
    another client holds the lock, the service accepts `stop` alone. As a context manager the connection releases the
    lock at its end. Every method raises UnavailableError if no service answers, HostRefusal for a server that is not
    trusted, and RtloopError with the service's message if it refuses.
    """

    def __init__(self, client: Client) -> None:
        """Use `client` for all requests; none is sent yet."""
        self._client = client

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, *_: object) -> None:
        """Release the lock; a refusal, or a service that has ended, is ignored."""
        with suppress(RtloopError):  # Another client may hold the lock, or the service may have ended.
            self.release()

    @property
    def status(self) -> dict[str, Any]:
        """The response of `/status`: among others `state`, `armed`, `faults` (sentences), `lock` (its holder, None if
        free), `recording`, `rate_hz`, `lateness_us`, and the newest signals: `tick`, `mode`, `trip` (causes) and
        `axes`, {axis: {signal: value}}. Without a loop, `recording` is {} and the keys after it are missing.
        """
        return self._client.get("/status")

    @property
    def configuration(self) -> dict[str, Any]:
        """The configuration of the running loop with all changes (`values`), the `folder` of its files, `name`,
        `rate_hz`, the `columns` of a record, and the paths of the shared `block` and of the `recordings`. Refused
        without a loop.
        """
        return self._client.get("/configuration")

    @property
    def metrics(self) -> str:
        """Metrics in Prometheus' text format."""
        return self._client.get("/metrics")

    def watch(self) -> Iterator[dict[str, Any]]:
        """Yield {state, faults, lock, measuring, recovery, tick, mode, trip, trip_reason, axes, condition}, each as in
        `status`, about 20 times a second, until the service ends. The keys from `tick` on are missing without a loop.
        """
        return self._client.watch()

    def take(self, emergency_key: str | None = None) -> dict[str, Any]:
        """Take the lock, or renew it. While another client holds it, refused without the emergency key; a wrong key is
        always refused.

        Returns the new holder: {name, since_unix_s: start, until_unix_s: end without a further command}, both times in
        s since 1970.
        """
        return self._client.lock(emergency_key)

    def release(self) -> None:
        """Release the lock, so that another client may drive; refused while another client holds it.

        A free lock stays free.
        """
        self._client.delete("/lock")

    def arm(self) -> None:
        """Allow the service to drive the outputs; none moves yet.

        Refused while tripped, and if python-control computes other figures of the loop.
        """
        self._client.post("/arm")

    def start(self) -> int:
        """Change to the configured mode. Returns the tick at which it took effect; refused as by `mode`."""
        return self._command("/start")

    def stop(self) -> int:
        """Ramp the outputs to their safe values and stay there; works for every client.

        Returns the tick at which the ramp begins, or a later one if the outputs ramp already.
        """
        return self._command("/stop")

    def mode(self, mode: str) -> int:
        """Change the mode bumplessly: "off", "raw", "feedforward" or "closed_loop". Returns the tick of the change.

        Any mode but "off" is refused while tripped, not armed, or while the service prepares the actuator.
        """
        return self._command("/mode", mode=mode)

    def reset(self) -> int:
        """Clear latched trips; the outputs stay off. Returns the tick of the reset; refused unless tripped."""
        return self._command("/reset")

    def reload(self) -> dict[str, list[str]]:
        """Let the service read its configuration file again and apply it to the running loop.

        Returns {changed: ["axis.NAME", …]}, the axes that changed; [] if none did. If the loop refuses one axis after
        others were changed, these stay changed, and the message names them.
        """
        return self._client.post("/reload")

    def setpoint(self, axis: str, um: float) -> int:
        """Hold the reference of an axis at a value, in µm (V in raw mode). Returns its first tick.

        Refused beyond limits and position interlock of the axis.
        """
        return self._command("/setpoint", axis=axis, value=um)

    def reference(self, axis: str, **settings: object) -> int:
        """Change the reference of an axis, as in [axis.reference]: `kind="sine", amplitude=5.0, frequency_hz=2.0`.

        Keys that are left out have their defaults. Returns the first tick of the new reference. Refused beyond the
        limits of the axis, and a constant reference also beyond its position interlock.
        """
        return self._command("/reference", axis=axis, reference=settings)

    def waveform(
        self,
        axis: str,
        samples: Iterable[float],
        command_um: Iterable[float] = (),
        *,
        hold_ticks: int = 1,
        repeat: bool = False,
    ) -> int:
        """Play samples (µm; V in raw mode) as the reference of an axis, each for `hold_ticks` ticks.

        `command_um`, as many values or none, is added to the command of a closed loop. With `repeat` the samples play
        until another reference is set, else the last sample is held. Returns the tick of the first sample.
        """
        body = {"axis": axis, "samples": _floats(samples), "hold_ticks": hold_ticks, "repeat": repeat}
        return self._command("/waveform", **body, command_um=_floats(command_um))

    def tune(self, axis: str, section: str, **values: object) -> int:
        """Change keys of [axis.SECTION], as in `tune("x", "controller", gain=0.012)`. The service verifies the changed
        law, then loads it bumplessly.

        `section` is "controller", "limits", "interlocks", "prefilter" or "model". Returns the tick of the load.
        """
        return self._command("/tune", axis=axis, section=section, values=values)

    def preview(self, axis: str, section: str, **values: object) -> dict[str, Any]:
        """Return {before, after}: figures of the axis's loop without and with a `tune`; changes nothing.

        Keys of each: crossover_hz, phase_margin_deg, gain_margin_db, modulus_margin, overshoot_percent, settling_ms,
        static_error_percent, tolerated_shift_percent ([down ≤ 0, up ≥ 0]: shifts of the resonance, %, between which the
        loop is stable), step ({t_ms, y: response to a step of 1 µm, µm}) and problems (sentences). All but `problems`
        are None for an unstable loop or a law that is not linear, and so is each figure that is not finite.
        """
        return self._client.post("/preview", {"axis": axis, "section": section, "values": values})

    def undo(self, axis: str) -> dict[str, Any]:
        """Undo the newest `tune`, `controller` or `swap` of an axis, or of the controller that it shares, bumplessly;
        the next call undoes the change before that. A `swap` counts as one change for each of its steps.

        Returns {tick, undone: the change in words}. Refused if no change is left since the start of the loop or the
        last reload, or if the axis that owns the shared controller has a newer change of another section.
        """
        return self._client.post("/undo", {"axis": axis})

    def controller(self, axis: str, controller: Mapping[str, object] | Path | str) -> int:
        """Load another controller: an [axis.controller] as a mapping, or this axis's one in a configuration file.

        The service verifies the controller, then loads it bumplessly. Returns the tick of the load. Raises
        InputFileError for a file that cannot be read, ConfigError for an invalid one or one without a controller for
        this axis.
        """
        section = controller if isinstance(controller, Mapping) else read_controller(Path(controller), axis)
        return self._command("/controller", axis=axis, controller=dict(section))

    def response(self, axis: str, *, duration_s: float = 6.0, **options: object) -> dict[str, Any]:
        """Measure the closed loop of an axis with multisines about the reference that it holds.

        Options: `amplitude_um` (largest added motion), `from_hz`, `to_hz`, `period_s`, `near_hz` (expected lightly
        damped mode), `resonance_only`, `gain_um`. Returns the object of `rtloop ctl response --json`, a dict, among
        others with `margins`, `resonance` and `gain` (None if not found or not measured), and `response`: lists with
        the open loop, `loop`, and `sensitivity` at each frequency, complex values as [real, imaginary]. After Ctrl-C
        the axis is set to its old reference, and LoopFault is raised.
        """
        body = {"axis": axis, "duration_s": duration_s, **options}
        return self._client.measure("/response", body, RESPONSE_TIMES * duration_s + RESPONSE_MARGIN_S)

    def learn(
        self,
        axis: str,
        samples: Iterable[float],
        *,
        cycles: int = 5,
        resonance_percent: float = 2.0,
        keep: bool = True,
    ) -> dict[str, Any]:
        """Play one period of a scan, `samples` (µm, a tick a sample), again and again: first unchanged, then in
        `cycles` cycles, each with a table that the error of the cycle before has corrected.

        Refused unless the error shrinks for every resonance within `resonance_percent` of the model's. Returns {cycles:
        [{rms_um, largest_um}, …], the error of each cycle; ended: reason; reference_um, command_um: lists of the best
        table}. The best table keeps playing unless `keep` is False; then the axis returns to its old reference. After
        Ctrl-C the axis holds its old reference, and LoopFault is raised.
        """
        body = {"axis": axis, "samples": _floats(samples), "cycles": cycles, "resonance_percent": resonance_percent}
        return self._client.measure("/learn", body | {"keep": keep})

    def retune(self, axis: str, **options: Any) -> Proposal:
        """Measure resonance and gain of an axis; return a proposal of taps for them. The taps stay until `swap`.

        Options, as in `rtloop.client.retuning.RetuneRequest`: `amplitude_um`, `gain_um`, `bound_percent`,
        `within_percent` and `spec`. The loop moves for the measurement. A gain that is not measured, or not precisely
        enough, is replaced by the model's. Raises ConfigError for an axis or model that does not allow it, LoopFault if
        no resonance is found or a used value is too far from the model's, NoDesign if no taps meet the specification,
        InputFileError for a `spec` that cannot be read.
        """
        from rtloop.client.retuning import RetuneRequest, propose_taps

        return propose_taps(self._client, RetuneRequest(axis, **options))

    def swap(self, proposal: Proposal) -> int:
        """Replace the prefilter's taps of the axis of a proposal by the proposed ones, interpolated in several steps.

        Returns the tick of the last step. Raises LoopFault if the loop's taps have changed since the proposal,
        RtloopError if the service refuses a step; the loop then keeps the taps of the step before.
        """
        from rtloop.client.retuning import swap_in

        return swap_in(self._client, proposal.axis, proposal.for_json())

    def capture(
        self,
        seconds: float,
        trigger: Condition | None = None,
        *,
        at: int | None = None,
        pre_percent: float = 50.0,
        timeout_s: float = 60.0,
        folder: Path | str | None = None,
    ) -> Recording:
        """Save every tick of a span of `seconds` as a recording and return it, as `rtloop.load` does.

        `trigger` is `rtloop.Edge("x_position_um", 5.0)`, or a `Window`, `Stepped`, `Tripped`, `ModeChanged` or `Late`:
        the span lies about the first tick from now on that meets it, at the loop's full rate, within `timeout_s`. `at`
        names the tick instead, such as one that a command returned, or one that the loop reaches within `timeout_s`.
        `pre_percent` of the span, 0 … 100, lies before that tick. Without both, the span begins now.

        The file is NAME.capture-TICK.mcap beside the run's recording, or in `folder`. It begins with the ticks since
        the law's last recorded state, at most a second, so that it replays alone. Raises ValueError for invalid
        arguments, RtloopError if no trigger comes or the tick lies too far ahead, RecordingError for ticks that are not
        in the run, OutputError if the file cannot be written, UnavailableError if the run is not recorded.
        """
        from rtloop.client.capture.triggered_capture import capture_span

        return capture_span(self._client, seconds, trigger, at, pre_percent, timeout_s, folder)

    def _command(self, resource: str, **body: object) -> int:
        """Post a command, JSON fields `body`, to `resource`, such as "/stop". Returns the tick at which the command
        took effect; raises as `Client.post`.
        """
        return int(self._client.post(resource, body)["tick"])


def connect(service: str | Path | None = None, *, as_: str | None = None) -> Connection:
    """Connect to a service by its name or the path of its control socket; None means the only running service.

    Commands are recorded under the name `as_`; without one they are recorded as `operator`. An invalid name is refused
    at the first command. Raises UnavailableError if no service answers, or if several run and none is named,
    HostRefusal if another user could have made the socket.
    """
    if isinstance(service, str) and "/" in service:
        service = Path(service)
    path = service if isinstance(service, Path) else find_control_socket(service)
    connection = Connection(Client(path, as_))
    _ = connection.status
    return connection


def read_controller(config: Path, axis: str) -> dict[str, object]:
    """Return {key: value} of the keys that a configuration file sets in [axis.controller] of an axis, without defaults.

    Raises InputFileError for a file that cannot be read, ConfigError for an invalid one or one without this section.
    """
    from rtloop.configuration.file import load

    axes = {options.name: options.controller for options in load(config).axes}
    section = axes.get(axis)
    if section is None:
        reason = (
            f"axis {axis} has no [axis.controller]" if axis in axes else f"the axes of this file are {', '.join(axes)}"
        )
        raise ConfigError(str(config), [f"no controller for axis {axis!r}; {reason}"])
    return section.model_dump(exclude_unset=True)


def _floats(values: Iterable[float]) -> list[float]:
    """Return the values of an iterable or array (n,) as a list of floats for JSON; an iterator is consumed."""
    return [float(value) for value in values]
