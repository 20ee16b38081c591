"""`rtloop identify dynamics`: D(s) from recorded steps, other excitations or a closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.identify import AXIS, OUT, PLOT, RUNS, print_files, read_distinct_runs
from rtloop.cli.options import JSON, OUTPUT
from rtloop.cli.output import print_result
from rtloop.cli.output.tables import console, format_number, table
from rtloop.errors import ConfigError
from rtloop.values import count_text, dataclass_fields, to_jsonable

if TYPE_CHECKING:
    from rich.console import Console

    from rtloop.design.identification.axis_recording import AxisRecording
    from rtloop.design.identification.dynamics.dynamics_fit import DynamicsFit
    from rtloop.design.identification.dynamics.identify_dynamics import Criterion
    from rtloop.design.identification.dynamics.prediction_error import Excitation
    from rtloop.design.identification.dynamics.recorded_loop import RecordedLoop, State
    from rtloop.hysteresis.play_model import PlayModel


Input = Literal["hysteresis", "command", "drive"]


@click.command()
@RUNS
@AXIS
@click.option("--hysteresis", type=OUTPUT, help="File with [axis.feedforward] [the recording's own configuration].")
@click.option(
    "--input", "input_kind", default="hysteresis", show_default=True,
    type=click.Choice(["hysteresis", "command", "drive"]),
    help="Input of the dynamics: output of the hysteresis model, recorded command v, or the drive itself.",
)  # fmt: skip
@click.option("--order", type=click.IntRange(1, 20), help="Number of poles [searched].")
@click.option(
    "--largest-order", default=14, show_default=True, type=click.IntRange(1, 20), help="Largest order in the search."
)
@click.option("--delay", "delay_ticks", type=click.IntRange(0, 16), help="Delay in samples [searched from 0 to 5].")
@click.option(
    "--criterion", type=click.Choice(["aic", "held-out", "validation"]),
    help="Criterion for the order [held-out; a closed loop allows no other].",
)  # fmt: skip
@click.option(
    "--loop",
    "state",
    default="auto",
    show_default=True,
    type=click.Choice(["auto", "open", "closed"]),
    help="State of the loop; auto: by the recorded mode, or open in a recording without modes.",
)
@click.option(
    "--outside", "external_signals", multiple=True, metavar="SIGNAL",
    help="Recorded signal that moved the closed loop, independent of its noise [the axis's reference and feed].",
)  # fmt: skip
@click.option("--compare", type=OUTPUT, help="Recording of a chirp or multisine, for a measured frequency response.")
@OUT
@PLOT
@JSON
@report_errors
def dynamics(runs: tuple[Path, ...], as_json: bool, **options: Any) -> None:
    """Identify the dynamics D(s) of an axis.

    The first RUN identifies the model; further RUNs validate it. A RUN begins at rest and has a step or another
    excitation, or it is a closed loop whose reference moves.
    """
    print_result(dynamics_report(runs, **options), as_json, _print_dynamics)


def dynamics_excitation(
    run: AxisRecording, input_kind: Input, feedforward: PlayModel | None, loop: RecordedLoop | None
) -> Excitation:
    """Return the input to D and its output from a recording; `feedforward` is the actuator's model, for "hysteresis".

    The input is the recorded command for `input_kind` "command", the drive for "drive", and the drive through the model
    for "hysteresis". A closed `loop` limits both to its ticks in closed loop, and adds its external signals. Raises
    UnsuitableData for ticks that are missing or late, and for a command that was not recorded or, in a closed loop, not
    obeyed.
    """
    import numpy as np

    from rtloop.design.identification.axis_recording import UnsuitableData
    from rtloop.design.identification.dynamics.prediction_error import Excitation
    from rtloop.hysteresis.plays import model_output

    if not run.is_even:
        raise UnsuitableData(
            f"{run.name}: ticks are missing or late by a period; dynamics need samples at equal intervals. Record "
            "again with --unpaced or with real-time scheduling"
        )
    if input_kind == "command" and np.isnan(run.command_um).all():
        raise UnsuitableData(f"{run.name}: the recording has no command; use --input drive or --input hysteresis")
    signal = run.command_um if input_kind == "command" else run.drive_v
    if feedforward is not None:
        signal = model_output(feedforward, run.drive_v)
    full_excitation = Excitation(run.name, signal, run.position_um, run.period_s)
    if loop is None:
        return full_excitation
    if input_kind == "command":
        loop.require_commands_obeyed(run.name)
    return loop.excitation(full_excitation)


def dynamics_report(
    paths: Sequence[Path],
    *,
    axis: str | None = None,
    input_kind: Input = "hysteresis",
    hysteresis: Path | None = None,
    state: State = "auto",
    external_signals: Sequence[str] = (),
    order: int | None = None,
    largest_order: int = 14,
    delay_ticks: int | None = None,
    criterion: Criterion | None = None,
    compare: Path | None = None,
    out: Path | None = None,
    plot: Path | None = None,
) -> dict[str, Any]:
    """Identify D(s) from the first recording, validate it with the others, write it to `out`. Returns the JSON report.

    `hysteresis` is a file with the actuator's model (None: the recorded configuration). `order`, `delay_ticks` None:
    searched. `state` says whether the loop was closed ("auto": by the recorded mode), `external_signals` which signals
    moved the closed loop. `compare` is a recording for a measured frequency response, `plot` the path of a picture.
    Raises RtloopError, ConfigError where no model can be fitted.
    """
    from rtloop.design.identification.axis_recording import read_axis_recording
    from rtloop.design.identification.dynamics.identify_delay import delay_input
    from rtloop.design.identification.dynamics.identify_in_loop import identify_recorded_dynamics
    from rtloop.design.identification.dynamics.recorded_loop import find_closed_loop
    from rtloop.design.identification.frequency_response import compare_responses, recording_response
    from rtloop.design.identification.model_sections import require_new, write_new_file

    require_new(out)
    runs = read_distinct_runs(paths, axis)
    loops = [find_closed_loop(Path(run.name), axis, state, external_signals) for run in runs]
    actuator = _load_actuator(runs[0], hysteresis, axis) if input_kind == "hysteresis" else None
    inputs = [dynamics_excitation(run, input_kind, actuator, loop) for run, loop in zip(runs, loops, strict=True)]
    try:
        fit = identify_recorded_dynamics(inputs[0], order, largest_order, criterion, inputs[1:], delay_ticks)
    except ValueError as fault:
        raise ConfigError("identify dynamics", [str(fault)]) from None
    response, comparison = None, None
    if compare is not None:
        loop = find_closed_loop(compare, axis, state, external_signals)
        excitation = dynamics_excitation(read_axis_recording(compare, axis), input_kind, actuator, loop)
        response = recording_response(delay_input(excitation, fit.delay_ticks))
        comparison = compare_responses(fit.model, response)
    if out is not None:
        write_new_file(out, _section_text(fit, runs[0], input_kind, actuator))
    if plot is not None:
        from rtloop.design.identification.plots import plot_dynamics

        plot_dynamics(fit, delay_input(inputs[0], fit.delay_ticks), response, plot)
    tests = {"white": fit.tests.is_white, "independent": fit.tests.is_independent}
    return to_jsonable(
        {"recordings": [run.name for run in runs], "digests": [run.digest for run in runs], "input": input_kind}
        | {"loop": loops[0] and {"from_tick": loops[0].start, "to_tick": loops[0].end, "outside": loops[0].names}}
        | {key: value for key, value in dataclass_fields(fit).items() if key != "model"}
        | {"order": fit.model.order, "tests": dataclass_fields(fit.tests) | tests}
        | {"frequency_response": comparison, "output": out, "plot": plot}
    )


def _load_actuator(run: AxisRecording, hysteresis: Path | None, axis: str | None) -> PlayModel:
    """Return the actuator's model from `hysteresis`, or for None from the recorded configuration.

    Raises UnsuitableData for an imported recording without a file, RecordingError for a file that cannot be read,
    ConfigError for one without [axis.feedforward].
    """
    from rtloop.design.identification.axis_recording import UnsuitableData
    from rtloop.design.identification.model_sections import parse_feedforward, read_feedforward

    if hysteresis is not None:
        return read_feedforward(hysteresis, axis).actuator()
    if not run.configuration:
        raise UnsuitableData(
            f"{run.name}: an imported recording has no model of the hysteresis; use --hysteresis FILE, or --input "
            "drive to take the drive as the input, without hysteresis"
        )
    return parse_feedforward(run.configuration, f"{run.name}: configuration", axis).actuator()


def _section_text(fit: DynamicsFit, run: AxisRecording, input_kind: Input, actuator: PlayModel | None) -> str:
    """Return [axis.model] as TOML; before it, if `actuator` is given, [axis.feedforward] scaled by the static gain."""
    from rtloop.design.identification.model_sections import (
        dynamics_provenance,
        feedforward_section,
        model_section,
        scale_hysteresis,
    )

    content = model_section(fit, dynamics_provenance(fit, run, input_kind))
    if actuator is None:
        return content
    comments = [f"Hysteresis with the static gain {fit.static_gain:.6g} of the dynamics below included"]
    return feedforward_section(scale_hysteresis(actuator, fit.static_gain), comments) + "\n" + content


def _print_dynamics(report: dict[str, Any]) -> None:
    """Print orders that were tried, modes with their uncertainty, tests of the residuals, and a measured response."""
    out = console()
    loop = report["loop"]
    ticks = ""
    if loop:  # `to_tick` is the tick after the last
        ticks = f"; ticks {loop['from_tick']} to {loop['to_tick'] - 1}, moved by {', '.join(loop['outside'])}"
    out.print(f"{report['method']}, input: {report['input']}{ticks}", markup=False)
    rows = table("order", "error µm rms", "AIC", "validation µm rms")
    for candidate in report["candidates"]:
        name = f"{candidate['order']}" + (" ←" if candidate["order"] == report["order"] else "")
        figures = (f"{candidate['rms_error_um']:.5f}", f"{candidate['aic']:.4f}")
        rows.add_row(name, *figures, format_number(candidate["validation_rms_um"], ".5f"))
    out.print(rows)
    rows = table("mode", "Hz", "± (1σ)", "damping", "± (1σ)", "static share")
    for i, mode in enumerate(report["modes"]):
        rows.add_row(
            str(i), f"{mode['frequency_hz']:.3f}", format_number(mode["frequency_std_hz"], ".2g"),
            f"{mode['damping']:.5f}", format_number(mode["damping_std"], ".2g"), f"{mode['static_share']:.4f}",
        )  # fmt: skip
    out.print(rows)
    tests = report["tests"]
    out.print(
        f"static gain {report['static_gain']:.6g} ± {report['static_gain_std']:.2g} (1σ), part of the hysteresis "
        f"model, since D(0) = 1; "
        f"delay {count_text(report['delay_ticks'], 'sample')}; fit {report['fit_percent']:.2f} %"
    )
    out.print(
        f"residuals: {'white' if tests['white'] else 'not white'} "
        f"(largest autocorrelation {tests['largest_autocorrelation']:.3f}), "
        f"{'independent of' if tests['independent'] else 'correlated with'} the input "
        f"({tests['largest_cross_correlation']:.3f}, {tests['cross_ratio']:.2g} of its 99 % bound)"
    )
    if not tests["white"]:
        out.print("± assumes noise with the correlation of these residuals; an error of the input is not included")
    if report["level_correction"]:
        unit = "V" if report["input"] == "drive" else "µm"
        out.print(
            f"the levels of the input were corrected by up to {report['level_correction']:.3g} {unit}, from the "
            "settled position. The model of the hysteresis has this error at these levels."
        )
    _print_response(out, report["frequency_response"])
    print_files(out, report)


def _print_response(out: Console, comparison: dict[str, Any] | None) -> None:
    """Print the deviation of the model from a measured frequency response; for None, print no line."""
    if comparison:
        out.print(
            f"measured response, {comparison['from_hz']:.4g} to {comparison['to_hz']:.4g} Hz: median deviation "
            f"{100 * comparison['median_deviation']:.2f} %, largest {100 * comparison['largest_deviation']:.1f} % at "
            f"{comparison['largest_at_hz']:.4g} Hz; peak at {comparison['measured_peak_hz']:.4g} Hz, model "
            f"{comparison['model_peak_hz']:.4g} Hz"
        )
