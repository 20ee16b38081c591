"""The gain at rest of a loop that runs: references held in turn, on the side where there is more room."""

from __future__ import annotations

from rtloop import signals
from rtloop.analysis.measured.gain import StaticGain, staircase, static_gain
from rtloop.configuration.axis import LimitsOptions
from rtloop.service.measuring.player import Player


def measure_gain(player: Player, limits: LimitsOptions, span_um: float) -> StaticGain:
    """Hold references up to `span_um` from the one held, towards the middle of the range, and go back to it.

    Raises ValueError where the loop does not follow them, and what `Player.played` raises.
    """
    middle_um = 0.0 if limits.lowest_v < 0 else limits.command_um / 2
    to_um = player.hold_um + (-span_um if player.hold_um > middle_um else span_um)
    references_um = staircase(player.hold_um, to_um, player.rate_hz)
    with player.coming_back():
        rows = player.played(references_um)
    position, command = (player.column(rows, signal) for signal in (signals.POSITION, signals.COMMAND))
    return static_gain(references_um, position, command, player.rate_hz)
