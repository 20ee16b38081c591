"""The axis of a configuration whose point is not the law: an integrator, and a gain for the hysteresis."""

from __future__ import annotations


def one_axis(gain: float, pole_rad_s: float = 0.0) -> str:
    """[[axis]] x with C(s) = gain/(s − pole) on 4.3 µm/V."""
    return f"""[[axis]]
name = "x"
[axis.feedforward]
thresholds_v = [0.0]
weights_um_per_v = [4.3]
[axis.controller]
form = "zpk"
gain = {gain}
poles = [[{pole_rad_s}, 0.0]]
"""
