"""An actuator model with a chosen residual hysteresis behind the inverse of the original model.

The added term is a play at half the drive's range minus the first play, δ·(2 F_{U/2} − F_{r_0}): the output at full
drive is unchanged, and a loop remains in between."""

from __future__ import annotations

import numpy as np

from rtloop.hysteresis.loop_shape import loop_shape
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import loading_curve, model_output

SAMPLES, CYCLES = 2000, 2.5
"""Samples per period of the sine that measures the residual, and its number of periods."""
LARGEST_SHARE = 0.5
"""Largest δ as a fraction of the model's mean slope; the actuator has little in common with its model beyond."""


def add_residual_hysteresis(model: PlayModel, percent: float, drive_v: float) -> PlayModel:
    """Return a changed actuator whose compensation by the inverse of `model` leaves a hysteresis loop.

    The loop is measured over drives of ±`drive_v`. Its height is `percent` % of the range of its output, as in
    `LoopShape.percent`. The inverse is of the model without its dead band. For 0 the model is returned unchanged.

    Raises ValueError unless `percent` is between the residuals of the dead band alone and of δ = LARGEST_SHARE, and if
    the model without its dead band has no inverse.
    """
    if percent == 0:
        return model
    from scipy.optimize import root_scalar  # Importing it takes a quarter of a second, and most stages do not need it.

    reach_um = float(loading_curve(model, drive_v))
    command_um = reach_um * np.sin(np.linspace(0, 2 * np.pi * CYCLES, round(SAMPLES * CYCLES)))
    drives_v = np.clip(model_output(model.remove_dead_band().inverse(), command_um), -drive_v, drive_v)

    def residual_percent(share: float) -> float:
        """Return the `LoopShape.percent` that the compensation leaves for δ of `share` times the mean slope."""
        return loop_shape(command_um, model_output(_add_play(model, share, drive_v), drives_v)).percent

    lowest_percent, highest_percent = residual_percent(0.0), residual_percent(LARGEST_SHARE)
    if not lowest_percent < percent < highest_percent:
        raise ValueError(
            f"residual_percent: {percent:g} %; allowed: 0, or above {lowest_percent:.3g} % and below "
            f"{highest_percent:.3g} %"
        )
    share = root_scalar(lambda share: residual_percent(share) - percent, bracket=(0.0, LARGEST_SHARE), xtol=1e-6).root
    return _add_play(model, share, drive_v)


def _add_play(model: PlayModel, share: float, drive_v: float) -> PlayModel:
    """Return the model with δ·(2 F_{U/2} − F_{r_0}) added: δ is `share` times the mean slope, U is `drive_v`."""
    added = share * float(loading_curve(model, drive_v)) / drive_v
    thresholds, place = np.unique(np.append(model.thresholds, 0.5 * drive_v), return_inverse=True)
    weights = np.zeros(thresholds.size)
    np.add.at(weights, place, np.append(model.weights, 2 * added))
    weights[0] -= added
    return PlayModel(thresholds, weights)
