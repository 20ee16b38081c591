"""A lightly damped stage of one resonance, driven from 0 to 10 V, and own laws with paths for the reference."""

from __future__ import annotations

import math

RESONANCE_HZ, DAMPING, RANGE_UM, NOISE_UM = 310.0, 0.012, 80.0, 0.003
OMEGA = 2 * math.pi * RESONANCE_HZ
DYNAMICS = f'form = "factors"\ngain = {OMEGA**2!r}\ndenominator = [[1.0, {2 * DAMPING * OMEGA!r}, {OMEGA**2!r}]]\n'
PAPER_DYNAMICS = """form = "factors"
gain = -20.7
numerator = [
    [1.0, -1.22e5], [1.0, 2.99e4], [1.0, -2.776e4], [1.0, -1.07e4], [1.0, 1430.0], [1.0, 4.3e4, 3.2e9],
]
denominator = [[1.0, 925.0, 4.59e5], [1.0, 55.0, 1.4e7], [1.0, 1.54e4, 4.0e9], [1.0, 964.0, 3.95e9]]
"""
"""D(s) of the paper, equation (5)."""
PID = "s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um"


def stage(controller: str, reference: str, noise_um: float = NOISE_UM, dynamics: str = DYNAMICS) -> str:
    """Return the configuration of the stage: 80 µm for 10 V without hysteresis, a sensor of 0 … 10 V.

    `dynamics` are those of model and rig.
    """
    return f"""[loop]
rate_hz = 10000
[driver]
kind = "sim"
seed = 1
latency_ticks = 1
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 8.8
[driver.plant.hysteresis]
truth = "custom"
thresholds_v = [0.0]
weights_um_per_v = [{RANGE_UM / 10}]
[driver.plant.dynamics]
{dynamics}[driver.plant.sensor]
um_per_v = 8.8
noise_um = {noise_um}
resolution_um = 0.0
[[axis]]
name = "x"
[axis.feedforward]
thresholds_v = [0.0]
weights_um_per_v = [{RANGE_UM / 10}]
[axis.controller]
{controller}
[axis.model]
{dynamics}delay_ticks = 1
[axis.limits]
drive_min_v = 0.0
drive_v = 10.0
command_um = {RANGE_UM}
[axis.interlocks]
sensor_min_v = -0.01
position_um = 87.0
[axis.reference]
{reference}
"""


def own_law(output: str, update: str = PID, enter: str = "", state: str = "", coefficients: str = "") -> str:
    """Return the text of a law `lab`: `output` and the lines `update` and `enter` from c, s and told.

    It has the options kp, ki_per_s and feed, as coefficients kp, ki (per tick) and feed, and a state integral_um;
    `state` and `coefficients` add numbers, the latter as name = value.
    """
    more_states = "".join(f', "{name}": float' for name in state.split())
    pairs = [pair.split("=") for pair in coefficients.split()]
    more_names = "".join(f', "{name}": float' for name, _ in pairs)
    more_values = "".join(f', "{name}": {value}' for name, value in pairs)
    body = update.replace("\n", "\n        ")
    text = f"""from rtloop.laws import Controller, ControllerOptions


class LabOptions(ControllerOptions):
    kp: float = 0.0
    ki_per_s: float = 15.0
    feed: float = 0.8


class Lab(Controller):
    options_model = LabOptions
    coefficients = {{"kp": float, "ki": float, "feed": float{more_names}}}
    state = {{"integral_um": float{more_states}}}

    def build(self):
        options = self.options
        return {{"kp": options.kp, "ki": options.ki_per_s * self.period_s, "feed": options.feed{more_values}}}

    def output(c, s, told):
        return {output}

    def update(c, s, told):
        {body}
"""
    lines = enter.replace("\n", "\n        ")
    return text + (f"\n    def enter(c, s, told):\n        {lines}\n" if enter else "")


FEED = own_law(
    "c.kp * told.error_um + s.integral_um + c.feed * told.reference_um",
    enter="s.integral_um = told.command_um - c.kp * told.error_um - c.feed * told.reference_um",
)
"""A PI controller with a static feedforward of the reference, and the entry that the documentation asks for."""
FEED_WITHOUT_ENTER = own_law("c.kp * told.error_um + s.integral_um + c.feed * told.reference_um")
