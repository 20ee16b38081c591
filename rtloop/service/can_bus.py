"""Supervision over a CAN bus, with the frames of a DBC: sends status, heartbeat and trips; receives setpoints, modes
and trip resets.

Two threads of the service's process do this; nothing here delays a tick. Commands from the bus have the origin "can" in
the recording, and use the lock as a client without a name. A frame that is malformed, outside the envelope or not
allowed in the state changes nothing; it is counted in the status frame and logged (at most once a second).
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

from rtloop import errors, signals
from rtloop.drivers.can.options import BusOptions
from rtloop.drivers.errors import DriverError, MissingLibrary
from rtloop.engine.messages import Origin
from rtloop.errors import ConfigError, UnavailableError
from rtloop.foundation import timing
from rtloop.recording.file.topics.events import OPERATOR
from rtloop.service.desk import Refusal, Requester, use_requester
from rtloop.service.service import Service, State
from rtloop.signals import Mode

if TYPE_CHECKING:  # The packages may be missing.
    import can

    from rtloop.drivers.can.frames import Frame
    from rtloop.foundation.arrays import Real

COMMANDS = {"Setpoint": ("Axis", "Value"), "Mode": ("Mode",), "TripReset": ("Confirm",)}
"""Frames that are received, each with its signals in the order of their bits."""
REPORTS = {
    "Status": ("State", "Mode", "Refused", "Causes"),
    "Heartbeat": ("Counter", "Tick"),
    "Trip": ("Causes", "Tick"),
}
"""Frames that are sent, each with its signals in the order of their bits."""
POLL_S = 0.01
LOG_PERIOD_S = 1.0
END_TIMEOUT_S = 5.0
log = logging.getLogger("rtloop")


@contextlib.contextmanager
def can_supervision(service: Service) -> Iterator[None]:
    """Send and receive CAN frames in two threads during the work within, then close the bus.

    Without [service.can] in the configuration there is no bus and no thread. Raises MissingExtra for a missing library,
    ConfigError for a faulty DBC or option, UnavailableError if the bus cannot be opened.
    """
    options = service.configuration.service.can
    if options is None:
        yield
        return
    section = f"{service.config}: service.can"
    try:
        from rtloop.drivers.can.bus import open_bus, require_interface
        from rtloop.drivers.can.frames import load_frames

        require_interface(options)
        frames = load_frames(options)
        _require_frames(frames, options)
        bus = open_bus(options)
    except MissingLibrary as error:
        raise errors.MissingExtra(f"{section}: {error}") from None
    except ValueError as error:
        raise ConfigError(str(service.config), [f"service.can.{error}"]) from None
    except DriverError as error:
        raise UnavailableError(f"{section}: {error}") from None
    supervision = CanSupervision(service, options, bus, frames)
    threads = [timing.start_thread(work) for work in (supervision.send_frames, supervision.receive_frames)]
    try:
        yield
    finally:
        supervision.end_event.set()
        for thread in threads:
            thread.join(END_TIMEOUT_S)
        bus.shutdown()


def _require_frames(frames: Mapping[str, Frame], options: BusOptions) -> None:
    """Raise ValueError, which names the DBC file, unless `frames`, by name, has each frame of REPORTS and COMMANDS with
    as many signals as listed there.
    """
    for name, signal_names in (REPORTS | COMMANDS).items():
        allowed = f"allowed: a message {name} with the signals {', '.join(signal_names)}"
        if name not in frames:
            raise ValueError(f"dbc: {options.dbc}: has no message {name}; {allowed}")
        if (count := len(frames[name].signals)) != len(signal_names):
            raise ValueError(f"dbc: {options.dbc}: {name} has {count} signals; {allowed}")


class CanSupervision:
    """Supervision of a service over the open `bus`: sends the service's state, executes command frames.

    `frames` has the frames of the DBC by name. `refused_count` is the number of command frames that were not executed.
    """

    def __init__(self, service: Service, options: BusOptions, bus: can.BusABC, frames: Mapping[str, Frame]) -> None:
        """Prepare `send_frames` and `receive_frames` on the open `bus`; `frames` are those of the DBC, by name."""
        self._service, self._options, self._bus, self._frames = service, options, bus, frames
        self._commands: dict[int, tuple[Frame, Callable[..., object]]] = {
            frames[name].identifier: (frames[name], command)
            for name, command in (
                ("Setpoint", self._set_setpoint),
                ("Mode", self._set_mode),
                ("TripReset", self._reset_trip),
            )
        }
        self.end_event = timing.event()
        self.refused_count = 0
        self._logged_s = 0.0

    def send_frames(self) -> None:
        """Send Status and Heartbeat with the periods of the DBC, and Trip when a trip begins, until `end_event` is set.

        A frame that cannot be sent is lost, and logged as `_log_warning` does.
        """
        due_s = dict.fromkeys(("Status", "Heartbeat"), timing.monotonic_s())
        beat_count, is_tripped = 0, False
        while not self.end_event.wait(POLL_S):
            row, now_s = self._newest_record(), timing.monotonic_s()
            causes = 0 if row is None else int(row[signals.FLAGS]) & signals.TRIP_MASK
            tick = 0 if row is None else int(row[signals.TICK]) % 2**32
            if causes and not is_tripped:
                self._send("Trip", causes, tick)
            is_tripped = bool(causes)
            if now_s >= due_s["Heartbeat"]:
                self._send("Heartbeat", beat_count % 2**16, tick)
                beat_count += 1
            if now_s >= due_s["Status"]:
                mode = Mode.OFF if row is None else row[signals.MODE]
                state = list(State).index(self._service.state)
                self._send("Status", state, mode, self.refused_count % 2**16, causes)
            for name, due_time_s in due_s.items():
                if now_s >= due_time_s:
                    due_s[name] = now_s + self._frames[name].cycle_s

    def receive_frames(self) -> None:
        """Execute received frames of COMMANDS until `end_event` is set; ignore other frames, and log errors of the bus
        without ending.
        """
        while not self.end_event.is_set():
            try:
                message = self._bus.recv(POLL_S)
            except Exception as error:  # An interface may raise anything; the service continues.
                self._log_warning(f"cannot be read: {error}")
                self.end_event.wait(LOG_PERIOD_S)
                continue
            if message is not None and message.arbitration_id in self._commands:
                self._execute_frame(message)

    def _execute_frame(self, message: can.Message) -> None:
        """Execute `message`, a received frame of COMMANDS; a refusal or error is logged and counted in `refused_count`,
        never raised.
        """
        frame, command = self._commands[message.arbitration_id]
        try:
            if not frame.fits(message):
                raise Refusal(
                    f"received as a {'CAN FD' if message.is_fd else 'classic CAN'} frame of {len(message.data)} bytes "
                    f"with {'a 29' if message.is_extended_id else 'an 11'}-bit identifier; allowed: a "
                    f"{'CAN FD' if frame.fd else 'classic CAN'} data frame of {frame.length} bytes with an 11-bit "
                    "identifier, as in the DBC file"
                )
            command(*frame.unpack(message.data))
        except Exception as error:  # No frame may end the thread.
            self.refused_count += 1
            self._log_warning(f"{frame.name}: {'; '.join(getattr(error, 'faults', [str(error)]))}")

    def _set_setpoint(self, axis: float, value: float) -> None:
        """Hold the reference of axis number `axis`, from 0, at `value` (µm; V in raw mode).

        Takes the service's lock as a client without a name. Raises Refusal for an unknown number, without a loop or
        while another name holds the lock; else as `LiveReferences.set`.
        """
        live = self._service.require_live()
        axes = live.prepared.plan.axes
        if axis not in range(len(axes)):  # Neither negative nor, by the signal's scale, a fraction.
            raise Refusal(f"axis is {axis:g}; allowed: 0 to {len(axes) - 1}")
        with self._service.lock.hold(OPERATOR, Origin.CAN):
            live.references.set(axes[int(axis)], {"kind": "hold", "value": value})

    def _set_mode(self, number: float) -> None:
        """Set the mode whose value in `Mode` is `number`.

        Takes the service's lock as a client without a name, except for mode off, which needs none. Raises Refusal for
        an unknown number or while another name holds the lock, and as `Service.set_mode`.
        """
        if number not in list(Mode):
            raise Refusal(
                f"mode is {number:g}; allowed: {', '.join(f'{mode.value} ({mode.name.lower()})' for mode in Mode)}"
            )
        lock_context = use_requester(Requester(origin=Origin.CAN))
        with lock_context if number == Mode.OFF else self._service.lock.hold(OPERATOR, Origin.CAN):
            self._service.set_mode(Mode(int(number)).name.lower())

    def _reset_trip(self, confirm: float) -> None:
        """Reset a trip if `confirm` is 1; takes the service's lock as a client without a name.

        Raises Refusal for another number or while another name holds the lock, and as `Service.reset`.
        """
        if confirm != 1:
            raise Refusal(f"confirm is {confirm:g}; allowed: 1, which resets the trip")
        with self._service.lock.hold(OPERATOR, Origin.CAN):
            self._service.reset()

    def _newest_record(self) -> Real | None:
        """Return the newest record (columns,), None without a loop or before its first tick."""
        supervisor = self._service.supervisor
        return None if supervisor is None else supervisor.latest()

    def _send(self, name: str, *values: float) -> None:
        """Send the CAN frame `name` of the DBC with these values, in the order of its signals.

        A value beyond a signal's range is clipped. A failure is logged, not raised.
        """
        try:
            self._bus.send(self._frames[name].message(self._options, values))
        except Exception as error:
            self._log_warning(f"cannot be written: {error}")

    def _log_warning(self, text: str) -> None:
        """Log `text` as a warning that begins with the bus's label; drop it within LOG_PERIOD_S after the last one."""
        now_s = timing.monotonic_s()
        if now_s - self._logged_s >= LOG_PERIOD_S:
            self._logged_s = now_s
            log.warning("%s: %s", self._options.label, text)
