"""The rig: coefficients and state of every axis as fixed records, and the two kernels that advance them.

    sample    the reading of an axis's ADC at the instant of tick k
    advance   all axes from tick k to k + 1, with the DACs at the values written in tick k

Axes may be coupled, as in a stage with compliant guides: the dynamics of axis i are driven by its own displacement and
k_ij times the displacement of each other axis, y_i + Σ k_ij y_j.

One record has room for every rig that the options allow: the kernels compile once. The rig has no clock and no thread;
time is the number of calls of `advance`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache

import numpy as np

from rtloop.foundation.modal import modal_sum
from rtloop.foundation.native.compiled import jit
from rtloop.hil.options import DynamicsOptions, HysteresisOptions, PlantOptions, RigOptions
from rtloop.hil.stages import bouc_wen, converters, creep, disturbance, dynamics, fault, hysteresis, noise, sensor

MAX_COUPLED = 16
"""Largest number of axes of a rig with coupling."""
DYNAMICS_KEPT = 16
"""Dynamics whose coefficients are kept for further rigs with the same: other axes, other experiments."""
_STAGES = (converters, hysteresis, bouc_wen, creep, disturbance, dynamics, sensor, noise, fault)

COEFFICIENTS = np.dtype(
    [
        *(field for stage in _STAGES for field in stage.COEFFICIENTS),
        ("coupled_count", "i8"),  # how many axes of the rig may move this one: all or none
        ("coupling", "f8", (MAX_COUPLED,)),
    ],
    align=True,
)
"""Coefficients of one axis, constant while it runs."""

STATE = np.dtype(
    [
        *(field for stage in _STAGES for field in stage.STATE),
        ("hysteresis_um", "f8"),  # y: hysteresis and creep, without the disturbance, in the period that ends here
        ("true_position_um", "f8"),  # x, as no sensor sees it
    ],
    align=True,
)
"""State of one axis, with its true position and hysteresis, which no sensor shows."""


def build_rig(options: RigOptions, axes: Sequence[str], period_s: float) -> tuple[np.recarray, np.recarray]:
    """Return coefficients and state, both (len(axes),), of a rig at rest at 0 V, with the memory of `history_v`.

    Raises ValueError for a period that is not finite or not above 0, for repeated axes, for an axis in the options that
    is not one of `axes`, and for a coupling that is not possible. Raises ValueError, which names axis and part, for
    dynamics or a disturbance that cannot be discretised at this period.
    """
    if not (math.isfinite(period_s) and period_s > 0):
        raise ValueError(f"period_s: {period_s} s; allowed: a finite number above 0")
    if len(set(axes)) != len(axes):
        raise ValueError(f"axes: {list(axes)} names an axis twice; allowed: each axis once")
    for name in options.plants:
        if name not in axes:
            raise ValueError(f"plants.{name}: there is no such axis; allowed: {', '.join(axes) or 'none'}")
    values = np.zeros(len(axes), COEFFICIENTS)
    coefficients = values.view(np.recarray)
    state = np.zeros(len(axes), STATE).view(np.recarray)
    for i, axis in enumerate(axes):
        plant = options.plants.get(axis, options.plant)
        with _prefix_errors(f"axis {axis}"):
            fields = _axis_coefficients(plant, period_s)
        for field, value in fields.items():
            values[field][i] = value
        coefficients["latency_ticks"][i] = options.latency_ticks
        state["noise_word"][i] = noise.seed_word(options.seed, axis)
        state["disturbance_wait"][i] = round(plant.disturbance.start_s / period_s)
        state["cosine_um"][i] = plant.disturbance.sine_um
        state["fault_wait"][i] = round(plant.fault.start_s / period_s)
        if plant.hysteresis.history_v:
            _settle_history(plant.hysteresis.history_v, coefficients[i], state[i])
    _fill_coupling(options, axes, coefficients)
    uncoupled_um = state["hysteresis_um"]
    input_um = uncoupled_um + coefficients["coupling"][:, : len(axes)] @ uncoupled_um[:MAX_COUPLED]
    for i in np.flatnonzero(input_um):
        dynamics.settle(coefficients[i], state[i], float(input_um[i]))
    return coefficients, state


def _fill_coupling(options: RigOptions, axes: Sequence[str], coefficients: np.recarray) -> None:
    """Fill in the coupling of each axis in `coefficients` (axes,), in µm per µm of each other axis.

    Raises ValueError for an unknown axis, for an axis coupled to itself, and for more than MAX_COUPLED axes.
    """
    for name, shares in options.coupling.items():
        for source in (name, *shares):
            if source not in axes:
                raise ValueError(f"coupling.{name}: {source!r} is not an axis; allowed: {', '.join(axes) or 'none'}")
        if name in shares:
            raise ValueError(f"coupling.{name}.{name}: an axis cannot be coupled to itself; remove this key")
        if len(axes) > MAX_COUPLED:
            raise ValueError(
                f"coupling: the rig has {len(axes)} axes; allowed with coupling: at most {MAX_COUPLED} axes"
            )
        coefficients["coupled_count"][axes.index(name)] = len(axes)
        for source, share in shares.items():
            coefficients["coupling"][axes.index(name), axes.index(source)] = share


def _settle_history(history_v: Sequence[float], coefficients: np.record, state: np.record) -> None:
    """Set `state` as after slow moves of the actuator to each of `history_v` in turn and to 0 V, with creep ended."""
    displacement_um = 0.0
    for drive_v in (*history_v, 0.0):
        displacement_um = _displacement_um(coefficients, state, drive_v)
    state.lags_um[:] = displacement_um
    state.hysteresis_um = creep.step(coefficients, state, displacement_um)


def _axis_coefficients(plant: PlantOptions, period_s: float) -> dict[str, object]:
    """Return the values of COEFFICIENTS of one axis by field, without latency and coupling.

    Raises ValueError, naming the part, if a part cannot be discretised.
    """
    thresholds_v, weights_um_per_v = play_parameters(plant.hysteresis)
    padding = (0.0,) * (hysteresis.MAX_PLAYS - len(thresholds_v))
    fields: dict[str, object] = {
        "play_count": len(thresholds_v),
        "thresholds_v": (*thresholds_v, *padding),
        "weights_um_per_v": (*weights_um_per_v, *padding),
        "sensor_um_per_v": plant.sensor.um_per_v,
        "sensor_offset_um": plant.sensor.offset_um,
        "sensor_noise_um": plant.sensor.noise_um,
        "sensor_resolution_um": plant.sensor.resolution_um,
        "fault_kind": fault.KINDS.index(plant.fault.kind),
    }
    if plant.hysteresis.bouc_wen is not None:
        fields |= {f"bw_{name}": value for name, value in plant.hysteresis.bouc_wen}
    for name, converter in (("adc", plant.adc), ("dac", plant.dac)):
        span = converters.lsb_and_range(converter.lowest_v, converter.range_v, converter.bits)
        fields |= dict(zip((f"{name}_lsb_v", f"{name}_lowest_v", f"{name}_highest_v"), span, strict=True))
    fields |= creep.discretise(plant.creep.gains, plant.creep.time_constants_s, period_s)
    with _prefix_errors("dynamics"):
        fields |= _dynamics_coefficients(plant.dynamics, plant.sensor.bandwidth_hz, period_s)
    with _prefix_errors("disturbance"):
        omega = plant.disturbance
        fields |= disturbance.discretise(omega.step_um, omega.sine_um, omega.sine_hz, period_s)
    return fields


@lru_cache(DYNAMICS_KEPT)
def _dynamics_coefficients(
    options: DynamicsOptions, sensor_bandwidth_hz: float | None, period_s: float
) -> dict[str, object]:
    """Return the values of COEFFICIENTS that D(s) and the sensor's lag determine, by field.

    Rigs with the same dynamics share the returned dict, which must not be changed. Raises ValueError if D(s) cannot be
    discretised.
    """
    modal = modal_sum(*zeros_poles_gain(options))
    return dynamics.discretise(dynamics.add_sensor_output(modal, sensor_bandwidth_hz), period_s)


@contextmanager
def _prefix_errors(culprit: str) -> Iterator[None]:
    """Prefix the message of a ValueError raised inside with `culprit`."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{culprit}: {error}") from error


def play_parameters(options: HysteresisOptions) -> tuple[Sequence[float], Sequence[float]]:
    """Return thresholds [V] and weights [µm/V] of the plays; both empty for a Bouc-Wen actuator."""
    return hysteresis.NAMED_MODELS.get(options.truth, (options.thresholds_v, options.weights_um_per_v))


def zeros_poles_gain(options: DynamicsOptions) -> tuple[np.ndarray, np.ndarray, float]:
    """Return zeros and poles [rad/s] and gain of D(s), after the options' changes of resonance, damping and gain.

    Raises ValueError if resonance or damping is changed for dynamics without a complex pole pair, with repeated poles
    or with more zeros than poles, and if the changed damping ratio is 1 or more.
    """
    if options.form == "zpk":
        zeros, poles = (np.array([complex(*root) for root in roots]) for roots in (options.zeros, options.poles))
        gain = options.gain or 0.0
    else:
        paper = options.form == "paper"
        zeros, numerator_gain = dynamics.roots_of_factors(dynamics.PAPER_NUMERATOR if paper else options.numerator)
        poles, denominator_gain = dynamics.roots_of_factors(
            dynamics.PAPER_DENOMINATOR if paper else options.denominator
        )
        gain = (dynamics.PAPER_GAIN if paper else options.gain or 0.0) * numerator_gain / denominator_gain
    shift, damping_factor = options.resonance_shift, options.damping_factor
    if shift or damping_factor != 1:
        poles, gain = dynamics.change_resonance(zeros, poles, gain, shift, damping_factor)
    return zeros, poles, gain * options.gain_factor


@jit
def sample(coefficients, state):
    """Return the ADC's reading [V] at this instant and store the true position in `state`.

    Each call draws noise if the sensor has any.
    """
    true_um, sensed_um = dynamics.observe(coefficients, state)
    state.true_position_um = true_um
    reading_v = converters.digitise(coefficients, sensor.read(coefficients, state, sensed_um))
    return fault.change_reading(coefficients, state, reading_v)


@jit
def advance(coefficients, state, dac_v):
    """Advance all axes by one period, with `dac_v` [V] written to the DACs at its begin; NaN holds the last value."""
    for i in range(coefficients.shape[0]):
        actuator_v = fault.change_drive(
            coefficients[i], state[i], converters.write_dac(coefficients[i], state[i], dac_v[i])
        )
        displacement_um = _displacement_um(coefficients[i], state[i], actuator_v)
        state[i].hysteresis_um = creep.step(coefficients[i], state[i], displacement_um)
    for i in range(coefficients.shape[0]):
        input_um = _coupled_displacement_um(coefficients, state, i) + disturbance.step(coefficients[i], state[i])
        dynamics.step(coefficients[i], state[i], input_um)


@jit
def _displacement_um(coefficients, state, actuator_v):
    """Move the actuator's hysteresis to `actuator_v` [V] and return its displacement [µm] before creep.

    The Bouc-Wen model gives the displacement of a Bouc-Wen actuator, the sum of plays that of any other.
    """
    if coefficients.bw_um_per_v != 0.0:
        return bouc_wen.step(coefficients, state, actuator_v)
    return hysteresis.step(coefficients, state, actuator_v)


@jit
def _coupled_displacement_um(coefficients, state, i):
    """Return the displacement [µm] of axis `i` plus, for each axis j, the coupling k_ij times j's displacement."""
    total_um = state[i].hysteresis_um
    for j in range(coefficients[i].coupled_count):
        total_um += coefficients[i].coupling[j] * state[j].hysteresis_um
    return total_um
