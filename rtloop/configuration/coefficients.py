"""Coefficients of the law from its options: everything that can fail, fails here."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from rtloop.configuration.axis import AxisOptions, FeedforwardOptions, InterlockOptions, LimitsOptions, PrefilterOptions
from rtloop.drivers.base import Channel
from rtloop.law.layout import BLOCK, COEFFICIENTS, LANES, MAX_ORDER, Records, records
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.realisation import blocks, row_bands


def axis_coefficients(
    axis: AxisOptions,
    controller: DiscreteController | None,
    um_per_v: float,
    offset_v: float,
    output: Channel,
    period_s: float,
    enable: bool = False,
) -> Records:
    """Coefficients (1,) of one axis; `enable` where the loop has an enable input.

    Raises ValueError for what does not fit: limits beyond the channel, a controller of too high an order.
    """
    coefficients = records(COEFFICIENTS, 1)
    fields: dict[str, object] = {"um_per_v": um_per_v, "offset_v": offset_v}
    fields |= _feedforward(axis.feedforward)
    fields |= _controller(controller)
    if axis.controller is not None and controller is not None:
        fields["tracking_share"] = _tracking_share(controller, axis.controller.tracking_s, period_s)
    fields |= _prefilter(axis.prefilter)
    fields |= limit_fields(axis.limits, output, period_s)
    fields |= interlock_fields(axis.interlocks, enable)
    for name, value in fields.items():
        _assign(coefficients, name, value)
    return coefficients


def _assign(coefficients: Records, name: str, value: object) -> None:
    """Set a scalar, or the leading part of an array."""
    numbers = np.asarray(value)
    target = coefficients[name][0]
    if numbers.ndim == 0:
        coefficients[name][0] = numbers
    else:
        target[tuple(slice(0, length) for length in numbers.shape)] = numbers


def _feedforward(options: FeedforwardOptions) -> Mapping[str, object]:
    forward, inverse = options.models()
    return {
        "play_count": -(-forward.weights.size // LANES) * LANES,
        "model_thresholds_v": forward.thresholds,
        "model_weights_um_per_v": forward.weights,
        "inverse_thresholds_um": inverse.thresholds,
        "inverse_weights_v_per_um": inverse.weights,
        "dead_band_v": forward.thresholds[0] if options.dead_band == "exact" else 0.0,
        "dead_band_threshold_v": options.dead_band_threshold_v,
    }


def _controller(controller: DiscreteController | None) -> Mapping[str, object]:
    if controller is None:
        return {}
    order = controller.b.size
    if order > MAX_ORDER:
        raise ValueError(f"controller: order {order}; at most {MAX_ORDER} is allowed")
    places = _places(controller.a)

    def placed(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        vector = np.zeros(MAX_ORDER)
        vector[places] = values
        return vector

    a = np.zeros((MAX_ORDER, MAX_ORDER))
    a[np.ix_(places, places)] = controller.a
    states = np.arange(MAX_ORDER)
    partners = states ^ LANES
    own, partner = a[states, states], a[states, partners]
    a[states, states] = a[states, partners] = 0.0
    bands = row_bands(a)
    return {
        "order": -(-(int(places.max(initial=-1)) + 1) // BLOCK) * BLOCK,
        "own": own,
        "partner": partner,
        "coupling": a,
        "coupled": bool(a.any()),
        "row_start": bands[:, 0],
        "row_stop": bands[:, 1],
        "b": placed(controller.b),
        "c": placed(controller.c),
        "d": controller.d,
        "tracking": placed(controller.antiwindup),
        "steady_state": placed(controller.steady_state_gain),
        "resting_error": _resting_error(controller),
    }


def _resting_error(controller: DiscreteController) -> float:
    """Error per command that keeps C(z) at rest: 1/C(1). 0 with an integrator, and where C hardly passes 0 Hz."""
    hz = np.geomspace(1e-3, 0.5, 200) / controller.period_s
    at_rest, largest = abs(controller.dc_gain), np.abs(controller.response(hz)).max(initial=0.0)
    return 1 / controller.dc_gain if at_rest > 1e-3 * largest else 0.0


def _places(a: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Place of each state in the kernels' order: blocks of four pairs, a pair's two states LANES apart.

    The two states of a 2×2 block of A make a pair, and so do the other states, two by two.
    """
    found = blocks(a)
    pairs = [(block.start, block.start + 1) for block in found if block.stop - block.start == 2]
    single = [block.start for block in found if block.stop - block.start == 1]
    pairs += [tuple(single[i : i + 2]) for i in range(0, len(single), 2)]
    places = np.zeros(a.shape[0], np.int64)
    for number, pair in enumerate(pairs):
        for half, state in enumerate(pair):
            places[state] = number // LANES * BLOCK + number % LANES + half * LANES
    return places


def _tracking_share(controller: DiscreteController, tracking_s: float, period_s: float) -> float:
    """Share of a shortfall that the states take up in a tick. Raises ValueError where that is not stable."""
    share = -math.expm1(-period_s / tracking_s) if tracking_s > 0 else 1.0
    a, m, c = controller.a, controller.antiwindup, controller.c
    radius = np.abs(np.linalg.eigvals(a - share * np.outer(a @ m, c))).max(initial=0.0)
    if not radius < 1:
        raise ValueError(
            f"controller.tracking_s: {tracking_s:g} s leaves its states unstable while the command is limited "
            f"(largest |pole| {radius:.6g}); a smaller one, or 0, is needed"
        )
    return share


def _prefilter(options: PrefilterOptions) -> Mapping[str, object]:
    fields: dict[str, object] = {"tap_count": len(options.taps), "section_count": len(options.sections)}
    if options.taps:
        fields["taps"] = options.taps
    if options.sections:
        fields["sections"] = options.sections
    return fields


def limit_fields(options: LimitsOptions, output: Channel, period_s: float) -> Mapping[str, float]:
    """Limits per tick. Raises ValueError for a drive beyond the channel's range."""
    lowest_v, highest_v = output.minimum_v, output.maximum_v
    allowed = f"±{highest_v}" if lowest_v == -highest_v else f"{lowest_v} … {highest_v}"
    if options.drive_v > highest_v:
        raise ValueError(f"limits.drive_v: {options.drive_v} is outside the driver's {allowed} V")
    if options.lowest_v < lowest_v:
        given = "drive_v: −" if options.drive_min_v is None else "drive_min_v: −"
        raise ValueError(f"limits.{given}{-options.lowest_v} is outside the driver's {allowed} V; set drive_min_v")
    farthest_v = max(highest_v - output.safe_v, output.safe_v - lowest_v)
    if options.trip_slew_v_per_s * LONGEST_RAMP_S < farthest_v:
        took_s, least = farthest_v / options.trip_slew_v_per_s, farthest_v / LONGEST_RAMP_S
        raise ValueError(
            f"limits.trip_slew_v_per_s: {options.trip_slew_v_per_s:g} takes {took_s:.3g} s from {farthest_v:g} V to "
            f"safe; {LONGEST_RAMP_S:g} s, so at least {least:g} V/s, are allowed"
        )
    slew = float("inf") if options.slew_v_per_s is None else options.slew_v_per_s * period_s
    return {
        "drive_min_v": options.lowest_v,
        "drive_max_v": options.drive_v,
        "safe_v": output.safe_v,
        "command_limit_um": options.command_um,
        "slew_v_per_tick": slew,
        "trip_slew_v_per_tick": options.trip_slew_v_per_s * period_s,
        "bump_decay": float(np.exp(-period_s / options.bump_s)),
    }


def interlock_fields(options: InterlockOptions, enable: bool = False) -> Mapping[str, float]:
    """Thresholds as the law compares them."""
    if options.sensor_min_v >= options.sensor_max_v:
        raise ValueError(
            f"interlocks.sensor_min_v: {options.sensor_min_v} must be below sensor_max_v, {options.sensor_max_v}"
        )
    return {
        "sensor_min_v": options.sensor_min_v,
        "sensor_max_v": options.sensor_max_v,
        "position_limit_um": options.position_um,
        "sample_age_limit_us": options.sample_age_us,
        "enable_min_v": options.enable_min_v if enable else -np.inf,
        **{name: getattr(options, name) for name in WATCHED},
    }


LONGEST_RAMP_S = 5.0
"""Of a trip, a stop or a parking, from anywhere in the channel's range to safe."""
WATCHED = (
    *("frozen_drive_v", "frozen_ticks", "tracking_error_um", "tracking_ticks"),
    *("oscillation_um", "oscillation_swings", "swing_ticks", "late_us", "late_ticks"),
)
"""Thresholds of the interlocks with memory: named alike in options and coefficients."""


def joined(parts: Sequence[Records]) -> Records:
    """Coefficients of all axes."""
    return np.concatenate(parts).view(np.recarray)
