"""A periodic reference that is learned while the loop runs: between cycles its table is corrected by the error."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

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
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Refused
from rtloop.service.measuring.client_presence import client_waits, require_client
from rtloop.service.measuring.player import Player
from rtloop.signals import FEED, POSITION, REFERENCE
from rtloop.supervision.supervisor import Supervisor

GLIDE_S = 0.5
"""From what is held to the first sample."""
LONGEST_S = 300.0


@dataclass(frozen=True)
class Asked:
    """One period of the wanted position (n,), in µm, a tick a sample; how often it is learned; how far to be sure."""

    wanted_um: Real
    cycles: int = 5
    resonance_percent: float = 2.0
    """Nothing is played unless the error shrinks with the resonance anywhere within so much of the model's."""
    keep: bool = True
    """Whether the best table goes on playing at the end; else what was held is held again."""


class Cycle(NamedTuple):
    """Of one table: rms and largest error, µm, over the mean of the periods that were judged."""

    rms_um: float
    largest_um: float


class Learned(NamedTuple):
    """Every cycle, the first one with nothing learned; the best table (n, 2); why it ended."""

    cycles: list[Cycle]
    table: Real
    ended: str

    def for_json(self) -> dict[str, Any]:
        """Plain values."""
        reference, command = self.table.T.tolist()
        cycles = [cycle._asdict() for cycle in self.cycles]
        return {"cycles": cycles, "ended": self.ended, "reference_um": reference, "command_um": command}


def learn(
    supervisor: Supervisor, live: LiveLaw, axis: str, asked: Asked, add_cycle: Callable[[float], None] = lambda _: None
) -> Learned:
    """Play a period again and again on an axis that holds a reference, and learn it.

    `add_cycle` receives the rms error of each cycle, µm, as soon as it is judged.

    Raises ConfigError for what can be granted in no state, and for a loop in which learning would not converge; Refused
    for what this state does not allow, and where it was given up: the loop then plays the best table, where that is to
    be kept, or holds what it held, unless it tripped or somebody else has set a reference. Raises ClientGone where the
    client went away before the end: the loop then holds what it held, for nobody has seen what a table does.
    """
    number = live.axis_number(axis)
    rate_hz = live.prepared.configuration.loop.rate_hz
    ticks = asked.wanted_um.size
    settle_periods, judged_periods = cycle_periods(ticks, rate_hz)
    if (duration_s := (asked.cycles + 1) * (settle_periods + judged_periods) * ticks / rate_hz) > LONGEST_S:
        raise _unsuitable(f"{asked.cycles} cycles take {duration_s:.0f} s; at most {LONGEST_S:g} s are allowed")
    gains = _teacher(live, number, asked)
    player = Player(supervisor, live, number, "learn")
    trials = _Tried(add_cycle)
    try:
        glide = _glide(player.hold_um, float(asked.wanted_um[0]), round(GLIDE_S * rate_hz))
        player.read(player.play(glide), len(glide))
        end_reason = _taught(player, gains, asked, settle_periods, judged_periods, trials)
        _leave(player, trials, asked.keep)
        require_client("learn")
    except Exception:
        if player.ours:
            with suppress(RtloopError):
                _leave(player, trials, asked.keep)
        raise
    return Learned(trials.cycles, trials.best, end_reason)


def _leave(player: Player, tried: _Tried, keep: bool) -> None:
    """Play the best table that was judged, where it is to be kept, for a client that still waits; else hold what was
    held. Raises Refused.
    """
    if keep and tried.tables and client_waits():
        player.play(tried.best, repeat=True)
    else:
        player.hold(player.hold_um)


class _Tried:
    """Tables and what became of each."""

    def __init__(self, add_cycle: Callable[[float], None]) -> None:
        self._add_cycle = add_cycle
        self.cycles: list[Cycle] = []
        self.tables: list[Real] = []

    def note(self, table: Real, error_um: Real) -> None:
        """Another one."""
        self.tables.append(table)
        self.cycles.append(Cycle(rms(error_um), float(np.abs(error_um).max())))
        self._add_cycle(self.cycles[-1].rms_um)

    @property
    def number(self) -> int:
        """Of the best cycle."""
        return min(range(len(self.cycles)), key=lambda cycle: self.cycles[cycle].rms_um)

    @property
    def best(self) -> Real:
        """Its table."""
        return self.tables[self.number]


def _taught(player: Player, teacher: LearningGains, asked: Asked, settle: int, judged: int, tried: _Tried) -> str:
    """Cycle after cycle; why it ended."""
    table = unlearned_table(asked.wanted_um)
    for cycle in range(asked.cycles + 1):
        error_um = _error(player, asked.wanted_um, table, settle, judged)
        tried.note(table, error_um)
        if tried.cycles[-1].rms_um > MAX_ERROR_GROWTH * tried.cycles[tried.number].rms_um:
            return f"the error grew in cycle {cycle}: back to cycle {tried.number}"
        table = teacher.improve(table, error_um)
    return f"after {asked.cycles} cycles"


def _teacher(live: LiveLaw, number: int, asked: Asked) -> LearningGains:
    configuration = live.prepared.configuration
    options, rate_hz = configuration.axes[number], configuration.loop.rate_hz
    loops = []
    if options.model is not None and len(configuration.axes_sharing(number)) == 1:
        for name, plant in plants_around(options.model.transfer(), asked.resonance_percent):
            loop = promised_loop(options, rate_hz, delay_ticks(configuration, options), plant)
            loops += [] if loop is None else [(name, loop)]
    if not loops:
        raise _unsuitable(f"axis {options.name!r}: no model of a loop of its own; what is learned follows from that")
    try:
        return learning_gains(loops, asked.wanted_um.size)
    except ValueError as error:
        raise _unsuitable(f"axis {options.name!r}: {error}") from None


def _error(player: Player, wanted_um: Real, table: Real, settle: int, judged: int) -> Real:
    """Wanted minus measured (n,), the mean of the periods behind those to settle.

    Played once and then held, so that the next table begins where this one ended, whenever it comes.
    """
    ticks, repeated_table = wanted_um.size, np.tile(table, (settle + judged, 1))
    rows = player.read(player.play(repeated_table), len(repeated_table))[settle * ticks :]
    recorded_table = np.column_stack([player.column(rows, REFERENCE), player.column(rows, FEED)])
    if not np.array_equal(recorded_table, np.tile(table, (judged, 1))):
        raise Refused("learn: the reference was changed, or held, meanwhile")
    return wanted_um - player.column(rows, POSITION).reshape(judged, ticks).mean(axis=0)


def _glide(from_um: float, to_um: float, ticks: int) -> Real:
    """Half a cosine (ticks, 1)."""
    return (from_um + (to_um - from_um) * (1 - np.cos(np.pi * np.arange(1, ticks + 1) / ticks)) / 2)[:, np.newaxis]


def _unsuitable(message: str) -> ConfigError:
    return ConfigError("request", [f"learn: {message}"])
