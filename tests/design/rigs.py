"""Rigs drawn at random, what they do, and how far an identified model is from the truth that was drawn.

Everything that judges here is the rig's own: its play operators step by step, its poles, its D(0).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rtloop.design.identification.axis_recording import AxisRecording
from rtloop.design.identification.dynamics.identify_dynamics import DynamicsFit, identify_dynamics
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.design.identification.hysteresis.identify_hysteresis import HysteresisFit, identify_hysteresis
from rtloop.foundation.native.compiled import jit
from rtloop.hil.options import (
    ConverterOptions,
    DynamicsOptions,
    HysteresisOptions,
    PlantOptions,
    RigOptions,
    SensorOptions,
)
from rtloop.hil.rig import advance, build_rig, sample, zeros_poles_gain
from rtloop.hil.stages.hysteresis import NOMINAL_WEIGHTS_UM_PER_V, THRESHOLDS_V
from rtloop.hil.stages.hysteresis import step as hysteresis_step
from rtloop.hysteresis.compensation import residual_operator
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import model_output

SLOW_S, FAST_S = 1e-3, 1e-4
SENSOR_UM_PER_V = 10.0
EQ_4 = PlayModel(np.array(THRESHOLDS_V), np.array(NOMINAL_WEIGHTS_UM_PER_V))
COMMAND_UM = 40.0


@dataclass(frozen=True)
class Rig:
    """A plant and the truth about it; `d0` is D(0)."""

    options: RigOptions
    weights: np.ndarray[Any, Any]
    thresholds: np.ndarray[Any, Any]
    resonance_hz: float
    damping: float
    d0: float

    def measure(self, drive_v: np.ndarray[Any, Any], period_s: float) -> AxisRecording:
        """The rig driven from rest."""
        coefficients, state = build_rig(self.options, ["x"], period_s)
        adc_v = np.empty(drive_v.size)
        _record(coefficients, state, drive_v, adc_v)
        position = SENSOR_UM_PER_V * adc_v
        return AxisRecording("rig", period_s, drive_v, position, position, True, "", "")

    def static_um(self, drive_v: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Position at rest, D(0)·P[u], sample by sample from the rig's own plays."""
        coefficients, state = build_rig(self.options, ["x"], 1.0)
        found = np.empty(drive_v.size)
        _hysteresis(coefficients[0], state[0], drive_v, found)
        return self.d0 * found


class Closeness(NamedTuple):
    """Identified against drawn, in percent (except `order`); ξ in µm and as the part of it that was reached."""

    loop_percent: float
    resonance_percent: float
    damping_percent: float
    gain_percent: float
    order: int
    xi_um: float
    truth_sine: float
    truth_worst: float
    identified_sine: float
    identified_worst: float


def drawn(seed: int, *, moved_thresholds: float = 0.0) -> Rig:
    """Weights of eq (4) ± 20 % each, resonance ± 10 %, noise, resolution, offset, 16 bit; and thresholds moved."""
    random = np.random.default_rng(seed)
    weights = np.array(NOMINAL_WEIGHTS_UM_PER_V) * random.uniform(0.8, 1.2, len(NOMINAL_WEIGHTS_UM_PER_V))
    gaps = np.diff(THRESHOLDS_V, prepend=0.0) * random.uniform(1 - moved_thresholds, 1 + moved_thresholds, weights.size)
    thresholds = np.cumsum(gaps) * THRESHOLDS_V[-1] / gaps.sum()
    dynamics = DynamicsOptions(resonance_shift=random.uniform(-0.1, 0.1))
    plant = PlantOptions(
        hysteresis=HysteresisOptions(
            truth="custom", thresholds_v=tuple(thresholds.tolist()), weights_um_per_v=tuple(weights.tolist())
        ),
        dynamics=dynamics,
        sensor=SensorOptions(um_per_v=SENSOR_UM_PER_V, offset_um=random.uniform(-1, 1), noise_um=0.010),
        adc=ConverterOptions(bits=16),
    )
    zeros, poles, gain = zeros_poles_gain(dynamics)
    light = poles[np.argmin(np.abs(-poles.real / np.abs(poles) - 55 / 2 / 1.4e7**0.5))]
    d0 = float((gain * np.prod(-zeros / 1e4) / np.prod(-poles / 1e4)).real / 1e4)
    return Rig(
        RigOptions(plant=plant, seed=seed),
        weights,
        thresholds,
        float(abs(light)) / (2 * np.pi),
        float(-light.real / abs(light)),
        d0,
    )


def slow_sine(volts: float = 10.0, periods: float = 2.5) -> np.ndarray[Any, Any]:
    """0.1 Hz from rest at 1 kHz."""
    return volts * np.sin(2 * np.pi * 0.1 * SLOW_S * np.arange(round(periods * 10 / SLOW_S)))


def step_drive(volts: float = 10.0, duration_s: float = 1.0) -> np.ndarray[Any, Any]:
    """0.1 s of rest, then `volts`, at 10 kHz."""
    time_s = FAST_S * np.arange(round(duration_s / FAST_S))
    return np.where(time_s < 0.1, 0.0, volts)


def chirp_drive(volts: float = 1.0, duration_s: float = 2.0) -> np.ndarray[Any, Any]:
    """10 Hz to 2 kHz, logarithmic, at 10 kHz."""
    time_s = FAST_S * np.arange(round(duration_s / FAST_S))
    rate = np.log(200.0) / duration_s
    return volts * np.sin(2 * np.pi * 10.0 * np.expm1(rate * time_s) / rate)


def excited(model: PlayModel, run: AxisRecording) -> Excitation:
    return Excitation(run.name, model_output(model, run.drive_v), run.position_um, run.period_s)


def identified(rig: Rig, **options: Any) -> tuple[HysteresisFit, DynamicsFit]:
    """From a slow sine and a step; `options` of the hysteresis."""
    shape = identify_hysteresis([rig.measure(slow_sine(), SLOW_S)], **options)
    return shape, identify_dynamics(excited(shape.model, rig.measure(step_drive(), FAST_S)))


def closeness(rig: Rig, shape: HysteresisFit, dynamics: DynamicsFit) -> Closeness:
    """Largest error of the loop over its range, resonance, damping, static gain at 10 V; and ξ."""
    drive = slow_sine()
    truth, model = rig.static_um(drive), dynamics.static_gain * model_output(shape.model, drive)
    mode = min(dynamics.modes, key=lambda mode: abs(mode.frequency_hz - rig.resonance_hz))
    top = int(np.argmax(drive))
    actuator = PlayModel(shape.model.thresholds, dynamics.static_gain * shape.model.weights)
    return Closeness(
        100 * float(np.abs(model - truth).max() / np.ptp(truth)),
        100 * (mode.frequency_hz / rig.resonance_hz - 1),
        100 * (mode.damping / rig.damping - 1),
        100 * float(model[top] / truth[top] - 1),
        dynamics.model.order,
        *tightness(rig, actuator, shape.max_error_um),
    )


def tightness(rig: Rig, actuator: PlayModel, error_um: float) -> tuple[float, float, float, float, float]:
    """ξ of the rig's true operator behind the inverse of eq (4), the parts of it that a sine and the worst command
    reach on the rig itself; then the same parts of what the identified operator promises, ξ plus its fit's error."""
    inverse = EQ_4.remove_dead_band().inverse()
    true = residual_operator(PlayModel(rig.thresholds, rig.d0 * rig.weights), inverse, COMMAND_UM)
    found = residual_operator(actuator, inverse, COMMAND_UM)
    xi = true.bound_um(true.gain)
    parts = []
    for operator, allowance in ((true, 0.0), (found, error_um)):
        for commands in (COMMAND_UM * np.sin(np.linspace(0, 5 * np.pi, 4001)), true.worst_commands_um(operator.gain)):
            left = rig.static_um(model_output(inverse, commands)) - operator.gain * commands
            parts.append(float(np.abs(left).max()) / (operator.bound_um(operator.gain) + allowance))
    return xi, *parts


@jit
def _record(coefficients, state, drive_v, adc_v):
    for k in range(drive_v.size):
        adc_v[k] = sample(coefficients[0], state[0])
        advance(coefficients, state, drive_v[k : k + 1])


@jit
def _hysteresis(coefficients, state, drive_v, found_um):
    for k in range(drive_v.size):
        found_um[k] = hysteresis_step(coefficients, state, drive_v[k])
