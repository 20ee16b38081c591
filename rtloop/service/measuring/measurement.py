"""Measurement of a running loop's response with multisines about its setpoint.

Every excitation ends at the setpoint, so that the loop returns to it even if the service dies. A client that
disconnects ends the measurement. The signals come from the ring that the recorder reads, so they are in the recording.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rtloop import signals
from rtloop.analysis.measured import excitation
from rtloop.analysis.measured.measurement import TICK_DRIVEN, LoopMeasurement, measure_loop
from rtloop.analysis.measured.multisine import HIGHEST_PART, LineGrid, excitation_sequence, make_grid
from rtloop.analysis.measured.response import PeriodSignals
from rtloop.analysis.perturbation import resonance_hz
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.checks import delay_ticks, promised_loop
from rtloop.configuration.simulated import sensor_ends_um
from rtloop.errors import ConfigError
from rtloop.foundation import timing
from rtloop.foundation.arrays import Real
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Refusal
from rtloop.service.measuring.gain import measure_gain
from rtloop.service.measuring.player import REST_S, Player
from rtloop.supervision.supervisor import Supervisor

FADE_S = 0.05
TRIAL_PERIODS = 2
MAX_TRIES, REDUCTION = 3, 0.7
"""Number of attempts, and the factor on the amplitude after an attempt with too much motion."""
MAX_MEASUREMENTS = 100
"""Most measurements of an axis that are stored."""
MIN_PERIOD_S, MIN_MODE_PERIOD_S, MAX_PERIOD_S, MODE_LINES = 1.0, 0.25, 4.0, 2.0
"""Bounds on the excitation's period, which is chosen so that half the width of the least damped mode has MODE_LINES
lines.
"""
LOWEST_LINE = 2
"""Default of the lowest frequency, in lines."""
MODE_BAND_FRACTION = 0.3
"""Half-width of the excited band about a mode, as a fraction of its frequency, for `resonance_only`."""
SIGNALS = {"reference_um": signals.REFERENCE, "error_um": signals.ERROR, "command_um": signals.COMMAND,
         "position_um": signals.POSITION}  # fmt: skip


class MeasurementHistory:
    """Figures of the last MAX_MEASUREMENTS measurements of an axis: `LoopMeasurement.figures`, and `unix_time_s`."""

    def __init__(self) -> None:
        """Begin without measurements."""
        self._figures: deque[dict[str, Any]] = deque(maxlen=MAX_MEASUREMENTS)

    def add(self, measurement: LoopMeasurement) -> None:
        """Add the figures of a measurement, with the present time; beyond MAX_MEASUREMENTS remove the oldest ones."""
        self._figures.append({"unix_time_s": round(timing.unix_s(), 3)} | measurement.figures())

    @property
    def newest(self) -> dict[str, Any]:
        """`LoopMeasurement.figures` and unix_time_s (s since 1970) of the last measurement; there must be one."""
        return self._figures[-1]

    def for_json(self) -> Mapping[str, object]:
        """Return the keys of `newest`, and `resonance_trend`: [[time (s since 1970), resonance (Hz), its standard
        deviation (Hz)], …] of the stored measurements that found a resonance, oldest first. One must be stored.
        """
        resonances = [
            (figures["unix_time_s"], figures["resonance"]) for figures in self._figures if figures["resonance"]
        ]
        return self.newest | {"resonance_trend": [[time_s, mode["hz"], mode["hz_std"]] for time_s, mode in resonances]}


@dataclass(frozen=True)
class ResponseRequest:
    """Options of a measurement: `amplitude_um` bounds the added motion of the position, `near_hz` is the expected
    resonance (None: the model's), `from_hz` and `to_hz` are the band (None: automatic).
    """

    amplitude_um: float = 0.5
    from_hz: float | None = None
    to_hz: float | None = None
    duration_s: float = 6.0
    """Duration of the multisine at full amplitude, with one period for settling; shorter trials come before."""
    period_s: float | None = None
    """Period of the multisine: a longer one has denser lines; None: automatic."""
    near_hz: float | None = None
    resonance_only: bool = False
    """Whether to excite only the band about the resonance."""
    gain_um: float = 0.0
    """Span of setpoints, towards the middle of the range, for a measurement of the static gain; 0: none."""


def measure_response(supervisor: Supervisor, live: LiveLaw, axis: str, request: ResponseRequest) -> LoopMeasurement:
    """Measure the closed loop of an axis about its setpoint, then its static gain if `gain_um` is not 0.

    Raises ConfigError for an invalid request or a shared controller, Refusal if the state does not allow the
    measurement, it was aborted, or its signals cannot be evaluated: the reference is then the setpoint again, or one
    that another client has set.
    """
    number = live.axis_number(axis)
    configuration = live.prepared.configuration
    if len(configuration.axes_sharing(number)) > 1:
        raise ConfigError(
            "request",
            [f"axis {axis!r}: shares a controller with other axes; allowed: an axis with a controller of its own"],
        )
    options, rate_hz = configuration.axes[number], configuration.loop.rate_hz
    model = promised_loop(options, rate_hz, delay_ticks(configuration, options))
    model_resonance = options.model and resonance_hz(options.model.transfer())
    near_hz, half_width_hz = model_resonance or (None, 0.0)
    near_hz = request.near_hz or near_hz
    if request.resonance_only:
        if near_hz is None:
            fault = f"near_hz: missing; resonance_only needs it, because axis {axis!r} has no model with a resonance"
            raise ConfigError("request", [fault])
        request = replace(request, from_hz=(1 - MODE_BAND_FRACTION) * near_hz, to_hz=(1 + MODE_BAND_FRACTION) * near_hz)
    lines = _line_grid(request, rate_hz, near_hz, half_width_hz)
    periods = max(2, round(request.duration_s * rate_hz / lines.samples) - 1)
    player = Player(supervisor, live, number, "response")
    ends_um = sensor_ends_um(configuration, options, live.offsets_v.get(number))
    require_room(options, ends_um, player.hold_um, request.amplitude_um)
    excitation_run = _ExcitationRun(player, live.prepared.plan.driver_kind)
    with excitation_run.limit_motion(request.amplitude_um):
        loop_signals = excitation_run.play_largest(lines, request.amplitude_um, periods)
    try:
        measurement = measure_loop(loop_signals, rate_hz, near_hz, model, options.prefilter.command_taps)
        if not request.gain_um:
            return measurement
        return replace(measurement, gain=measure_gain(player, options.limits, request.gain_um))
    except ValueError as error:
        raise Refusal(f"response: {error}") from None


def require_room(axis: AxisOptions, ends_um: tuple[float, float], hold_um: float, amplitude_um: float) -> None:
    """Raise ConfigError for a motion by ±`amplitude_um` about the setpoint `hold_um` that would trip the position
    interlock or leave the sensor's range, `ends_um` (lowest, highest).
    """
    position_um, keys = axis.interlocks.position_um, f"axis.{axis.name}.interlocks"
    sensor = f"the sensor's range ends ({keys}.sensor_min_v and sensor_max_v)"
    allowed_um, limit = min(
        (position_um - abs(hold_um), f"±{position_um:g} µm, where {keys}.position_um trips"),
        (hold_um - ends_um[0], f"{ends_um[0]:.4g} µm, where {sensor}"),
        (ends_um[1] - hold_um, f"{ends_um[1]:.4g} µm, where {sensor}"),
    )
    if allowed_um <= 0:
        fault = f"the setpoint {hold_um:g} µm leaves no room for a motion before {limit}"
        raise ConfigError("request", [f"response: {fault}; use another setpoint"])
    if amplitude_um > allowed_um:
        fault = f"amplitude_um: {amplitude_um:g} µm about the setpoint {hold_um:g} µm"
        raise ConfigError(
            "request", [f"response: {fault}; allowed: up to {allowed_um:.4g} µm, the distance to {limit}"]
        )


def _line_grid(request: ResponseRequest, rate_hz: float, near_hz: float | None, half_width_hz: float) -> LineGrid:
    """Return the multisine's lines, with automatic period and band where the request has none.

    `near_hz` is the expected resonance, or None; `half_width_hz` is half the width of the model's mode, 0 without a
    mode. Raises ConfigError for a band or period that is not possible.
    """
    shortest_s = MIN_MODE_PERIOD_S if request.resonance_only else MIN_PERIOD_S
    mode_period_s = MODE_LINES / half_width_hz if half_width_hz else MIN_PERIOD_S
    period_s = request.period_s or min(
        max(mode_period_s, shortest_s), MAX_PERIOD_S, max(request.duration_s / 3, shortest_s)
    )
    from_hz, to_hz = request.from_hz or LOWEST_LINE / period_s, request.to_hz or HIGHEST_PART * rate_hz
    try:
        return make_grid(rate_hz, period_s, from_hz, to_hz, near_hz)
    except ValueError as error:
        raise ConfigError("request", [f"response: {error}"]) from None


class _ExcessiveMotion(Refusal):
    """The position left the stated range."""


class _ExcitationRun:
    """Player of multisines about the setpoint, within a stated range of the position; `driver` is the driver's kind."""

    def __init__(self, player: Player, driver: str) -> None:
        """Play by `player`, in a loop whose driver is of the kind `driver`; any position is allowed before
        `limit_motion`.
        """
        self._player, self._driver = player, driver
        self._lowest_um, self._highest_um = -np.inf, np.inf

    @contextmanager
    def limit_motion(self, amplitude_um: float) -> Iterator[None]:
        """Measure the position at rest for REST_S, and set the range that `play` allows during the work within.

        The range is the mean position ± (`amplitude_um` + REST_MARGIN times the largest deviation at rest), µm. At the
        end return to the setpoint, unless another reference was set. Raises as `Player.read`.
        """
        player = self._player
        rest_um = player.column(player.read(player.next_tick, round(REST_S * player.rate_hz)), signals.POSITION)
        slack_um = excitation.REST_MARGIN * np.abs(rest_um - rest_um.mean()).max()
        self._lowest_um, self._highest_um = rest_um.mean() + np.array([-1, 1]) * (amplitude_um + slack_um)
        with player.return_to_hold():
            yield

    def play_largest(self, lines: LineGrid, amplitude_um: float, periods: int) -> dict[str, Real]:
        """Play multisines, the last for `periods` periods, and return the signals of the last, as `play` does.

        Each multisine is shaped by the response to the one before, so that the position's motion approaches
        `amplitude_um`. One that moves the position too much is repeated with less amplitude, except the first. Raises
        Refusal as `play`, for too much motion only in the first multisine or in MAX_TRIES of the later ones.
        """
        period = excitation.first_period(lines, amplitude_um)
        amplitude_ratios, remaining_tries = [*excitation.AMPLITUDE_RATIOS], MAX_TRIES
        loop_signals = self.play(period, TRIAL_PERIODS)
        while amplitude_ratios:
            next_period = excitation.shape_period(
                lines, period, self._whole_periods(lines, loop_signals), amplitude_um, amplitude_ratios[0]
            )
            try:
                loop_signals = self.play(next_period, TRIAL_PERIODS if len(amplitude_ratios) > 1 else periods)
            except _ExcessiveMotion:
                remaining_tries -= 1
                if not remaining_tries:
                    raise
                self._player.hold(self._player.hold_um)
                amplitude_ratios = [REDUCTION * ratio for ratio in amplitude_ratios]
            else:
                period, amplitude_ratios = next_period, amplitude_ratios[1:]
        return loop_signals

    def play(self, period: Real, periods: int) -> dict[str, Real]:
        """Play `period` (samples,), µm, about the setpoint once for settling, then `periods` times, and a fade. Returns
        {name: (ticks,)} of all these ticks.

        The names are the keys of SIGNALS and, except with the driver TICK_DRIVEN, `periods_missed`. Raises as
        `Player.play_and_read`, and _ExcessiveMotion if the position leaves the range of `limit_motion`.
        """
        player = self._player
        samples = excitation_sequence(period, periods, player.hold_um, round(FADE_S * player.rate_hz))
        rows = player.play_and_read(samples, self._require_within_limits)
        loop_signals = {name: player.column(rows, signal) for name, signal in SIGNALS.items()}
        return loop_signals | (
            {"periods_missed": rows[:, signals.PERIODS_MISSED]} if self._driver != TICK_DRIVEN else {}
        )

    def _whole_periods(self, lines: LineGrid, loop_signals: dict[str, Real]) -> PeriodSignals:
        """Return error, command and position, µm, (TRIAL_PERIODS, samples) each, of a trial that `play` has played.

        The settling period before and the fade after are left out. The fade may be longer than a period.
        """
        first, end = lines.samples, (1 + TRIAL_PERIODS) * lines.samples
        series = (loop_signals[name][first:end] for name in ("error_um", "command_um", "position_um"))
        return PeriodSignals(*(part.reshape(TRIAL_PERIODS, lines.samples) for part in series))

    def _require_within_limits(self, position_um: Real) -> None:
        """Raise _ExcessiveMotion if a position (n,), µm, leaves the range that `limit_motion` has set."""
        min_um, max_um = float(position_um.min()), float(position_um.max())
        if not self._lowest_um <= min_um <= max_um <= self._highest_um:
            raise _ExcessiveMotion(
                f"response: the position moved over {min_um:.4g} … {max_um:.4g} µm; "
                f"allowed by amplitude_um: {self._lowest_um:.4g} … {self._highest_um:.4g} µm"
            )
