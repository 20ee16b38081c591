"""Coefficients of an axis's laws, limits and interlocks, computed from its options. Every failure occurs here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rtloop.configuration.axis import AxisOptions, InterlockOptions, LimitsOptions, ModelOptions, PrefilterOptions
from rtloop.configuration.laws import DEFAULT_LAWS
from rtloop.drivers.base import Channel
from rtloop.engine.ramp import require_short_ramp
from rtloop.foundation.arrays import Real
from rtloop.kernel.interlocks import INTERLOCK_FIELDS
from rtloop.kernel.layout import TAP_LANES, Records
from rtloop.kernel.memory import new_records
from rtloop.laws.contract import Controller, Law, build_record
from rtloop.laws.linearise import linear_part
from rtloop.laws.options import LawOptions
from rtloop.laws.registry import LawReference, law_class, law_layout
from rtloop.linear.coupled_systems import SampledCoupledSystem


def make_controller(
    axis: AxisOptions, period_s: float, models: Sequence[ModelOptions | None] = ()
) -> Controller | None:
    """Return the controller of an axis; None without one. `axis_coefficients` builds, and may refuse, its coefficients.

    `models` has one entry for each axis of the controller: its model with the delay of its loop, or None. If `models`
    is empty, the controller gets the model of `axis` as the configuration states it.
    """
    if axis.controller is None:
        return None
    model = tuple(models) if len(models) > 1 else models[0] if models else axis.model
    return _law_class(axis.controller, DEFAULT_LAWS[1])(axis.controller, period_s, model)


def _law_class(options: LawOptions, default: LawReference) -> Any:
    """Return the class of the law to which `options` are bound, or the class of `default` if they are bound to none."""
    return law_class(options.law or default)


def axis_coefficients(
    laws: Sequence[LawReference],
    axis: AxisOptions,
    controller: Controller | None,
    um_per_v: float,
    offset_v: float,
    output: Channel,
    period_s: float,
    enable: bool = False,
    place: int = 0,
) -> Records:
    """Return the coefficients (1,) of one axis in a loop that loads `laws`; `enable`: the loop has an enable input.

    An axis that shares a `controller` is number `place` of the controller's axes, from 0. The controller's coefficients
    are in the record of the axis with `place` 0 alone. Raises ValueError for options that do not fit, such as limits
    beyond the channel's range or a controller of too high an order.
    """
    coefficients = new_records(law_layout(laws).coefficients, 1)
    feedforward = _law_class(axis.feedforward, DEFAULT_LAWS[0])(axis.feedforward, period_s, axis.model)
    fields: dict[str, object] = {"um_per_v": um_per_v, "offset_v": offset_v}
    fields |= _law("feedforward", feedforward, laws.index(axis.feedforward.law or DEFAULT_LAWS[0]))
    if controller is None or place > 0:
        fields["controller_law"] = laws.index(DEFAULT_LAWS[1])
    else:
        fields |= _law("controller", controller, laws.index(controller.options.law or DEFAULT_LAWS[1]))
    if controller is not None:
        fields["resting_error"] = _resting_errors(controller)[place]
    fields["controller_axes"] = 0 if place > 0 else 1 if controller is None else controller.count
    fields |= _prefilter(axis.prefilter)
    fields |= limit_fields(axis.limits, output, period_s)
    fields |= interlock_fields(axis.interlocks, enable)
    for name, value in fields.items():
        _assign(coefficients, name, value)
    return coefficients


def _resting_errors(controller: Controller) -> Real:
    """Return the errors per command at rest, C(1)⁻¹, (axes, axes).

    0 for a controller with an integrator, for one whose gain at 0 Hz is at most 1/1000 of its largest gain, and for a
    law that is not linear.
    """
    zeros: Real = np.zeros((controller.count, controller.count))
    try:
        linear = linear_part(controller)
    except ValueError:
        return zeros
    largest_gain = np.abs(linear.system.response(np.exp(2j * np.pi * np.geomspace(1e-3, 0.5, 200)))).max(initial=0.0)
    if not isinstance(linear, SampledCoupledSystem):
        return zeros + 1 / linear.dc_gain if abs(linear.dc_gain) > 1e-3 * largest_gain else zeros
    smallest_gain = np.linalg.svd(linear.dc_gain, compute_uv=False).min()
    return zeros + np.linalg.inv(linear.dc_gain) if smallest_gain > 1e-3 * largest_gain else zeros


def _law(slot: str, law: Law, number: int) -> Mapping[str, object]:
    """Return fields of `slot`: the number of its law in the loop's table, and the law's coefficients as bytes.

    Raises ValueError for options without a solution; its message begins with `slot` and the key that the law names.
    """
    try:
        record = build_record(law)
    except ValueError as error:
        is_key = str(error).partition(":")[0] in type(law.options).model_fields
        raise ValueError(f"{slot}{'.' if is_key else ': '}{error}") from error
    return {f"{slot}_law": number, slot: record.view(np.uint8)}


def _assign(coefficients: Records, name: str, value: object) -> None:
    """Set field `name` of coefficients (1,): a scalar, or the leading elements of an array."""
    numbers = np.asarray(value)
    target = coefficients[name][0]
    if numbers.ndim == 0:
        coefficients[name][0] = numbers
    else:
        target[tuple(slice(0, length) for length in numbers.shape)] = numbers


def _prefilter(options: PrefilterOptions) -> Mapping[str, object]:
    """Return the pre-filter's coefficients by name: `tap_count` and `section_count`, then, if there are any, both rows
    of taps and the sections.

    `tap_count` is the length of the longer row, rounded up to a multiple of TAP_LANES; 0 without taps.
    """
    tap_count = max(len(options.taps), len(options.command_taps))
    fields: dict[str, object] = {
        "tap_count": -(-tap_count // TAP_LANES) * TAP_LANES,
        "section_count": len(options.sections),
    }
    if tap_count:
        fields["taps"] = options.taps or (1.0,)
        fields["command_taps"] = options.command_taps or (0.0,)
    if options.sections:
        fields["sections"] = options.sections
    return fields


def limit_fields(options: LimitsOptions, output: Channel, period_s: float) -> Mapping[str, float]:
    """Return by name: limits of the drive in V and of the command in µm, slews, `safe_v` of the channel, and
    `bump_decay`, a factor per tick.

    Slews are in V per tick; `slew_v_per_tick` is infinite without `slew_v_per_s`. Raises ValueError for a limit
    of the drive beyond the channel's range, and if the ramp after a trip, from the end of the channel's range that is
    farther from `safe_v`, takes longer than LONGEST_RAMP_S.
    """
    lowest_v, highest_v = output.minimum_v, output.maximum_v
    allowed = f"±{highest_v}" if lowest_v == -highest_v else f"{lowest_v} … {highest_v}"
    if options.drive_v > highest_v:
        raise ValueError(f"limits.drive_v: {options.drive_v} V; allowed: within the driver's {allowed} V")
    if options.lowest_v < lowest_v:
        origin = "not set, which means " if options.drive_min_v is None else ""
        value = str(options.lowest_v).replace("-", "−")
        raise ValueError(f"limits.drive_min_v: {origin}{value} V; allowed: within the driver's {allowed} V")
    require_short_ramp("limits.trip_slew_v_per_s", options.trip_slew_v_per_s, output)
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
    """Return INTERLOCK_FIELDS by name, as the kernel compares them; `enable_min_v` is −inf without `enable`.

    Raises ValueError unless sensor_min_v is below sensor_max_v.
    """
    if options.sensor_min_v >= options.sensor_max_v:
        raise ValueError(
            f"interlocks.sensor_min_v: {options.sensor_min_v} V; allowed: below sensor_max_v = {options.sensor_max_v} V"
        )
    return {
        **{name: getattr(options, name) for name, _ in INTERLOCK_FIELDS if hasattr(options, name)},
        "position_limit_um": options.position_um,
        "sample_age_limit_us": options.sample_age_us,
        "enable_min_v": options.enable_min_v if enable else -np.inf,
    }
