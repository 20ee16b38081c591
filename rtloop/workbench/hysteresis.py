"""Identification of the actuator's hysteresis from recorded slow drives, with the held-out errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rtloop.design.identification.axis_recording import (
    AxisRecording,
    distinct,
    excitation_warnings,
    read_axis_recording,
)
from rtloop.design.identification.hysteresis.creep import describe_unexplained, is_creep_likely
from rtloop.design.identification.hysteresis.identify_from_parts import PartsFit, identify_from_parts
from rtloop.design.identification.hysteresis.identify_hysteresis import identify_hysteresis, unexplained_um
from rtloop.design.identification.hysteresis.initial_rest import begins_at_rest
from rtloop.design.identification.hysteresis.judgement import Judgement, combine_errors, evaluate_from_rest
from rtloop.design.identification.hysteresis.recording_set import HysteresisFit, Weights
from rtloop.design.identification.hysteresis.thresholds import Placement
from rtloop.design.identification.model_sections import feedforward_section, hysteresis_provenance
from rtloop.errors import ConfigError
from rtloop.hysteresis.play_model import PlayModel
from rtloop.values import count_text, dataclass_fields, to_jsonable
from rtloop.workbench.hysteresis_text import print_hysteresis
from rtloop.workbench.identified_model import IdentifiedModel, Warn, WarningCollector
from rtloop.workbench.judgement_rows import judgement_row, validation_comments

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

Memory = Literal["auto", "rest", "unknown"]


@dataclass(repr=False, eq=False)
class HysteresisResult(IdentifiedModel):
    """Identified plays: `fit` has the model and the errors of the fit, `judgements` the held-out errors.

    `judgements` are two lists: of the fitted recordings `runs`, then of recordings that only validate the model.
    `extra` are fields of the JSON report that depend on the start of the recordings: `unexplained_um` and
    its cause in words from rest, else those of `_parts_fields`.
    """

    fit: HysteresisFit
    runs: list[AxisRecording]
    judgements: tuple[list[Judgement], list[Judgement]]
    extra: dict[str, object]
    warnings: list[str]

    @property
    def model(self) -> PlayModel:
        """The plays: thresholds (V) and weights (µm/V)."""
        return self.fit.model

    @property
    def is_invertible(self) -> bool:
        """Whether the model has an inverse: every partial sum of the weights is above 0."""
        return self.fit.is_invertible

    @property
    def error_um(self) -> float:
        """Rms error in µm over all fitted recordings, each judged by a model fitted without it; NaN if none can be."""
        return combine_errors([judgement.rms_um for judgement in self.judgements[0]]).rms_um

    @property
    def held_out(self) -> list[dict[str, Any]]:
        """Held-out errors of the model: a row, as of `judgement_row`, for each recording, fitted ones first."""
        return [
            judgement_row(judgement, fitted=is_fitted)
            for judgements, is_fitted in zip(self.judgements, (True, False), strict=True)
            for judgement in judgements
        ]

    @property
    def section(self) -> str:
        """The model as the section [axis.feedforward]. Raises UnsuitableData for a model without an inverse."""
        comments = [*hysteresis_provenance(self.fit, self.runs), *validation_comments(self.held_out, self.extra)]
        return feedforward_section(self.fit.model, comments)

    @property
    def headline(self) -> str:
        """Number of plays, held-out error (µm rms) and range of the position (µm)."""
        count = count_text(self.model.thresholds.size, "play")
        return f"{count}, held out {self.error_um:.3g} µm rms of {self.fit.range_um:.4g} µm"

    def as_dict(self) -> dict[str, Any]:
        """Return the object of `rtloop identify hysteresis --json`."""
        fit = self.fit
        combined = {
            key: combine_errors([getattr(judgement, field) for judgement in self.judgements[0]])._asdict()
            for key, field in (("error", "rms_um"), ("as_written", "rms_of_plays_um"))
        }
        return to_jsonable(
            {"recordings": [run.name for run in self.runs], "digests": [run.digest for run in self.runs]}
            | dataclass_fields(fit)
            | {
                "max_error_percent": 100 * fit.max_error_um / fit.range_um,
                "measured_h_percent": fit.measured_loop.percent,
                "model_h_percent": fit.model_loop.percent,
                "invertible": fit.is_invertible,
                "unexplained_um": None,
                "unexplained": None,
            }
            | self.extra
            | {"held_out": self.held_out, "held_out_all": combined, "output": self.output, "plot": self.picture}
        )

    def print_text(self, out: Console) -> None:
        """Print thresholds, weights, errors, and the measured and the model's relative loop height."""
        print_hysteresis(out, self.as_dict())

    def plot(self) -> Figure:
        """Return a picture of measured and modelled loops and of the held-out errors.

        Raises MissingExtra without matplotlib.
        """
        from rtloop.design.identification.plots import draw_hysteresis

        return draw_hysteresis(self.fit, [*self.judgements[0], *self.judgements[1]])


def fit_hysteresis(
    paths: Sequence[Path],
    *,
    axis: str | None = None,
    operators: int = 15,
    placement: Placement = "auto",
    thresholds: Sequence[float] | None = None,
    weights: Weights = "invertible",
    memory: Memory = "auto",
    validate: Sequence[Path] = (),
    warn: Warn = lambda _: None,
) -> HysteresisResult:
    """Identify `operators` plays from recordings.

    `placement` is the rule for their thresholds; `thresholds` (V) replace number and placement. `weights` "invertible"
    make a model with an inverse, "free" perhaps one without. `memory` says whether the actuator has none at the start
    of each recording ("rest"), an unknown one ("unknown"), or whether this is found from the drive ("auto"). `validate`
    are recordings that judge the model, and are not fitted. `warn` receives lists of warnings before the fit. Raises
    RtloopError for recordings that cannot be used, ConfigError where no model can be fitted.
    """
    collect = WarningCollector(warn)
    runs = read_distinct_runs(paths, axis, collect)
    collect(excitation_warnings(runs))
    validation_runs = read_distinct_runs(validate, axis, collect, runs)
    is_from_rest = memory == "rest" or (memory == "auto" and all(begins_at_rest(run) for run in runs))
    try:
        if is_from_rest:
            fit = identify_hysteresis(runs, operators, placement, thresholds, weights)
            fitted, validating = evaluate_from_rest(runs, fit, validation_runs)
            left_um = unexplained_um(runs, fit)
            cause = describe_unexplained(left_um, all(is_creep_likely(run) for run in runs)) if left_um else None
            extra: dict[str, object] = {"unexplained_um": left_um, "unexplained": cause}
        else:
            parts_fit = identify_from_parts(runs, operators, placement, thresholds, weights, validation_runs)
            fit, fitted, validating = parts_fit.hysteresis, parts_fit.judgements, parts_fit.other_judgements
            extra = _parts_fields(parts_fit)
    except ValueError as fault:
        raise ConfigError("identify hysteresis", [str(fault)]) from None
    return HysteresisResult(fit, runs, (list(fitted), list(validating)), extra, collect.warnings)


def read_distinct_runs(
    paths: Sequence[Path], axis: str | None, warn: Warn, other_runs: Sequence[AxisRecording] = ()
) -> list[AxisRecording]:
    """Read recordings and return those that are no copies of one another or of `other_runs`.

    `warn` is called once, with a list: a sentence for each copy that is left out, [] without copies. Raises RtloopError
    for a recording that cannot be read or lacks the axis (None: the only one).
    """
    runs, warnings = distinct([read_axis_recording(path, axis) for path in paths], other_runs)
    warn(warnings)
    return runs


def _parts_fields(fit: PartsFit) -> dict[str, object]:
    """Return the fields of the report that only recordings with unknown memory have.

    `terms` are the effects that were fitted beside the plays and left out of the model, such as creep; `creep_um` is
    the range of creep, 0 if creep was not fitted. `tried_um` has the held-out error (µm rms) of each set of effects
    that was tried. The model is valid for strokes up to `stroke_v`; `missing` names the drive that would show larger
    plays, or is "".
    """
    return {
        "terms": fit.terms,
        "tried_um": dict(fit.trial_errors_um),
        "stroke_v": fit.stroke_v,
        "missing": fit.missing_drive,
        "creep_um": fit.creep_um if "creep" in fit.terms else 0.0,
    }
