"""Iterative learning of a periodic reference on a running loop: the error of a cycle corrects the next table."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rtloop.analysis.learning import (
    MAX_ERROR_GROWTH,
    LearningGains,
    cycle_periods,
    learning_gains,
    rms,
    unlearned_table,
)
from rtloop.analysis.perturbation import plants_around
from rtloop.configuration.checks import delay_ticks, promised_loop
from rtloop.errors import ConfigError, RtloopError
from rtloop.foundation.arrays import Real
from rtloop.laws.linearise import NOT_LINEAR
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Refusal
from rtloop.service.measuring.client_presence import is_client_waiting, require_client
from rtloop.service.measuring.player import Player
from rtloop.signals import FEED, POSITION, REFERENCE
from rtloop.supervision.supervisor import Supervisor

GLIDE_S = 0.5
"""Time of the move from the setpoint to the first sample."""
MAX_DURATION_S = 300.0


@dataclass(frozen=True)
class LearnRequest:
    """Options of a learning; `reference_um` (n,) is one period of the desired position, one sample per tick."""

    reference_um: Real
    cycles: int = 5
    """Number of cycles with a learned table; one cycle without learning comes before."""
    resonance_percent: float = 2.0
    """Learning must converge for every resonance within this deviation from the model's; else it is refused."""
    keep: bool = True
    """Whether the best table continues to play at the end; otherwise the loop returns to its setpoint."""


class Cycle(NamedTuple):
    """Rms and largest error of one table, µm, from the mean of its judged periods."""

    rms_um: float
    largest_um: float


class LearnResult(NamedTuple):
    """Result of a learning: all cycles (the first one without learning), the best table (n, 2: reference, command
    in µm), and the reason for the end.
    """

    cycles: list[Cycle]
    table: Real
    end_reason: str

    def for_json(self) -> dict[str, object]:
        """Return {cycles: [{rms_um, largest_um}, …], ended: reason, reference_um, command_um: the table's columns}."""
        reference, command = self.table.T.tolist()
        cycles = [cycle._asdict() for cycle in self.cycles]
        return {"cycles": cycles, "ended": self.end_reason, "reference_um": reference, "command_um": command}


def learn(
    supervisor: Supervisor,
    live: LiveLaw,
    axis: str,
    request: LearnRequest,
    add_cycle: Callable[[float], None] = lambda _: None,
) -> LearnResult:
    """Play a period on an axis at a setpoint, cycle after cycle, each with a table that the error of the cycle before
    has corrected. Returns all cycles, the best table and the reason for the end, after the last cycle.

    At the end the loop plays the best table if `keep` is true, else it returns to its setpoint. `add_cycle` receives
    the rms error of each cycle, µm, at its end.

    Raises ConfigError for an invalid request and for a loop in which learning would not converge, Refusal if the state
    does not allow the learning or the learning was aborted. After an abort the reference becomes the best table if
    `keep` is true, a cycle was judged and the loop is still in closed loop without a trip; else the setpoint. It stays
    in raw mode, and if a client has set another one. Raises ClientDisconnected if the client disconnects before the
    end; the loop then returns to its setpoint.
    """
    number = live.axis_number(axis)
    rate_hz = live.prepared.configuration.loop.rate_hz
    ticks = request.reference_um.size
    settle_periods, judged_periods = cycle_periods(ticks, rate_hz)
    if (duration_s := (request.cycles + 1) * (settle_periods + judged_periods) * ticks / rate_hz) > MAX_DURATION_S:
        raise _invalid_request(
            f"{request.cycles} cycles, and one without learning before them, take {duration_s:.0f} s; allowed: at most "
            f"{MAX_DURATION_S:g} s; use fewer cycles"
        )
    gains = _learning_gains(live, number, request)
    player = Player(supervisor, live, number, "learn")
    trials = _Trials(add_cycle)
    try:
        glide = _glide_samples(player.hold_um, float(request.reference_um[0]), round(GLIDE_S * rate_hz))
        player.read(player.play(glide), len(glide))
        end_reason = _run_cycles(player, gains, request, settle_periods, judged_periods, trials)
        _set_final_reference(player, trials, request.keep)
        require_client("learn")
    except Exception:
        if player.owns_reference:
            with suppress(RtloopError):
                _set_final_reference(player, trials, request.keep)
        raise
    return LearnResult(trials.cycles, trials.best_table, end_reason)


def _set_final_reference(player: Player, trials: _Trials, keep: bool) -> None:
    """Play the best table endlessly if `keep` is true, a table was judged, the client is connected and the mode is
    closed_loop without a trip; else set the setpoint as reference.

    Raises as `Player.play` and `Player.hold`.
    """
    if keep and trials.tables and is_client_waiting() and player.is_in_closed_loop:
        player.play(trials.best_table, repeat=True)
        if player.is_in_closed_loop:  # A trip until here would let the stage scan after reset and start.
            return
    player.hold(player.hold_um)


class _Trials:
    """Tables that were played, and the errors of each; `add_cycle` receives the rms error of each, µm."""

    def __init__(self, add_cycle: Callable[[float], None]) -> None:
        """Begin without a table; `add_cycle` receives the rms error of each table, µm, when it is added."""
        self._add_cycle = add_cycle
        self.cycles: list[Cycle] = []
        self.tables: list[Real] = []

    def add(self, table: Real, error_um: Real) -> None:
        """Add a table (n, 2: reference, command, µm) and its error (n,), µm; pass the rms error to `add_cycle`."""
        self.tables.append(table)
        self.cycles.append(Cycle(rms(error_um), float(np.abs(error_um).max())))
        self._add_cycle(self.cycles[-1].rms_um)

    @property
    def best_cycle(self) -> int:
        """Number of the cycle with the smallest rms error; 0 is the cycle without learning.

        Raises ValueError before the first `add`.
        """
        return min(range(len(self.cycles)), key=lambda cycle: self.cycles[cycle].rms_um)

    @property
    def best_table(self) -> Real:
        """The table (n, 2: reference, command, µm) of the cycle with the smallest rms error.

        Raises ValueError before the first `add`.
        """
        return self.tables[self.best_cycle]


def _run_cycles(
    player: Player,
    gains: LearningGains,
    request: LearnRequest,
    settle_periods: int,
    judged_periods: int,
    trials: _Trials,
) -> str:
    """Play, judge and improve the table, cycle after cycle, and add each to `trials`. Returns the reason for the end.

    Each table plays for `settle_periods`, which are not judged, then for `judged_periods`. Ends early once the rms
    error exceeds MAX_ERROR_GROWTH times the smallest of all cycles. Raises as `_mean_error_um`.
    """
    table = unlearned_table(request.reference_um)
    for cycle in range(request.cycles + 1):
        error_um = _mean_error_um(player, request.reference_um, table, settle_periods, judged_periods)
        trials.add(table, error_um)
        if trials.cycles[-1].rms_um > MAX_ERROR_GROWTH * trials.cycles[trials.best_cycle].rms_um:
            return f"the error grew in cycle {cycle}; cycle {trials.best_cycle} has the best table"
        table = gains.improve(table, error_um)
    return f"after {request.cycles} cycles"


def _learning_gains(live: LiveLaw, number: int, request: LearnRequest) -> LearningGains:
    """Return gains with which learning converges for the model of axis `number`, also with its resonance shifted within
    ±`resonance_percent`.

    Raises ConfigError for an axis without a model, with a shared controller or without a linear controller, and if
    there are no such gains.
    """
    configuration = live.prepared.configuration
    options, rate_hz = configuration.axes[number], configuration.loop.rate_hz
    if options.model is None:
        raise _invalid_request(f"axis.{options.name}.model: missing; learning needs a model of the axis")
    if len(configuration.axes_sharing(number)) > 1:
        raise _invalid_request(
            f"axis.{options.name}.controller: shared by several axes; learning needs a controller of this axis alone"
        )
    loops = []
    for name, plant in plants_around(options.model.transfer(), request.resonance_percent):
        loop = promised_loop(options, rate_hz, delay_ticks(configuration, options), plant)
        loops += [] if loop is None else [(name, loop)]
    if not loops:
        fault = "missing" if options.controller is None else f"the law {NOT_LINEAR}"
        raise _invalid_request(f"axis.{options.name}.controller: {fault}; learning needs a linear controller")
    try:
        return learning_gains(loops, request.reference_um.size)
    except ValueError as error:
        raise _invalid_request(f"axis {options.name!r}: {error}") from None


def _mean_error_um(player: Player, reference_um: Real, table: Real, settle_periods: int, judged_periods: int) -> Real:
    """Play `table`, one period (n, 2: reference, command, µm), `settle_periods` + `judged_periods` times; return the
    mean error (n,), µm, of the last `judged_periods`.

    The error is `reference_um` (n,), the desired position, minus the measured one. All periods are sent as one waveform
    without repeat, whose last value is held afterwards, so that the next table continues from this value at any time.
    Raises as `Player.play` and `Player.read`, and Refusal if another reference or command was played meanwhile.
    """
    ticks, repeated_table = reference_um.size, np.tile(table, (settle_periods + judged_periods, 1))
    rows = player.read(player.play(repeated_table), len(repeated_table))[settle_periods * ticks :]
    recorded_table = np.column_stack([player.column(rows, REFERENCE), player.column(rows, FEED)])
    if not np.array_equal(recorded_table, np.tile(table, (judged_periods, 1))):
        raise Refusal(
            "learn: the recorded reference differs from the table that was sent, because loop.hold_input held the "
            "reference or another client changed the reference; learn again while the hold input is inactive and no "
            "other client changes the reference"
        )
    return reference_um - player.column(rows, POSITION).reshape(judged_periods, ticks).mean(axis=0)


def _glide_samples(from_um: float, to_um: float, ticks: int) -> Real:
    """Return a half cosine (ticks, 1), µm, from `from_um`, which is left out, to `to_um`, which is the last sample."""
    return (from_um + (to_um - from_um) * (1 - np.cos(np.pi * np.arange(1, ticks + 1) / ticks)) / 2)[:, np.newaxis]


def _invalid_request(message: str) -> ConfigError:
    """Return, without raising it, the error for a request that is invalid or that the loop's configuration does not
    allow; its only fault is `message` behind "learn: ".
    """
    return ConfigError("request", [f"learn: {message}"])
