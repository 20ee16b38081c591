"""Inverse Prandtl-Ishlinskii compensation with the memory of the applied drive.

Model and inverse: `rtloop.hysteresis.play_model` (Kuhnen 2003). Plays that follow v would lose the actuator's memory
whenever the drive is limited, slewed, raw or ramped. The law therefore runs the forward model on the applied drive; the
inverse's plays follow its output v_applied = P̂[u_applied].
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.foundation.native.compiled import jit, jit_inline
from rtloop.hysteresis.play_model import MAX_PLAYS
from rtloop.kernel.layout import cache_line_record
from rtloop.kernel.validity import Allowed
from rtloop.laws.contract import Feedforward
from rtloop.laws.shipped.lanes import LANES, sum_lanes
from rtloop.laws.shipped.options import PrandtlIshlinskiiOptions

COEFFICIENTS = cache_line_record(
    [
        ("inverse_thresholds_um", np.float64, (MAX_PLAYS,)),
        ("inverse_weights_v_per_um", np.float64, (MAX_PLAYS,)),
        ("model_thresholds_v", np.float64, (MAX_PLAYS,)),
        ("model_weights_um_per_v", np.float64, (MAX_PLAYS,)),
        ("play_count", np.uint8),
        ("unused", np.uint8, (7,)),
        ("dead_band_v", np.float64),
        ("dead_band_threshold_v", np.float64),
    ]
)
STATE = cache_line_record(
    [
        ("inverse_plays_um", np.float64, (MAX_PLAYS,)),
        ("model_plays_v", np.float64, (MAX_PLAYS,)),
        ("sums", np.float64, (LANES,)),
        ("dead_band_direction", np.float64),
    ]
)


@jit_inline
def play_output(value, threshold, last):
    """Return the output of the play operator of half-width `threshold` ≥ 0 for `value` after the output `last`.

    Comparisons compute it: NaN as `value` gives `last`, and −0 is the same on every machine.
    """
    low = value - threshold
    high = value + threshold
    raised = low if low > last else last
    return high if high < raised else raised


@jit_inline
def four_plays(value, thresholds, last, i):
    """Return the outputs of plays number i … i + 3 for `value` after the states `last`; the plays do not move."""
    return (
        play_output(value, thresholds[i], last[i]),
        play_output(value, thresholds[i + 1], last[i + 1]),
        play_output(value, thresholds[i + 2], last[i + 2]),
        play_output(value, thresholds[i + 3], last[i + 3]),
    )


@jit
def plays_sum(value, thresholds, weights, plays, count, sums):
    """Return Σ w_i F_i[value]: the outputs of the first `count` plays for `value`, times `weights`. No play moves.

    `plays` are the states of the plays, `count` is a multiple of LANES. Four partial sums, stored in `sums`: s[i mod 4]
    += w_i F_i[value] for i = 0 … count − 1, then (s0 + s1) + (s2 + s3).
    """
    first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
    for block in range(count // LANES):
        i = block * LANES
        first_play, second_play, third_play, fourth_play = four_plays(value, thresholds, plays, i)
        first += weights[i] * first_play
        second += weights[i + 1] * second_play
        third += weights[i + 2] * third_play
        fourth += weights[i + 3] * fourth_play
    return sum_lanes(sums, first, second, third, fourth)


@jit
def move_and_sum_plays(value, thresholds, weights, plays, count, sums):
    """Move the first `count` plays to `value`; return their weighted sum Σ w_i F_i[value], summed as by `plays_sum`."""
    first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
    for block in range(count // LANES):
        i = block * LANES
        first_play, second_play, third_play, fourth_play = four_plays(value, thresholds, plays, i)
        first += weights[i] * first_play
        second += weights[i + 1] * second_play
        third += weights[i + 2] * third_play
        fourth += weights[i + 3] * fourth_play
        plays[i], plays[i + 1], plays[i + 2], plays[i + 3] = first_play, second_play, third_play, fourth_play
    return sum_lanes(sums, first, second, third, fourth)


@jit
def move_plays(value, thresholds, plays, count):
    """Move the first `count` plays, a multiple of LANES, with the states `plays`, to `value`."""
    for block in range(count // LANES):
        i = block * LANES
        plays[i], plays[i + 1], plays[i + 2], plays[i + 3] = four_plays(value, thresholds, plays, i)


@jit
def inverse_drive(c, s, command_um):
    """Return the inverse's drive in V for a command in µm, with the dead band added in its direction if there is one.

    No play moves; the dead band's direction, in the state, may change.
    """
    drive = plays_sum(
        command_um, c.inverse_thresholds_um, c.inverse_weights_v_per_um, s.inverse_plays_um, c.play_count, s.sums
    )
    if c.dead_band_v > 0.0:
        if drive > s.model_plays_v[0] + c.dead_band_threshold_v:
            s.dead_band_direction = 1.0
        elif drive < s.model_plays_v[0] - c.dead_band_threshold_v:
            s.dead_band_direction = -1.0
        drive += s.dead_band_direction * c.dead_band_v
    return drive


@jit
def update_model(c, s, drive_v):
    """Move the model's plays to the applied drive, and the inverse's plays to the command in µm that the model gives
    for this drive; return this command.
    """
    applied_um = move_and_sum_plays(
        drive_v, c.model_thresholds_v, c.model_weights_um_per_v, s.model_plays_v, c.play_count, s.sums
    )
    move_plays(applied_um, c.inverse_thresholds_um, s.inverse_plays_um, c.play_count)
    return applied_um


@jit
def enter_at_drive(c, s, drive_v):
    """Set the dead band's direction, −1 … 1, to the place of `drive_v` (V) within the band; no play moves.

    Another mode of the loop may have left the drive anywhere in the band. The state stays if there is no dead band.
    """
    if c.dead_band_v > 0.0:
        s.dead_band_direction = (drive_v - s.model_plays_v[0]) / c.dead_band_v


class PrandtlIshlinskii(Feedforward):
    """Feedforward u = P̂⁻¹[v], which compensates the actuator's hysteresis (Kuhnen 2003)."""

    kind = "prandtl_ishlinskii"
    options_model = PrandtlIshlinskiiOptions
    coefficients, state = COEFFICIENTS, STATE
    allowed_coefficients = MappingProxyType({"play_count": Allowed(0, MAX_PLAYS, LANES)})
    shipped = True
    output, update, enter = inverse_drive, update_model, enter_at_drive

    def build(self) -> Mapping[str, float | Real]:
        """Return thresholds and weights of the model and of its inverse, `play_count`, `dead_band_v` and
        `dead_band_threshold_v`.

        Thresholds and weights are `model_thresholds_v`, `model_weights_um_per_v`, `inverse_thresholds_um` and
        `inverse_weights_v_per_um`, each (plays,); the record has zeros behind them. `play_count` is rounded up to a
        multiple of LANES. `dead_band_v` is 0 unless the option `dead_band` is "exact".
        """
        options: PrandtlIshlinskiiOptions = self.options
        forward, inverse = options.models()
        return {
            "play_count": -(-forward.weights.size // LANES) * LANES,
            "model_thresholds_v": forward.thresholds,
            "model_weights_um_per_v": forward.weights,
            "inverse_thresholds_um": inverse.thresholds,
            "inverse_weights_v_per_um": inverse.weights,
            "dead_band_v": forward.thresholds[0] if options.dead_band == "exact" else 0.0,
            "dead_band_threshold_v": options.dead_band_threshold_v,
        }
