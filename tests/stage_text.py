"""Parts of a configuration as TOML, for tests of which the configuration is not the subject."""

from __future__ import annotations


def wired(input_name: str, output_name: str, um_per_v: float = 10.0) -> str:
    """Return the channels of axis x, whose sensor has `um_per_v`."""
    return f"""[driver.channels.x]
input = "{input_name}"
output = "{output_name}"
um_per_v = {um_per_v}
"""


def resonance(omega_rad_s: float, damping: float) -> str:
    """Return the keys of ω²/(s² + 2ζωs + ω²), for a model or the dynamics of a plant."""
    b, c = float(2 * damping * omega_rad_s), float(omega_rad_s**2)
    return f"""form = "factors"
gain = {c!r}
denominator = [[1.0, {b!r}, {c!r}]]
"""


def simulated_stage(
    omega_rad_s: float, damping: float, um_per_v: float, sensor_um_per_v: float = 10.0, **driver_keys: int
) -> str:
    """Return [driver] of a simulated rig: an actuator of `um_per_v` without hysteresis, one mode, and the channels.

    The mode has `omega_rad_s` and `damping`; `driver_keys` are keys of [driver], such as `seed`.
    """
    keys = "".join(f"{key} = {value}\n" for key, value in driver_keys.items())
    return f"""[driver]
kind = "sim"
{keys}{wired("adc0", "dac0", sensor_um_per_v)}[driver.plant.hysteresis]
truth = "custom"
thresholds_v = [0.0]
weights_um_per_v = [{um_per_v}]
[driver.plant.dynamics]
{resonance(omega_rad_s, damping)}"""


def one_axis(gain: float | None = None, pole_rad_s: float = 0.0, um_per_v: float = 4.3) -> str:
    """Return axis x of an actuator without hysteresis, with C(s) = gain/(s − pole) if there is a gain."""
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
