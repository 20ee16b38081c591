"""`rtloop identify hysteresis`: a play model of the actuator from recorded slow drives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, OUTPUT, NumberList
from rtloop.cli.output import print_result, print_warnings
from rtloop.cli.output.tables import console, format_number, table
from rtloop.errors import ConfigError
from rtloop.values import dataclass_fields, to_jsonable

if TYPE_CHECKING:
    from rich.console import Console

    from rtloop.design.identification.axis_recording import AxisRecording
    from rtloop.design.identification.hysteresis.identify_from_parts import PartsFit
    from rtloop.design.identification.hysteresis.identify_hysteresis import Weights
    from rtloop.design.identification.hysteresis.judgement import Judgement
    from rtloop.design.identification.hysteresis.thresholds import Placement


RUNS = click.argument("runs", metavar="RUN...", type=OUTPUT, nargs=-1, required=True)
AXIS = click.option("--axis", help="Name of the axis [the only one].")
OUT = click.option("--out", type=OUTPUT, help="The TOML file to write, never over an existing one.")
PLOT = click.option("--plot", type=OUTPUT, help="The picture (PNG) to write.")


@click.group()
def identify() -> None:
    """Make models of the actuator from recordings."""


@identify.command()
@RUNS
@AXIS
@click.option(
    "--operators", "count", default=15, show_default=True, type=click.IntRange(1, 64), help="Number of plays."
)
@click.option(
    "--placement", default="auto", show_default=True,
    type=click.Choice(["auto", "chebyshev", "chebyshev-from-0", "uniform"]),
    help="Placement of thresholds: with a dead band (chebyshev) or without; auto takes the one with less error.",
)  # fmt: skip
@click.option(
    "--thresholds",
    "thresholds_v",
    type=NumberList(),
    help="Thresholds in V, such as '0,0.5,1,2', instead of --placement.",
)
@click.option(
    "--weights", default="invertible", show_default=True, type=click.Choice(["invertible", "free"]),
    help="invertible: every partial sum of the weights is above 0, so that an inverse exists; free: no such condition.",
)  # fmt: skip
@click.option(
    "--memory", default="auto", show_default=True, type=click.Choice(["auto", "rest", "unknown"]),
    help="Memory of the actuator at the start of each RUN: none (rest) or unknown; auto: by the start of its drive.",
)  # fmt: skip
@click.option("--validate", type=OUTPUT, multiple=True, help="A recording to judge the model by; repeatable.")
@OUT
@PLOT
@JSON
@report_errors
def hysteresis(runs: tuple[Path, ...], as_json: bool, **options: Any) -> int:
    """Identify thresholds and weights from recorded slow drives.

    Best are sines from rest: each RUN begins at 0 V on a depolarised actuator and shows its initial loading curve.
    Other recordings are accepted too, also a part of a loop from any start. Samples before the actuator's memory is
    known are then left out, and so are plays that no later stroke has moved. The error is stated for data held out of
    the fit.
    """
    report = hysteresis_report(runs, **options)
    print_result(report, as_json, _print_hysteresis)
    return 0 if report["invertible"] or options["weights"] == "free" else 1


def hysteresis_report(
    paths: Sequence[Path],
    *,
    axis: str | None = None,
    count: int = 15,
    placement: Placement = "auto",
    thresholds_v: Sequence[float] | None = None,
    weights: Weights = "invertible",
    memory: Literal["auto", "rest", "unknown"] = "auto",
    validate: Sequence[Path] = (),
    out: Path | None = None,
    plot: Path | None = None,
) -> dict[str, Any]:
    """Identify `count` plays from recordings; write their section to `out`, a picture to `plot`. Returns a JSON report.

    `thresholds_v` replace the `placement` of thresholds. `memory` at the start of each recording is none ("rest"),
    unknown, or found from its drive. `validate` are recordings that judge the model, and are not fitted. Raises
    RtloopError, ConfigError where no model can be fitted.
    """
    from rtloop.design.identification.axis_recording import excitation_warnings
    from rtloop.design.identification.hysteresis.identify_from_parts import identify_from_parts
    from rtloop.design.identification.hysteresis.identify_hysteresis import identify_hysteresis, unexplained_um
    from rtloop.design.identification.hysteresis.initial_rest import begins_at_rest
    from rtloop.design.identification.hysteresis.judgement import combine_errors, evaluate_from_rest
    from rtloop.design.identification.model_sections import (
        feedforward_section,
        hysteresis_provenance,
        require_new,
        write_new_file,
    )

    require_new(out)
    runs = read_distinct_runs(paths, axis)
    print_warnings(excitation_warnings(runs))
    validation_runs = read_distinct_runs(validate, axis, runs)
    is_from_rest = memory == "rest" or (memory == "auto" and all(begins_at_rest(run) for run in runs))
    try:
        if is_from_rest:
            fit = identify_hysteresis(runs, count, placement, thresholds_v, weights)
            judgements = evaluate_from_rest(runs, fit, validation_runs)
            extra: dict[str, Any] = {"unexplained_um": unexplained_um(runs, fit)}
        else:
            parts_fit = identify_from_parts(runs, count, placement, thresholds_v, weights, validation_runs)
            fit, judgements = parts_fit.hysteresis, (parts_fit.judgements, parts_fit.other_judgements)
            extra = _parts_fields(parts_fit)
    except ValueError as fault:
        raise ConfigError("identify hysteresis", [str(fault)]) from None
    rows = [_judgement_row(judgement, fitted=True) for judgement in judgements[0]]
    rows += [_judgement_row(judgement, fitted=False) for judgement in judgements[1]]
    if out is not None:
        comments = [*hysteresis_provenance(fit, runs), *_validation_comments(rows, extra)]
        write_new_file(out, feedforward_section(fit.model, comments))
    if plot is not None:
        from rtloop.design.identification.plots import plot_hysteresis

        plot_hysteresis(fit, [*judgements[0], *judgements[1]], plot)
    combined = {
        key: combine_errors([getattr(judgement, field) for judgement in judgements[0]])._asdict()
        for key, field in (("error", "rms_um"), ("as_written", "rms_of_plays_um"))
    }
    return to_jsonable(
        {"recordings": [run.name for run in runs], "digests": [run.digest for run in runs]}
        | dataclass_fields(fit)
        | {
            "max_error_percent": 100 * fit.max_error_um / fit.range_um,
            "measured_h_percent": fit.measured_loop.percent,
            "model_h_percent": fit.model_loop.percent,
            "invertible": fit.is_invertible,
            "unexplained_um": None,
        }
        | extra
        | {"held_out": rows, "held_out_all": combined, "output": out, "plot": plot}
    )


def read_distinct_runs(
    paths: Sequence[Path], axis: str | None, other_runs: Sequence[AxisRecording] = ()
) -> list[AxisRecording]:
    """Read recordings and return those that are no copies of one another or of `other_runs`; print warnings of copies.

    Raises RtloopError for a recording that cannot be read or lacks the axis (None: the only one).
    """
    from rtloop.design.identification.axis_recording import distinct, read_axis_recording

    runs, warnings = distinct([read_axis_recording(path, axis) for path in paths], other_runs)
    print_warnings(warnings)
    return runs


def _parts_fields(fit: PartsFit) -> dict[str, Any]:
    """Return the fields of the report that only recordings with unknown memory have.

    `terms` are the effects that were fitted beside the plays and left out of the model, such as creep; `creep_um` is
    the range of creep. `tried_um` has the held-out error (µm rms) of each trial. The model is valid for strokes up to
    `stroke_v`; `missing` names the drive that would show larger plays, or is "".
    """
    return {
        "terms": fit.terms,
        "tried_um": dict(fit.trial_errors_um),
        "stroke_v": fit.stroke_v,
        "missing": fit.missing_drive,
        "creep_um": fit.creep_um if "creep" in fit.terms else 0.0,
    }


def _judgement_row(judgement: Judgement, fitted: bool) -> dict[str, Any]:
    """Return the report's row on the model's held-out error in one recording, which is `fitted` or validates only."""
    return {
        "recording": judgement.name,
        "fitted": fitted,
        "rms_error_um": judgement.rms_um,
        "as_written_rms_um": judgement.rms_of_plays_um,
        "max_error_um": judgement.max_um,
        "max_error_percent": 100 * judgement.max_um / judgement.range_um,
        "range_um": judgement.range_um,
        "offset_um": judgement.offset_um,
        "drift_um": judgement.drift_um,
        "memory": "rest" if judgement.starts_from_rest else "unknown",
        "known_from_s": judgement.known_from_s,
        "unsettled": judgement.is_unsettled,
        "unsettled_um": judgement.unsettled_um,
        "judged_percent": 100 * judgement.known_share,
        "early_max_error_percent": 100 * judgement.early_max_um / judgement.range_um,
    }


def _validation_comments(rows: Sequence[dict[str, Any]], extra: dict[str, Any]) -> list[str]:
    """Return comment lines for the model's section of a configuration.

    They state the largest held-out error of `rows` (of `_judgement_row`; one at least has a judged part), the effects
    left out of the model, such as creep, and the largest stroke, V, for which the model is valid. The last two are in
    `extra`, the fields of `_parts_fields`; without these fields there is one line.
    """
    worst_row = max((row for row in rows if row["judged_percent"]), key=lambda row: row["max_error_percent"])
    name, memory = Path(worst_row["recording"]).name, worst_row["memory"]
    lines = [
        f"held out: {worst_row['rms_error_um']:.3g} µm rms, at most {worst_row['max_error_percent']:.3g} % of "
        f"{worst_row['range_um']:.4g} µm, in {name}; memory at the start: {memory}, "
        f"{worst_row['judged_percent']:.3g} % of it judged"
    ]
    play_errors_um = [row["as_written_rms_um"] for row in rows if math.isfinite(row["as_written_rms_um"])]
    if extra.get("terms") and play_errors_um:
        lines.append(
            f"the fit took out {' and '.join(extra['terms'])}; these plays alone leave an error of up to "
            f"{max(play_errors_um):.3g} µm rms"
        )
    if extra.get("missing"):
        lines.append(f"valid for strokes of up to {extra['stroke_v']:.4g} V; {extra['missing']}")
    return lines


def _print_hysteresis(report: dict[str, Any]) -> None:
    """Print thresholds, weights, errors, and the measured and the model's relative loop height h/H."""
    out, model = console(), report["model"]
    plays = enumerate(zip(model["thresholds_v"], model["weights_um_per_v"], strict=True))
    rows = [(str(i), f"{threshold:.4f}", f"{weight:.4f}") for i, (threshold, weight) in plays]
    out.print(table("operator", "threshold V", "weight µm/V", rows=rows))
    out.print(
        f"error of the fit {report['rms_error_um']:.3g} µm rms, at most {report['max_error_um']:.3g} µm "
        f"({report['max_error_percent']:.3g} % of {report['range_um']:.4g} µm); noise {report['noise_um']:.3g} µm"
    )
    _print_held_out(out, report)
    if report["unexplained_um"]:
        out.print(
            f"[yellow]the actuator is no sum of plays[/]: {report['unexplained_um']:.3g} µm rms remain with any number "
            "of plays; the error may be larger for small steps and for loops of other sizes"
        )
    out.print(
        f"height of the loop over its range: {format_number(report['measured_h_percent'], '.2f')} % measured, "
        f"{format_number(report['model_h_percent'], '.2f')} % by the model"
    )
    if not report["invertible"]:
        out.print("[red]no inverse[/]: a partial sum of the weights is not above 0; use --weights invertible")
    print_files(out, report)


def _print_held_out(out: Console, report: dict[str, Any]) -> None:
    """Print the model's error on each held-out recording and over all of them.

    After a fit of recordings whose state of the hysteresis at the start is unknown (`tried_um` in the report), it also
    prints the error with each set of effects beside the plays, such as creep, the chosen set, and the strokes for which
    the model is valid.
    """
    rows = table(
        "held out", "error µm rms", "at most µm", "at most %", "judged %", "at most % before", "plays alone µm rms",
        "offset µm", "drift µm", "memory at the start",
    )  # fmt: skip
    for row in report["held_out"]:
        memory, from_s = "from rest", row["known_from_s"]
        if row["memory"] != "rest":
            extent = "never fully known" if from_s is None else f"known from {from_s:.3g} s on"
            memory = f"unknown; {extent}"
        errors = ("rms_error_um", "max_error_um", "max_error_percent", "judged_percent", "early_max_error_percent")
        rows.add_row(
            Path(row["recording"]).name + ("" if row["fitted"] else " (validation only)"),
            *(format_number(row[key], ".3g") for key in errors),
            format_number(row["as_written_rms_um"], ".3g"), format_number(row["offset_um"], ".4g"),
            f"{row['drift_um']:.3g}",
            memory + ("; [yellow]unsettled[/]" if row["unsettled"] else ""),
        )  # fmt: skip
    out.print(rows)
    combined = report["held_out_all"]
    error, written = combined["error"], combined["as_written"]
    if error["std_um"] is not None:
        out.print(f"all, held out: {_format_error(error)} µm rms; the plays alone: {_format_error(written)} µm rms")
    if "tried_um" in report:
        trials_text = ", ".join(f"{name} {error_um:.3g}" for name, error_um in report["tried_um"].items())
        out.print(f"held-out errors in µm rms: {trials_text}; chosen: {' + '.join(('plays', *report['terms']))}")
        missing = f"; {report['missing']}" if report["missing"] else ""
        out.print(f"valid for strokes of up to {report['stroke_v']:.4g} V{missing}")


def _format_error(error: dict[str, Any]) -> str:
    """Return an rms error in µm as text, with its standard deviation where it has one."""
    std_um = error["std_um"]
    return f"{error['rms_um']:.3g}" + ("" if std_um is None else f" ± {std_um:.2g}")


def print_files(out: Console, report: dict[str, Any]) -> None:
    """Print the paths of the files that a report names as written: its `output` and `plot`."""
    for key in ("output", "plot"):
        if report.get(key):
            out.print(report[key], markup=False)
