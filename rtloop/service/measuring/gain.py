"""Measurement of a running loop's static gain with a staircase of setpoints, on the side with more room."""

from __future__ import annotations

from rtloop import signals
from rtloop.analysis.measured.gain import StaticGain, staircase, static_gain
from rtloop.configuration.axis import LimitsOptions
from rtloop.service.measuring.player import Player


def measure_gain(player: Player, limits: LimitsOptions, span_um: float) -> StaticGain:
    """Move the axis over setpoints up to `span_um` from the present one, towards the middle of the range, and back.

    Returns the static gain, µm of position per µm of command, with its standard deviation. Raises ValueError if a step
    does not move command and position in the same direction, and the exceptions of `Player.play_and_read`, after which
    the axis moves back, too, unless another client has set a reference.
    """
    middle_um = 0.0 if limits.lowest_v < 0 else limits.command_um / 2
    to_um = player.hold_um + (-span_um if player.hold_um > middle_um else span_um)
    references_um = staircase(player.hold_um, to_um, player.rate_hz)
    with player.return_to_hold():
        rows = player.play_and_read(references_um)
    position, command = (player.column(rows, signal) for signal in (signals.POSITION, signals.COMMAND))
    return static_gain(references_um, position, command, player.rate_hz)
