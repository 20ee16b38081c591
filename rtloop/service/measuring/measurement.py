"""The response of a loop that runs: multisines about the reference that it holds, played, watched, taken back.

What is played ends at the value that was held, so that the loop comes back to it whatever becomes of the service; a
client that goes away ends it at once. What is measured is read off the ring that the recorder reads, and is in the
recording.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
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
from rtloop.configuration.checks import delay_ticks, promised_loop
from rtloop.errors import ConfigError
from rtloop.foundation.arrays import Real
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Refused
from rtloop.service.measuring.gain import measure_gain
from rtloop.service.measuring.player import REST_S, Player
from rtloop.supervision.supervisor import Supervisor

FADE_S = 0.05
FIRST_PERIODS = 2
TRIES, LESS = 3, 0.7
"""How often less is tried, and how much less, where the position went too far."""
KEPT = 100
"""Measurements of an axis that are remembered."""
SHORTEST_S, SHORTEST_OF_A_MODE_S, LONGEST_S, LINES_OF_A_MODE = 1.0, 0.25, 4.0, 2.0
"""Of a period; so long that half the width of the model's lightest mode is so many lines."""
LOWEST_LINES = 2
"""The lowest frequency, in lines, where none is given."""
EXCITED = 0.3
"""Part of a light mode's frequency, to both sides, that is excited for it alone."""
REST_MARGIN = 1.2
"""Of what the position moves by at rest: so much is allowed on top of the stated amplitude."""
NAMES = {"reference_um": signals.REFERENCE, "error_um": signals.ERROR, "command_um": signals.COMMAND,
         "position_um": signals.POSITION}  # fmt: skip


class Results:
    """Figures of what was measured of an axis, the newest last."""

    def __init__(self) -> None:
        self._figures: deque[dict[str, Any]] = deque(maxlen=KEPT)

    def note(self, found: LoopMeasurement) -> None:
        """Another one."""
        self._figures.append({"unix_time_s": round(time.time(), 3)} | found.figures())

    @property
    def newest(self) -> dict[str, Any]:
        """Of the last measurement."""
        return self._figures[-1]

    def for_json(self) -> dict[str, Any]:
        """The newest, and how the resonance went: time, frequency and its standard deviation of each."""
        resonances = [
            (figures["unix_time_s"], figures["resonance"]) for figures in self._figures if figures["resonance"]
        ]
        return self.newest | {"resonance_trend": [[time_s, mode["hz"], mode["hz_std"]] for time_s, mode in resonances]}


@dataclass(frozen=True)
class Asked:
    """The added motion of the position at most, the band, how long (s), and where a light mode is expected."""

    amplitude_um: float = 0.5
    from_hz: float | None = None
    to_hz: float | None = None
    duration_s: float = 6.0
    period_s: float | None = None
    """Of the multisine: the longer, the denser its lines."""
    near_hz: float | None = None
    resonance_only: bool = False
    """Excite nothing but the band about the light mode."""
    gain_um: float = 0.0
    """Hold references so far from the one that is held, towards the middle of the range, and measure the gain at rest;
    0: do not."""


def measure(supervisor: Supervisor, live: LiveLaw, axis: str, asked: Asked) -> LoopMeasurement:
    """Measure the loop of an axis about the reference that it holds.

    Raises ConfigError for what can be granted in no state, Refused for what this one does not allow, and where the
    measurement was given up: the reference is then what it was, or what somebody else has set.
    """
    number = live.axis_number(axis)
    configuration = live.prepared.configuration
    if len(configuration.axes_sharing(number)) > 1:
        raise ConfigError("request", [f"axis {axis!r}: shares its controller; a loop of one axis is measured"])
    options, rate_hz = configuration.axes[number], configuration.loop.rate_hz
    model = promised_loop(options, rate_hz, delay_ticks(configuration, options))
    model_resonance = options.model and resonance_hz(options.model.transfer())
    near_hz, half_width_hz = model_resonance or (None, 0.0)
    near_hz = asked.near_hz or near_hz
    if asked.resonance_only:
        if near_hz is None:
            fault = f"near_hz: missing, and axis {axis!r} has no model with a resonance; it is needed"
            raise ConfigError("request", [fault])
        asked = replace(asked, from_hz=(1 - EXCITED) * near_hz, to_hz=(1 + EXCITED) * near_hz)
    lines = _grid(asked, rate_hz, near_hz, half_width_hz)
    periods = max(2, round(asked.duration_s * rate_hz / lines.samples) - 1)
    player = Player(supervisor, live, number, "response")
    excitation_run = _Run(player, live.prepared.plan.driver_kind)
    with excitation_run.about_the_reference(asked.amplitude_um):
        loop_signals = excitation_run.approach(lines, asked.amplitude_um, periods)
    try:
        measurement = measure_loop(loop_signals, rate_hz, near_hz, model, options.prefilter.command_taps)
        if not asked.gain_um:
            return measurement
        return replace(measurement, gain=measure_gain(player, options.limits, asked.gain_um))
    except ValueError as error:
        raise Refused(f"response: {error}") from None


def _grid(asked: Asked, rate_hz: float, near_hz: float | None, half_width_hz: float) -> LineGrid:
    shortest_s = SHORTEST_OF_A_MODE_S if asked.resonance_only else SHORTEST_S
    mode_period_s = LINES_OF_A_MODE / half_width_hz if half_width_hz else SHORTEST_S
    period_s = asked.period_s or min(max(mode_period_s, shortest_s), LONGEST_S, max(asked.duration_s / 3, shortest_s))
    from_hz, to_hz = asked.from_hz or LOWEST_LINES / period_s, asked.to_hz or HIGHEST_PART * rate_hz
    try:
        return make_grid(rate_hz, period_s, from_hz, to_hz, near_hz)
    except ValueError as error:
        raise ConfigError("request", [f"response: {error}"]) from None


class _TooFar(Refused):
    """The position went further than was stated."""


class _Run:
    """Multisines about the reference that is held, within a stated motion."""

    def __init__(self, player: Player, driver: str) -> None:
        self._player, self._driver = player, driver
        self._lowest_um, self._highest_um = -np.inf, np.inf

    @contextmanager
    def about_the_reference(self, amplitude_um: float) -> Iterator[None]:
        """Rest first, to know what is allowed; at the end hold what was held, unless somebody else set a reference."""
        player = self._player
        rest_um = player.column(player.read(player.tick, round(REST_S * player.rate_hz)), signals.POSITION)
        slack_um = REST_MARGIN * np.abs(rest_um - rest_um.mean()).max()
        self._lowest_um, self._highest_um = rest_um.mean() + np.array([-1, 1]) * (amplitude_um + slack_um)
        with player.coming_back():
            yield

    def approach(self, lines: LineGrid, amplitude_um: float, periods: int) -> dict[str, Real]:
        """Signals of the largest multisine that keeps within the amplitude; what goes further is taken back."""
        period = excitation.first_period(lines, amplitude_um)
        amplitude_ratios, remaining_tries = [*excitation.AMPLITUDE_RATIOS], TRIES
        loop_signals = self.play(period, FIRST_PERIODS)
        while amplitude_ratios:
            next_period = excitation.shape_period(
                lines, period, self._whole(lines, loop_signals), amplitude_um, amplitude_ratios[0]
            )
            try:
                loop_signals = self.play(next_period, FIRST_PERIODS if len(amplitude_ratios) > 1 else periods)
            except _TooFar:
                remaining_tries -= 1
                if not remaining_tries:
                    raise
                self._player.hold(self._player.hold_um)
                amplitude_ratios = [LESS * ratio for ratio in amplitude_ratios]
            else:
                period, amplitude_ratios = next_period, amplitude_ratios[1:]
        return loop_signals

    def play(self, period: Real, periods: int) -> dict[str, Real]:
        """Signals of all ticks of one period to settle and `periods` more, and of the fade behind them."""
        player = self._player
        samples = excitation_sequence(period, periods, player.hold_um, round(FADE_S * player.rate_hz))
        rows = player.played(samples, self._judge)
        loop_signals = {name: player.column(rows, signal) for name, signal in NAMES.items()}
        return loop_signals | (
            {"periods_missed": rows[:, signals.PERIODS_MISSED]} if self._driver != TICK_DRIVEN else {}
        )

    def _whole(self, lines: LineGrid, found: dict[str, Real]) -> PeriodSignals:
        """The whole periods behind the one to settle."""
        series = (found[name][lines.samples :] for name in ("error_um", "command_um", "position_um"))
        return PeriodSignals(
            *(part[: part.size // lines.samples * lines.samples].reshape(-1, lines.samples) for part in series)
        )

    def _judge(self, position_um: Real) -> None:
        min_um, max_um = float(position_um.min()), float(position_um.max())
        if not self._lowest_um <= min_um <= max_um <= self._highest_um:
            raise _TooFar(f"response: the position went to {min_um:.4g} … {max_um:.4g} µm, beyond the stated "
                          f"{self._lowest_um:.4g} … {self._highest_um:.4g} µm")  # fmt: skip
