"""Whether identified dynamics explain their recording; a model that fits noise, drift or a wrong input is refused."""

from __future__ import annotations

import numpy as np

from rtloop.design.identification.axis_recording import UnsuitableData, wrong_sign
from rtloop.design.identification.dynamics.dynamics_fit import DynamicsFit
from rtloop.design.identification.dynamics.excitation import LoopExcitation
from rtloop.design.identification.dynamics.identify_delay import delay_input
from rtloop.design.identification.dynamics.prediction_error import Excitation

LARGEST_GAIN_STD = 0.1
"""Largest standard deviation of the static gain, relative to it."""
LARGEST_SHARE = 100.0
"""Largest contribution of a mode to D(0): beyond it, modes cancel each other, and no recording tells them apart."""
LEAST_FIT_PERCENT = 50.0
"""Least share of an open loop's motion that the model explains; noise is below a fiftieth of it."""


def require_plausible(run: Excitation, fit: DynamicsFit) -> None:
    """Raise UnsuitableData for a drift that explains more than the model, an uncertain gain, modes that cancel each
    other, in open loop a model that explains less than half of the motion, and last for a gain below 0.
    """
    model_um = fit.model.simulate_output(delay_input(run, fit.delay_ticks).input)
    free_um = 0.0 if fit.free_motion_um is None else fit.free_motion_um
    time = np.linspace(-0.5, 0.5, run.position_um.size)
    drift_um = float(np.polyfit(time, run.position_um - free_um - model_um, 1)[0])
    if drift_um**2 / 12 > np.var(model_um):
        raise UnsuitableData(
            f"{run.name}: the position drifts by {drift_um:.3g} µm, more than the {np.ptp(model_um):.3g} µm that the "
            "input moves it. Use --detrend to subtract a straight line, a larger drive, or a stage that has settled"
        )
    gain, gain_std = fit.static_gain, fit.static_gain_std
    if not gain_std <= LARGEST_GAIN_STD * abs(gain):
        raise UnsuitableData(
            f"{run.name}: the static gain is uncertain: {gain:.3g} ± {gain_std:.2g}; allowed: a standard deviation of "
            f"up to {100 * LARGEST_GAIN_STD:g} % of it. Use a longer recording, a larger drive, or --detrend"
        )
    largest = max(fit.modes, key=lambda mode: mode.static_share)
    if largest.static_share > LARGEST_SHARE:
        raise UnsuitableData(
            f"{run.name}: the modes cancel each other: the mode at {largest.frequency_hz:.4g} Hz contributes "
            f"{largest.static_share:.3g} times the static gain; allowed: up to {LARGEST_SHARE:g} times. Use --order "
            "with fewer poles, or a drive that excites more frequencies"
        )
    if fit.fit_percent < LEAST_FIT_PERCENT and not _is_controlled(run):
        raise UnsuitableData(
            f"{run.name}: the model explains {fit.fit_percent:.3g} % of the motion; allowed: at least "
            f"{LEAST_FIT_PERCENT:g} %. Something else than the input moves the position, or the input is not the one "
            "that the stage received: check the mapping of drive and position, or use --detrend"
        )
    if gain < 0:
        raise wrong_sign(run.name, f"the position falls where the drive rises, by {-gain:.3g} ± {gain_std:.2g}")


def _is_controlled(run: Excitation) -> bool:
    """Whether a controller made the input, which noise then moves too."""
    return isinstance(run, LoopExcitation) and not np.array_equal(run.external[0], run.input)
