"""The axis of a configuration whose point is not the law: a gain for the hysteresis, and perhaps an integrator."""

from __future__ import annotations


def wired(input_name: str, output_name: str) -> str:
    """The channels of axis x: ten micrometres a volt."""
    return f"""[driver.channels.x]
input = "{input_name}"
output = "{output_name}"
um_per_v = 10.0
"""


def one_axis(gain: float | None = None, pole_rad_s: float = 0.0, um_per_v: float = 4.3) -> str:
    """[[axis]] x on `um_per_v`, with C(s) = gain/(s − pole) if there is a gain."""
    controller = f"""[axis.controller]
form = "zpk"
gain = {gain}
poles = [[{pole_rad_s}, 0.0]]
"""
    return f"""[[axis]]
name = "x"
[axis.feedforward]
thresholds_v = [0.0]
weights_um_per_v = [{um_per_v}]
{"" if gain is None else controller}"""
