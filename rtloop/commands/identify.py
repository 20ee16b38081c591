"""`rtloop identify` and `rtloop design compensation`: from files to reports, sections and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import click
import numpy as np

from rtloop.configuration.file import load as load_configuration
from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData, distinct, read_axis_recording
from rtloop.design.identification.dynamics.dynamics_fit import DynamicsFit
from rtloop.design.identification.dynamics.identify_delay import delay_input
from rtloop.design.identification.dynamics.identify_dynamics import Criterion
from rtloop.design.identification.dynamics.identify_in_loop import identify_recorded_dynamics
from rtloop.design.identification.dynamics.prediction_error import LARGEST_ORDER, Excitation
from rtloop.design.identification.dynamics.recorded_loop import RecordedLoop, State, find_closed_loop
from rtloop.design.identification.frequency_response import compare_responses, recording_response
from rtloop.design.identification.hysteresis.identify_from_parts import PartsFit, identify_from_parts
from rtloop.design.identification.hysteresis.identify_hysteresis import (
    HysteresisFit,
    Weights,
    identify_hysteresis,
    unexplained_um,
)
from rtloop.design.identification.hysteresis.initial_rest import begins_at_rest
from rtloop.design.identification.hysteresis.judgement import Judgement, combine_errors, evaluate_from_rest
from rtloop.design.identification.hysteresis.thresholds import Placement
from rtloop.design.identification.model_sections import (
    dynamics_provenance,
    feedforward_section,
    hysteresis_provenance,
    model_section,
    parse_feedforward,
    read_feedforward,
    scale_hysteresis,
    write_new_file,
)
from rtloop.errors import ConfigError
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.compensation import compensated_output, residual_operator
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import model_output
from rtloop.values import dataclass_fields, to_jsonable

Input = Literal["hysteresis", "command", "drive"]
Memory = Literal["auto", "rest", "unknown"]
RANDOM_COMMANDS = 20_000


def hysteresis_report(
    paths: Sequence[Path],
    *,
    axis: str | None = None,
    count: int = 15,
    placement: Placement = "auto",
    thresholds_v: Sequence[float] | None = None,
    weights: Weights = "invertible",
    memory: Memory = "auto",
    validate: Sequence[Path] = (),
    out: Path | None = None,
    plot: Path | None = None,
) -> dict[str, Any]:
    """Identify, write what was asked for, and report. Raises RtloopError."""
    runs = _distinct_runs(paths, axis)
    others = _distinct_runs(validate, axis, runs)
    known = memory == "rest" or (memory == "auto" and all(begins_at_rest(run) for run in runs))
    try:
        if known:
            fit = identify_hysteresis(runs, count, placement, thresholds_v, weights)
            judged = evaluate_from_rest(runs, fit, others)
            more: dict[str, Any] = {"unexplained_um": unexplained_um(runs, fit)}
        else:
            found = identify_from_parts(runs, count, placement, thresholds_v, weights, others)
            fit, judged, more = found.hysteresis, (found.judgements, found.other_judgements), _chosen(found)
    except ValueError as fault:
        raise ConfigError("identify hysteresis", [str(fault)]) from None
    rows = [_judged(one, fitted) for fitted, group in zip((True, False), judged, strict=True) for one in group]
    if out is not None:
        write_new_file(out, feedforward_section(fit.model, [*hysteresis_provenance(fit, runs), *_held_out(rows, more)]))
    if plot is not None:
        from rtloop.design.identification.plots import plot_hysteresis

        plot_hysteresis(fit, [*judged[0], *judged[1]], plot)
    return to_jsonable(
        _hysteresis(runs, fit)
        | {"unexplained_um": None}
        | more
        | {"held_out": rows, "held_out_all": _all(judged[0]), "output": out, "plot": plot}
    )


def _distinct_runs(
    paths: Sequence[Path], axis: str | None, others: Sequence[AxisRecording] = ()
) -> list[AxisRecording]:
    """Read the recordings; copies are left out, and named on stderr. Raises RtloopError."""
    runs, sentences = distinct([read_axis_recording(path, axis) for path in paths], others)
    for sentence in sentences:
        click.echo(f"warning: {sentence}", err=True)
    return runs


def _hysteresis(runs: Sequence[AxisRecording], fit: HysteresisFit) -> dict[str, Any]:
    return (
        {"recordings": [run.name for run in runs], "digests": [run.digest for run in runs]}
        | dataclass_fields(fit)
        | {
            "max_error_percent": 100 * fit.max_error_um / fit.range_um,
            "measured_h_percent": fit.measured_loop.percent,
            "model_h_percent": fit.model_loop.percent,
            "invertible": fit.is_invertible,
        }
    )


def _chosen(found: PartsFit) -> dict[str, Any]:
    return {
        "terms": found.terms,
        "tried_um": dict(found.trial_errors_um),
        "stroke_v": found.stroke_v,
        "missing": found.missing_drive,
    } | {"creep_um": found.creep_um if "creep" in found.terms else 0.0}


def _judged(one: Judgement, fitted: bool) -> dict[str, Any]:
    """A row of the report."""
    return {
        "recording": one.name, "fitted": fitted, "rms_error_um": one.rms_um, "as_written_rms_um": one.rms_of_plays_um,
        "max_error_um": one.max_um,
        "max_error_percent": 100 * one.max_um / one.range_um, "range_um": one.range_um, "offset_um": one.offset_um,
        "drift_um": one.drift_um, "memory": "rest" if one.starts_from_rest else "unknown",
        "known_from_s": one.known_from_s,
        "unsettled": one.is_unsettled, "unsettled_um": one.unsettled_um, "judged_percent": 100 * one.known_share,
        "early_max_error_percent": 100 * one.early_max_um / one.range_um,
    }  # fmt: skip


def _all(judged: Sequence[Judgement]) -> dict[str, Any]:
    """Of all recordings together, with standard errors."""
    return {
        "error": combine_errors([one.rms_um for one in judged])._asdict(),
        "as_written": combine_errors([one.rms_of_plays_um for one in judged])._asdict(),
    }


def _held_out(rows: Sequence[dict[str, Any]], more: dict[str, Any]) -> list[str]:
    """Comments of what is written: the error on what was held out, and for which strokes the model is."""
    worst = max((row for row in rows if row["judged_percent"]), key=lambda row: row["max_error_percent"])
    lines = [
        f"held out: {worst['rms_error_um']:.3g} µm rms, at most {worst['max_error_percent']:.3g} % of "
        f"{worst['range_um']:.4g} µm, in {Path(worst['recording']).name}; memory at the start: {worst['memory']}, "
        f"{worst['judged_percent']:.3g} % of it judged"
    ]
    alone = [row["as_written_rms_um"] for row in rows if np.isfinite(row["as_written_rms_um"])]
    if more.get("terms") and alone:
        lines.append(f"{' and '.join(more['terms'])} taken out; these plays alone leave up to {max(alone):.3g} µm rms")
    if more.get("missing"):
        lines.append(f"for strokes of up to {more['stroke_v']:.4g} V; {more['missing']}")
    return lines


def excitation(run: AxisRecording, how: Input, feedforward: PlayModel | None, loop: RecordedLoop | None) -> Excitation:
    """The input to D and its output. `feedforward` is the actuator's model, needed for "hysteresis".

    Of a `loop` that was closed, the stretch and what moved it.
    """
    if not run.is_even:
        raise UnsuitableData(
            f"{run.name}: ticks are missing or late by a period; dynamics need a record at equal intervals: record "
            "again, unpaced or with real-time scheduling"
        )
    if how == "hysteresis":
        assert feedforward is not None
        whole = Excitation(run.name, model_output(feedforward, run.drive_v), run.position_um, run.period_s)
    else:
        if how == "command" and np.isnan(run.command_um).all():
            raise UnsuitableData(f"{run.name}: it has no recorded command; --input drive or hysteresis is possible")
        given = run.drive_v if how == "drive" else run.command_um
        whole = Excitation(run.name, given, run.position_um, run.period_s)
    if loop is None:
        return whole
    if how == "command":
        loop.require_commands_obeyed(run.name)
    return loop.excitation(whole)


def dynamics_report(
    paths: Sequence[Path],
    *,
    axis: str | None = None,
    how: Input = "hysteresis",
    hysteresis: Path | None = None,
    state: State = "auto",
    outside: Sequence[str] = (),
    order: int | None = None,
    largest_order: int = LARGEST_ORDER,
    delay_ticks: int | None = None,
    criterion: Criterion | None = None,
    compare: Path | None = None,
    out: Path | None = None,
    plot: Path | None = None,
) -> dict[str, Any]:
    """Identify from the first recording, judge with the others, write what was asked for. Raises RtloopError."""
    runs = _distinct_runs(paths, axis)
    loops = [find_closed_loop(Path(run.name), axis, state, outside) for run in runs]
    actuator = _actuator(runs[0], hysteresis, axis) if how == "hysteresis" else None
    inputs = [excitation(run, how, actuator, loop) for run, loop in zip(runs, loops, strict=True)]
    try:
        fit = identify_recorded_dynamics(inputs[0], order, largest_order, criterion, inputs[1:], delay_ticks)
    except ValueError as fault:
        raise ConfigError("identify dynamics", [str(fault)]) from None
    found, compared = None, None
    if compare is not None:
        loop = find_closed_loop(compare, axis, state, outside)
        found = recording_response(
            delay_input(excitation(read_axis_recording(compare, axis), how, actuator, loop), fit.delay_ticks)
        )
        compared = compare_responses(fit.model, found)
    if out is not None:
        write_new_file(out, _sections(fit, runs[0], how, actuator))
    if plot is not None:
        from rtloop.design.identification.plots import plot_dynamics

        plot_dynamics(fit, delay_input(inputs[0], fit.delay_ticks), found, plot)
    tests = {"white": fit.tests.is_white, "independent": fit.tests.is_independent}
    return to_jsonable(
        {"recordings": [run.name for run in runs], "digests": [run.digest for run in runs], "input": how}
        | {"loop": loops[0] and {"from_tick": loops[0].start, "to_tick": loops[0].end, "outside": loops[0].names}}
        | {key: value for key, value in dataclass_fields(fit).items() if key != "model"}
        | {"order": fit.model.order, "tests": dataclass_fields(fit.tests) | tests}
        | {"frequency_response": compared, "output": out, "plot": plot}
    )


def compensation_report(
    config: Path,
    identified: Path,
    *,
    axis: str | None = None,
    command_um: float | None = None,
    plot: Path | None = None,
) -> dict[str, Any]:
    """P∘P̂⁻¹ of the identified actuator and the compensator of `config`, with ρ and ξ, simulated. Raises
    RtloopError."""
    compensator = read_feedforward(config, axis)
    if command_um is None:
        axes = load_configuration(config).axes
        command_um = next(one for one in axes if axis in (None, one.name)).limits.command_um
    actuator, (_, inverse) = read_feedforward(identified, axis).actuator(), compensator.models()
    try:
        residual = residual_operator(actuator, inverse, command_um)
    except ValueError as fault:
        raise ConfigError(str(config), [f"axis.feedforward: {fault}"]) from None
    commands = {
        "sine": command_um * np.sin(np.linspace(0, 5 * np.pi, RANDOM_COMMANDS)),
        "random": np.random.default_rng(0).uniform(-command_um, command_um, RANDOM_COMMANDS),
    }
    gains = {"eq_2": residual.gain, "best": residual.best_gain, "unity": 1.0}
    rows = []
    for name, gain in gains.items():
        worst = {"worst_case": residual.worst_commands_um(gain)}
        simulated = {key: _largest(actuator, inverse, v, gain) for key, v in (commands | worst).items()}
        rows.append({"gain": name, "rho": gain, "xi_um": residual.bound_um(gain), "simulated_um": simulated})
    if plot is not None:
        from rtloop.design.identification.plots import plot_compensation

        plot_compensation(residual, actuator, inverse, plot)
    return to_jsonable(
        {
            "config": config,
            "identified": identified,
            "command_um": command_um,
            "thresholds_um": residual.operator.thresholds,
            "weights": residual.operator.weights,
            "bounds": rows,
            "eq_3_um": residual.printed_bound_um,
            "triangle_bound_um": residual.safe_bound_um,
            "dead_band": compensator.dead_band,
            "plot": plot,
        }
    )


def _actuator(run: AxisRecording, hysteresis: Path | None, axis: str | None) -> PlayModel:
    """From the file given, else from the configuration that the recording was made with. Raises UnsuitableData."""
    if hysteresis is not None:
        return read_feedforward(hysteresis, axis).actuator()
    if not run.configuration:
        raise UnsuitableData(
            f"{run.name}: it was imported, and says nothing of hysteresis: --hysteresis names a file that does, "
            "--input drive takes the drive as it is"
        )
    return parse_feedforward(run.configuration, f"{run.name}: configuration", axis).actuator()


def _sections(fit: DynamicsFit, run: AxisRecording, how: Input, actuator: PlayModel | None) -> str:
    content = model_section(fit, dynamics_provenance(fit, run, how))
    if actuator is None:
        return content
    comments = [f"Hysteresis with the static gain {fit.static_gain:.6g} of the dynamics below put into it"]
    return feedforward_section(scale_hysteresis(actuator, fit.static_gain), comments) + "\n" + content


def _largest(actuator: PlayModel, inverse: PlayModel, command: Real, gain: float) -> float:
    return float(np.abs(compensated_output(actuator, inverse, command) - gain * command).max())
