"""Options of the rig in TOML, and the messages about wrong options."""

from __future__ import annotations

import tomllib

import pytest
from pydantic import ValidationError

from rtloop.hil.options import PlantOptions, RigOptions
from rtloop.hil.rig import build_rig

EVERYTHING = """
seed = 3
latency_ticks = 2
[plant.hysteresis]
truth = "custom"
thresholds_v = [0, 0.5, 1]
weights_um_per_v = [4, 1, 2]
history_v = [10, -5]
[plant.creep]
gains = [0.05]
time_constants_s = [30]
[plant.dynamics]
form = "factors"
gain = 4e5
denominator = [[1, 40, 4e5]]
resonance_shift = -0.02
[plant.sensor]
um_per_v = 20
offset_um = 1
noise_um = 0
resolution_um = 0
bandwidth_hz = 5000
[plant.adc]
range_v = 5
bits = 12
[plant.dac]
bits = 0
[plants.y.dynamics]
form = "zpk"
gain = 100
poles = [[-100, 0]]
"""


def rig(text: str) -> RigOptions:
    """Return the options of a rig from a TOML text."""
    return RigOptions.model_validate(tomllib.loads(text))


def test_all_options_can_be_set_in_toml():
    options = rig(EVERYTHING)
    coefficients, state = build_rig(options, ["x", "y"], 1e-4)
    assert list(coefficients.play_count) == [3, 15]
    assert list(coefficients.mode_count) == [2, 1]
    assert list(coefficients.latency_ticks) == [2, 2]
    assert state.hysteresis_um[0] != 0 == state.hysteresis_um[1]


def test_options_survive_serialisation():
    options = rig(EVERYTHING)
    assert RigOptions.model_validate(options.model_dump()) == options
    assert RigOptions.model_validate_json(options.model_dump_json()) == options


def test_defaults_are_the_papers():
    plant = RigOptions().plant
    assert plant == PlantOptions()
    assert (plant.hysteresis.truth, plant.sensor.um_per_v, plant.sensor.resolution_um) == ("residual", 10.0, 0.010)
    assert (plant.adc.range_v, plant.adc.bits, plant.sensor.bandwidth_hz) == (10.0, 16, None)


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        ("sed = 1", "sed", "Extra inputs are not permitted"),
        ("seed = -1", "seed", "greater than or equal to 0"),
        ("seed = 1.5", "seed", "valid integer"),
        ("latency_ticks = 17", "latency_ticks", "less than or equal to 16"),
        ('plant.hysteresis.truth = "real"', "plant.hysteresis.truth", "'residual', 'nominal', 'custom' or 'bouc-wen'"),
        ('plant.hysteresis.truth = "custom"', "plant.hysteresis", "thresholds_v has 0 numbers; allowed: 1 to 64"),
        (
            "plant.hysteresis.thresholds_v = [1]",
            "plant.hysteresis",
            "thresholds_v is set, but truth is 'residual'; remove thresholds_v, or set truth = 'custom'",
        ),
        (
            'plant.hysteresis = {truth="custom", thresholds_v=[1, 1], weights_um_per_v=[1, 1]}',
            "plant.hysteresis",
            r"thresholds_v: \[1.0, 1.0\] V; allowed: increasing numbers, 0 or more",
        ),
        (
            'plant.hysteresis = {truth="custom", thresholds_v=[-1], weights_um_per_v=[1]}',
            "plant.hysteresis",
            r"thresholds_v: \[-1.0\] V; allowed: increasing numbers, 0 or more",
        ),
        (
            'plant.hysteresis = {truth="custom", thresholds_v=[0, 1], weights_um_per_v=[1]}',
            "plant.hysteresis",
            "weights_um_per_v has 1 numbers; allowed: one for each of 2 thresholds",
        ),
        ("plant.dynamics.gain = 1", "plant.dynamics", "gain is 1.0 with form 'paper'"),
        ('plant.dynamics.form = "zpk"', "plant.dynamics", "gain is None with form 'zpk'"),
        ("plant.dynamics.poles = [[-1, 0]]", "plant.dynamics", "poles is set, but form is 'paper'"),
        ("plant.dynamics.resonance_shift = -1", "plant.dynamics.resonance_shift", "greater than or equal to -0.9"),
        (
            'plant.dynamics = {form="factors", gain=1, denominator=[[0, 1]]}',
            "plant.dynamics",
            r"a factor of numerator or denominator is \[0.0, 1.0\]; allowed: a first number other than 0",
        ),
        ("plant.creep.gains = [0.1]", "plant.creep", "gains has 1 numbers, time_constants_s has 0"),
        (
            "plant.creep = {gains=[0.1], time_constants_s=[0]}",
            "plant.creep",
            "time_constants_s: .* allowed: numbers above 0",
        ),
        ("plant.sensor.um_per_v = 0", "plant.sensor.um_per_v", "other than 0"),
        ('plant.sensor.um_per_v = "10"', "plant.sensor.um_per_v", "valid number"),
        ("plant.sensor.noise_um = nan", "plant.sensor.noise_um", "finite number|greater than or equal"),
        ("plant.sensor.offset_um = inf", "plant.sensor.offset_um", "finite number"),
        ("plant.hysteresis.history_v = [inf]", "plant.hysteresis.history_v.0", "finite number"),
        ("plant.adc.bits = 33", "plant.adc.bits", "less than or equal to 32"),
        ("plant.dac.range_v = -10", "plant.dac.range_v", "greater than 0"),
    ],
)
def test_mistakes_are_named(text, place, message):
    with pytest.raises(ValidationError, match=message) as caught:
        rig(text)
    assert [".".join(map(str, error["loc"])) for error in caught.value.errors()] == [place]


@pytest.mark.parametrize(
    ("axes", "period_s", "message"),
    [
        (["x"], 0.0, "period_s: 0.0 s; allowed: a finite number above 0"),
        (["x"], float("nan"), "period_s: nan"),
        (["x", "x"], 1e-4, "names an axis twice"),
        (["z"], 1e-4, "plants.y: there is no such axis; allowed: z"),
    ],
)
def test_build_errors_name_the_fault(axes, period_s, message):
    with pytest.raises(ValueError, match=message):
        build_rig(rig("[plants.y]"), axes, period_s)
