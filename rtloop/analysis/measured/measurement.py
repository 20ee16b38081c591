"""Results of a measured run of a closed loop: response, margins, lightly damped mode, gain at rest; as JSON values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rtloop.analysis.closed_loop import Loop
from rtloop.analysis.margins import loop_margins
from rtloop.analysis.measured.gain import StaticGain
from rtloop.analysis.measured.loop import MeasuredLoop, measured_loop
from rtloop.analysis.measured.margins import MeasuredMargins, measured_margins
from rtloop.analysis.measured.mode import BAND, MIN_LINES, LightMode, fit_light_mode
from rtloop.analysis.measured.recorded import find_periodic_part
from rtloop.analysis.measured.response import MeasuredResponse, PeriodSignals, measure_response
from rtloop.foundation.arrays import Real
from rtloop.values import dataclass_fields, to_jsonable

MAX_LINE_SPREAD = 0.1
"""Relative uncertainty up to which a line is compared with the model."""
SIGNALS: tuple[str, ...] = ("reference_um", "error_um", "command_um", "position_um")
"""Signals of an axis that a measurement needs."""
TICK_DRIVEN = "sim"
"""The driver whose rig moves by ticks: a missed period has no effect there."""


@dataclass(frozen=True)
class LoopMeasurement:
    """A response with margins, lightly damped mode, the model's loop, and the gain at rest.

    `mode` is None if no lightly damped mode stands out, `model` without a model, `gain` if it was not measured.
    """

    response: MeasuredResponse
    loop: MeasuredLoop
    margins: MeasuredMargins
    mode: LightMode | None
    model: Loop | None
    gain: StaticGain | None = None

    def figures(self) -> dict[str, object]:
        """Return values for status and metrics, without curves, null for numbers that are not finite.

        Keys: periods, lines (their number), from_hz, to_hz, moved_um, margins ({name: {value, std}}), resonance (the
        fields of LightMode), gain (those of StaticGain), model ({margins: {name: value}, gain_ratio}). The last three
        are None where no mode was found, no gain measured or no model given.
        """
        measured = self.response
        return to_jsonable(
            {
                "periods": measured.periods,
                "lines": measured.hz.size,
                "from_hz": measured.hz[0],
                "to_hz": measured.hz[-1],
                "moved_um": measured.moved_um,
                "margins": self.margins,
                "resonance": self.mode,
                "gain": self.gain,
                "model": self._model_figures(),
            }
        )

    def for_json(self) -> dict[str, object]:
        """Return `figures` and, under `response`, the values of every line, for JSON.

        `response` has the fields of MeasuredResponse, loop (L), loop_spread, sensitivity (S), tracking (T),
        sensitivity_spread; with a model also model_loop and model_sensitivity. Spreads are relative to the magnitude;
        complex values are [real, imaginary], null where not finite.
        """
        measured, loop = self.response, self.loop.loop
        curves = dataclass_fields(measured) | {"loop": loop, "loop_spread": self.loop.spread}
        curves |= {"sensitivity": 1 / (1 + loop), "tracking": loop / (1 + loop)}
        curves["sensitivity_spread"] = np.abs(curves["tracking"]) * self.loop.spread
        if self.model is not None:
            curves["model_loop"] = self.model.open(measured.hz)
            curves["model_sensitivity"] = 1 / (1 + curves["model_loop"])
        return to_jsonable(self.figures() | {"response": curves})

    def _model_figures(self) -> dict[str, object] | None:
        """Return {margins: {name: value}, gain_ratio} of the model; None without a model.

        `gain_ratio` is the median of measured |L| over the model's at the lines whose spread is below MAX_LINE_SPREAD,
        NaN without such a line.
        """
        if self.model is None:
            return None
        is_certain = self.loop.spread < MAX_LINE_SPREAD
        ratio = np.abs(self.loop.loop / self.model.open(self.loop.hz))[is_certain]
        margins = loop_margins(self.model)
        model_margins = {**margins._asdict(), "modulus_margin": 1 / margins.max_sensitivity}
        return {"margins": model_margins, "gain_ratio": np.median(ratio) if ratio.size else math.nan}


def measure_loop(
    signals: Mapping[str, Real],
    rate_hz: float,
    near_hz: float | None = None,
    model: Loop | None = None,
    command_taps: Sequence[float] = (),
) -> LoopMeasurement:
    """Identify loop, margins and lightly damped mode from recorded signals, each (ticks,); `gain` stays None.

    `signals` has `reference_um`, `error_um`, `command_um` and `position_um`. Parts of the command that come from past
    the controller, `feed_um` if given and the reference filtered by `command_taps`, are subtracted to find C. With
    `periods_missed`, periods with a missed tick are left out. The lightly damped mode is searched near `near_hz`, or
    else where the plant answers most; `model` is only stored. Raises ValueError for a reference without a multisine or
    without silent lines, for fewer than two complete periods, and for a loop that does not answer.
    """
    reference = signals["reference_um"]
    part = find_periodic_part(reference)
    if part is None:
        raise ValueError(
            "reference: no section of the recorded reference is periodic; record a multisine of several periods"
        )
    grid = part.grid(reference, rate_hz)
    is_complete = (
        ~part.reshape_periods(signals["periods_missed"]).any(axis=1) if "periods_missed" in signals else slice(None)
    )
    error, command, position = (
        part.reshape_periods(signals[name])[is_complete] for name in ("error_um", "command_um", "position_um")
    )
    direct_um = np.convolve(command_taps or (0.0,), reference)[: reference.size] + signals.get("feed_um", 0.0)
    measured = measure_response(grid, PeriodSignals(error, command, position, part.reshape_periods(direct_um)[0]))
    mode = _find_mode(measured, rate_hz, near_hz)
    loop = measured_loop(measured, rate_hz, mode)
    perturbed_loops = (
        [measured_loop(measured, rate_hz, perturbed_mode) for perturbed_mode in mode.perturbed_modes()] if mode else []
    )
    return LoopMeasurement(measured, loop, measured_margins(loop, perturbed_loops), mode, model)


def _find_mode(measured: MeasuredResponse, rate_hz: float, near_hz: float | None) -> LightMode | None:
    """Return the lightly damped mode near `near_hz`; None without a mode and for fewer than MIN_LINES lines near it.

    If `near_hz` is None, it is the line of the largest plant response whose spread is below MAX_LINE_SPREAD.
    """
    if near_hz is None:
        certain_gains = np.where(measured.spread < MAX_LINE_SPREAD, np.abs(measured.plant), 0.0)
        near_hz = float(measured.hz[np.argmax(certain_gains)])
    if np.count_nonzero(np.abs(measured.hz / near_hz - 1) <= BAND) < MIN_LINES:
        return None
    return fit_light_mode(measured, rate_hz, near_hz)
