"""Rigs drawn at random, their recordings, and the errors of an identified model against the drawn rig.

The errors are measured against the rig itself: its play operators stepped sample by sample, its poles, its D(0).
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
"""Sampling periods of the slow sine, and of the steps and chirps."""
SENSOR_UM_PER_V = 10.0
EQ_4 = PlayModel(np.array(THRESHOLDS_V), np.array(NOMINAL_WEIGHTS_UM_PER_V))
COMMAND_UM = 40.0


@dataclass(frozen=True)
class Rig:
    """A rig's options, and its true weights, thresholds, resonance, damping and `d0` = D(0)."""

    options: RigOptions
    weights: np.ndarray[Any, Any]
    thresholds: np.ndarray[Any, Any]
    resonance_hz: float
    damping: float
    d0: float

    def measure(self, drive_v: np.ndarray[Any, Any], period_s: float) -> AxisRecording:
        """Return a recording of the rig, driven from rest."""
        coefficients, state = build_rig(self.options, ["x"], period_s)
        adc_v = np.empty(drive_v.size)
        record_readings(coefficients, state, drive_v, adc_v)
        position = SENSOR_UM_PER_V * adc_v
        return AxisRecording("rig", period_s, drive_v, position, position, True, "", "")

    def static_um(self, drive_v: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Return the settled position D(0)·P[u] (µm) at each sample, from the rig's own plays."""
        coefficients, state = build_rig(self.options, ["x"], 1.0)
        plays_um = np.empty(drive_v.size)
        _step_hysteresis(coefficients[0], state[0], drive_v, plays_um)
        return self.d0 * plays_um


class ModelErrors(NamedTuple):
    """Errors of an identified model in percent; its order; the true ξ (µm); the parts of the bounds that are reached.

    `truth_…`: parts of the true ξ that a sine and the worst command reach; `identified_…`: of the identified ξ plus the
    fit's error.
    """

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


def draw_rig(seed: int, *, moved_thresholds: float = 0.0) -> Rig:
    """Return a rig: weights of eq (4) ± 20 %, resonance ± 10 %, offset ± 1 µm, 10 nm of noise, ADC of 16 bit.

    The gaps between thresholds vary by the part `moved_thresholds`; the last threshold stays.
    """
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
    light_pole = poles[np.argmin(np.abs(-poles.real / np.abs(poles) - 55 / 2 / 1.4e7**0.5))]
    d0 = float((gain * np.prod(-zeros / 1e4) / np.prod(-poles / 1e4)).real / 1e4)
    return Rig(
        RigOptions(plant=plant, seed=seed),
        weights,
        thresholds,
        float(abs(light_pole)) / (2 * np.pi),
        float(-light_pole.real / abs(light_pole)),
        d0,
    )


def slow_sine(volts: float = 10.0, periods: float = 2.5) -> np.ndarray[Any, Any]:
    """Return a sine of 0.1 Hz (V) from rest, sampled at 1 kHz."""
    return volts * np.sin(2 * np.pi * 0.1 * SLOW_S * np.arange(round(periods * 10 / SLOW_S)))


def step_drive(volts: float = 10.0, duration_s: float = 1.0) -> np.ndarray[Any, Any]:
    """Return a drive (V) of 0 for 0.1 s, then `volts`, sampled at 10 kHz."""
    time_s = FAST_S * np.arange(round(duration_s / FAST_S))
    return np.where(time_s < 0.1, 0.0, volts)


def chirp_drive(volts: float = 1.0, duration_s: float = 2.0) -> np.ndarray[Any, Any]:
    """Return a logarithmic chirp (V) from 10 Hz to 2 kHz, sampled at 10 kHz."""
    time_s = FAST_S * np.arange(round(duration_s / FAST_S))
    rate = np.log(200.0) / duration_s
    return volts * np.sin(2 * np.pi * 10.0 * np.expm1(rate * time_s) / rate)


def model_excitation(model: PlayModel, run: AxisRecording) -> Excitation:
    """Return the hysteresis model's output (µm) for the recorded drive, and the recorded position."""
    return Excitation(run.name, model_output(model, run.drive_v), run.position_um, run.period_s)


def identify_rig(rig: Rig, **options: Any) -> tuple[HysteresisFit, DynamicsFit]:
    """Return hysteresis and dynamics identified from a slow sine and a step; `options` go to `identify_hysteresis`."""
    hysteresis = identify_hysteresis([rig.measure(slow_sine(), SLOW_S)], **options)
    return hysteresis, identify_dynamics(model_excitation(hysteresis.model, rig.measure(step_drive(), FAST_S)))


def model_errors(rig: Rig, hysteresis: HysteresisFit, dynamics: DynamicsFit) -> ModelErrors:
    """Return errors of the loop (largest, of its range), resonance, damping and gain (at the drive's peak), and ξ."""
    drive = slow_sine()
    truth, model = rig.static_um(drive), dynamics.static_gain * model_output(hysteresis.model, drive)
    mode = min(dynamics.modes, key=lambda mode: abs(mode.frequency_hz - rig.resonance_hz))
    peak = int(np.argmax(drive))
    actuator = PlayModel(hysteresis.model.thresholds, dynamics.static_gain * hysteresis.model.weights)
    return ModelErrors(
        100 * float(np.abs(model - truth).max() / np.ptp(truth)),
        100 * (mode.frequency_hz / rig.resonance_hz - 1),
        100 * (mode.damping / rig.damping - 1),
        100 * float(model[peak] / truth[peak] - 1),
        dynamics.model.order,
        *bound_tightness(rig, actuator, hysteresis.max_error_um),
    )


def bound_tightness(rig: Rig, actuator: PlayModel, error_um: float) -> tuple[float, float, float, float, float]:
    """Return ξ (µm) of the true operator behind the inverse of eq (4), then the parts of it that a sine and the worst
    command reach on the rig; then the parts that they reach of the identified ξ plus the fit's error `error_um`."""
    inverse = EQ_4.remove_dead_band().inverse()
    true_operator = residual_operator(PlayModel(rig.thresholds, rig.d0 * rig.weights), inverse, COMMAND_UM)
    identified_operator = residual_operator(actuator, inverse, COMMAND_UM)
    xi = true_operator.bound_um(true_operator.gain)
    parts = []
    for operator, allowance in ((true_operator, 0.0), (identified_operator, error_um)):
        for commands in (
            COMMAND_UM * np.sin(np.linspace(0, 5 * np.pi, 4001)),
            true_operator.worst_commands_um(operator.gain),
        ):
            errors_um = rig.static_um(model_output(inverse, commands)) - operator.gain * commands
            parts.append(float(np.abs(errors_um).max()) / (operator.bound_um(operator.gain) + allowance))
    return xi, *parts


@jit
def record_readings(coefficients, state, drive_v, adc_v):
    """Write the rig's readings (V) into `adc_v`, each sampled before its drive is applied."""
    for k in range(drive_v.size):
        adc_v[k] = sample(coefficients[0], state[0])
        advance(coefficients, state, drive_v[k : k + 1])


@jit
def _step_hysteresis(coefficients, state, drive_v, plays_um):
    """Write the output of the hysteresis (µm) at each sample into `plays_um`."""
    for k in range(drive_v.size):
        plays_um[k] = hysteresis_step(coefficients, state, drive_v[k])
