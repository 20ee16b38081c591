"""Fixtures for tests of the rig: a compiled run over a drive, and options of an ideal rig with single real parts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from rtloop.foundation.native.compiled import jit
from rtloop.hil.options import ConverterOptions, HysteresisOptions, PlantOptions, RigOptions, SensorOptions
from rtloop.hil.rig import advance, build_rig, sample

IDEAL: dict[str, Any] = {
    "hysteresis": HysteresisOptions(truth="custom", thresholds_v=(0.0,), weights_um_per_v=(1.0,)),
    "sensor": SensorOptions(um_per_v=1.0, noise_um=0.0, resolution_um=0.0),
    "adc": ConverterOptions(range_v=1e9, bits=0),
    "dac": ConverterOptions(range_v=1e9, bits=0),
}


class RigSignals(NamedTuple):
    """Signals of a run, each of shape (ticks,); entry k is from before the drive of tick k."""

    adc_v: np.ndarray
    true_um: np.ndarray
    hysteresis_um: np.ndarray


@jit
def _simulate(coefficients, state, drive_v, adc_v, true_um, hysteresis_um):
    """Run one axis over the drives and write its signals to the last three arrays."""
    for k in range(drive_v.size):
        adc_v[k] = sample(coefficients[0], state[0])
        true_um[k] = state[0].true_position_um
        hysteresis_um[k] = state[0].hysteresis_um
        advance(coefficients, state, drive_v[k : k + 1])


@pytest.fixture(scope="session")
def run() -> Callable[..., RigSignals]:
    """Return a function that drives one axis, `x`, of a rig from rest and returns its signals."""

    def drive_rig(drive_v: Any, options: RigOptions | None = None, period_s: float = 1e-4) -> RigSignals:
        drive = np.asarray(drive_v, dtype=float)
        coefficients, state = build_rig(options or RigOptions(), ["x"], period_s)
        signals = RigSignals(*(np.empty(drive.size) for _ in RigSignals._fields))
        _simulate(coefficients, state, drive, *signals)
        return signals

    return drive_rig


@pytest.fixture(scope="session")
def ideal() -> Callable[..., RigOptions]:
    """Return a function for options of a rig that is linear, exact and free of noise, except for the given parts."""

    def make(latency_ticks: int = 0, **parts: Any) -> RigOptions:
        return RigOptions(plant=PlantOptions(**{**IDEAL, **parts}), latency_ticks=latency_ticks)

    return make
