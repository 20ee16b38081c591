"""The complete rig: its behaviour at limits, and equal bytes with compiled and uncompiled kernels."""

from __future__ import annotations

import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from rtloop.hil.options import (
    CreepOptions,
    DisturbanceOptions,
    DynamicsOptions,
    HysteresisOptions,
    PlantOptions,
    RigOptions,
    SensorOptions,
)
from rtloop.hil.rig import COEFFICIENTS, STATE, advance, build_rig, sample

EXERCISE = """
import hashlib
import numpy as np
from rtloop.hil.options import CreepOptions, PlantOptions, RigOptions, SensorOptions
from rtloop.hil.rig import advance, build_rig, sample

plant = PlantOptions(
    creep=CreepOptions(gains=(0.1,), time_constants_s=(0.05,)),
    sensor=SensorOptions(bandwidth_hz=1500.0, offset_um=0.3),
)
coefficients, state = build_rig(RigOptions(plant=plant, latency_ticks=2, seed=5), ["x", "y"], 1e-4)
out = []
for k in range(400):
    out += [float(sample(coefficients[i], state[i])) for i in range(2)]
    advance(coefficients, state, np.full(2, float("nan") if k == 77 else (k * 37 % 500) / 25.0 - 10.0))
print(hasattr(sample, "py_func"), hashlib.sha256(np.array(out).tobytes() + state.tobytes()).hexdigest())
"""


def run_exercise(disable_jit: bool) -> list[str]:
    """Run EXERCISE in a new process; return its output: "True" if the kernels were compiled, digest of all bytes."""
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path), NUMBA_DISABLE_JIT=str(int(disable_jit)))
    command = [sys.executable, "-W", "error", "-c", EXERCISE]
    return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.split()


def test_uncompiled_kernels_give_the_same_bytes():
    compiled, uncompiled = run_exercise(disable_jit=False), run_exercise(disable_jit=True)
    assert (compiled[0], uncompiled[0]) == ("True", "False")
    assert compiled[1] == uncompiled[1]


def test_the_comparison_in_bytes_can_fail(run):
    """A difference of one LSB of the DAC in one tick of 200 changes the bytes."""
    drive = 9 * np.sin(np.arange(200) / 20)
    changed = drive + 20 / 2**16 * (np.arange(200) == 20)
    quiet = RigOptions(plant=PlantOptions(sensor=SensorOptions(noise_um=0.0, resolution_um=0.0)))
    first, same, different = (run(signal, quiet).true_um.tobytes() for signal in (drive, drive, changed))
    assert first == same != different


def test_full_square_wave_at_the_resonance(run):
    """±10 V at 595.5 Hz drives the tip to about 376 µm, against 43 µm at rest: the drive limit protects no actuator."""
    period = 1e-5
    t = period * np.arange(100_000)
    drive = np.where(t * 595.5 % 1 < 0.5, 10.0, -10.0)
    options = RigOptions(plant=PlantOptions(hysteresis=HysteresisOptions(truth="nominal")))
    peak = np.abs(run(drive, options, period).true_um).max()
    assert peak == pytest.approx(376, abs=4)


def test_a_rig_at_rest_reads_its_noise_only(run):
    signals = run(np.zeros(10_000))
    assert not signals.true_um.any()
    assert not signals.hysteresis_um.any()
    # 10 nm of noise rounded to 10 nm: √(10² + 10²/12) nm = 10.4 nm, at 10 µm/V.
    assert 1e4 * signals.adc_v.std() == pytest.approx(10.4, rel=0.05)


def test_disturbance_is_added_after_the_hysteresis(ideal):
    coefficients, state = build_rig(ideal(), ["x"], 1e-4)
    state[0].disturbance_um = 2.0
    for _ in range(10_000):
        advance(coefficients, state, np.array([3.0]))
    sample(coefficients[0], state[0])
    assert state[0].hysteresis_um == 3.0
    # D(0) of eq (5).
    assert state[0].true_position_um == pytest.approx(1.01086419 * 5.0, abs=1e-7)


def test_disturbance_of_the_options(run, ideal):
    """0.5 + 2 sin(2π·50·(t − 0.01 s)) µm from tick 100 on, through a rigid plant, with one period of delay."""
    options = ideal(
        dynamics=DynamicsOptions(form="zpk", gain=1.0),
        disturbance=DisturbanceOptions(step_um=0.5, sine_um=2.0, sine_hz=50.0, start_s=0.01),
    )
    signals = run(np.zeros(5001), options).true_um[1:]
    t = 1e-4 * np.arange(5000)
    expected = np.where(np.arange(5000) >= 100, 0.5 + 2 * np.sin(2 * np.pi * 50 * (t - 0.01)), 0.0)
    np.testing.assert_allclose(signals, expected, rtol=0, atol=1e-11)


def test_disturbance_faster_than_half_the_rate_is_refused(ideal):
    with pytest.raises(
        ValueError, match="axis x: disturbance: sine_hz: 6000 Hz; allowed: less than 5000 Hz, half the rate"
    ):
        build_rig(ideal(disturbance=DisturbanceOptions(sine_um=1.0, sine_hz=6000.0)), ["x"], 1e-4)


def test_nan_leaves_the_rig_as_holding_does():
    rigs = [build_rig(RigOptions(), ["x"], 1e-4) for _ in range(2)]
    for (coefficients, state), value in zip(rigs, (float("nan"), 5.0), strict=True):
        for drive in (5.0, value, value, 1.0):
            advance(coefficients, state, np.array([drive]))
    assert rigs[0][1].tobytes() == rigs[1][1].tobytes()


def test_infinite_drive_is_clipped(run):
    assert np.isfinite(run(np.array([np.inf, -np.inf, np.inf, 0.0])).true_um).all()


def test_memory_of_creep_and_hysteresis_is_at_rest(run):
    """An actuator with a history and creep neither moves nor creeps at 0 V."""
    plant = PlantOptions(
        hysteresis=HysteresisOptions(history_v=(10.0, -4.0)), creep=CreepOptions(gains=(0.2,), time_constants_s=(0.01,))
    )
    signals = run(np.zeros(300), RigOptions(plant=plant))
    np.testing.assert_allclose(signals.true_um, signals.true_um[0], rtol=1e-9)
    assert signals.true_um[0] != 0


def test_axes_are_independent():
    """A drive of x does not move y; options in `plants` apply only to the axis that they name."""
    options = RigOptions(plants={"y": PlantOptions(hysteresis=HysteresisOptions(truth="nominal"))})
    coefficients, state = build_rig(options, ["x", "y"], 1e-4)
    assert coefficients[0].weights_um_per_v[0] == 2.3834
    assert coefficients[1].weights_um_per_v[0] == 2.55
    before = state[1].tobytes()
    advance(coefficients, state, np.array([10.0, np.nan]))
    assert state[1].tobytes() == before
    assert state[0].tobytes() != before


def test_kernels_leave_the_coefficients_alone():
    coefficients, state = build_rig(RigOptions(latency_ticks=1), ["x"], 1e-4)
    before = coefficients.tobytes()
    for k in range(100):
        sample(coefficients[0], state[0])
        advance(coefficients, state, np.array([k / 10]))
    assert coefficients.tobytes() == before


def test_numba_types_of_records_equal_those_of_the_dtypes():
    """A kernel can be compiled for the dtypes and called on a rig's records."""
    coefficients, state = build_rig(RigOptions(), ["x"], 1e-4)
    assert numba.typeof(coefficients[0]) == numba.from_dtype(COEFFICIENTS)
    assert numba.typeof(state[0]) == numba.from_dtype(STATE)
