"""Compiled or not, the law gives the same bits: no fused operation, no reordering, no fast mathematics."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rtloop.kernel.layout import COEFFICIENTS, CONTROL, FUNCTIONS, LAW, LOOP_STATE, RULE, STATE
from rtloop.kernel.reference import GENERATOR
from rtloop.laws.shipped import prandtl_ishlinskii, transfer
from rtloop.signals import Mode
from tests.kernel.harness import EQ_20, EXACT, LawBench, make_coefficients

ROOT = Path(__file__).resolve().parents[2]
TICKS = 600
RECORDS = [
    *(COEFFICIENTS, STATE, LOOP_STATE, CONTROL, FUNCTIONS, LAW, RULE, GENERATOR),
    *(record for law in (prandtl_ishlinskii, transfer) for record in (law.COEFFICIENTS, law.STATE)),
]


def mixed_run() -> bytes:
    """Return the bytes of all signals and of the final state of a run through modes, limits, filters and interlocks."""
    axis = make_coefficients(
        controller=EQ_20,
        feedforward=EXACT,
        prefilter={"taps": [0.6, 0.3, 0.1], "sections": [[0.02, 0.04, 0.02, -1.5, 0.58]]},
        limits={"slew_v_per_s": 9000.0, "command_um": 39.0},
    )
    rng = np.random.default_rng(11)
    modes, resets = np.full(TICKS, -1), np.zeros(TICKS)
    modes[50::50] = [*Mode, *Mode, *Mode][: modes[50::50].size]
    resets[50::50] = 1
    references = 25 * np.sin(np.arange(TICKS) / 15) + rng.normal(0, 1, TICKS)
    adc_v = rng.normal(0, 0.5, TICKS)
    adc_v[[222, 433]] = np.nan, 9.995
    bench = LawBench(axis, Mode.CLOSED_LOOP)
    signals = bench.run(references, adc_v, modes=modes, resets=resets)
    return np.array(signals).tobytes() + bench.state_bytes()


@pytest.mark.parametrize("dtype", RECORDS)
def test_no_field_hides_behind_an_attribute_of_a_record(dtype):
    """numpy's scalars have `flags`, `size`, `data` and more: a field of that name works compiled only."""
    assert not set(dtype.names) & set(dir(np.record))


def test_uncompiled_gives_the_same_bits():
    program = "import sys; from tests.kernel.test_compiled import mixed_run; sys.stdout.buffer.write(mixed_run())"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    uncompiled = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=environment, capture_output=True)
    assert uncompiled.returncode == 0, uncompiled.stderr.decode()
    compiled = mixed_run()
    assert len(compiled) > 7 * 8 * TICKS
    assert uncompiled.stdout == compiled
