"""`rtloop ctl response`, `identify response`, and both with `resonance`: the measured closed loop."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from rtloop.cli.ctl import AXIS as SERVICE_AXIS
from rtloop.cli.ctl import make_client
from rtloop.cli.exit_codes import report_errors
from rtloop.cli.identify import AXIS, PLOT
from rtloop.cli.options import JSON, OUTPUT, TARGET
from rtloop.cli.output import echo_json
from rtloop.values import to_jsonable
from rtloop.workbench.tables import console, format_number, table

TIMEOUT_FACTOR, TIMEOUT_EXTRA_S = 3.0, 60.0
"""A response may take this multiple of the measurement's duration, and this many seconds more."""
MARGINS = (
    ("crossover_hz", "crossover", "Hz"),
    ("gain_margin", "gain margin", ""),
    ("gain_margin_hz", "  at", "Hz"),
    ("phase_margin_deg", "phase margin", "°"),
    ("modulus_margin", "modulus margin", ""),
    ("max_sensitivity", "largest |S|", ""),
    ("max_sensitivity_hz", "  at", "Hz"),
)
AMPLITUDE = click.option(
    "--amplitude-um", default=0.5, show_default=True, type=click.FloatRange(0, min_open=True),
    help="Largest movement of the position, in µm.",
)  # fmt: skip
DURATION = click.option(
    "--duration",
    "duration_s",
    default=6.0,
    show_default=True,
    type=click.FloatRange(1, 60),
    help="Duration of the multisine at full amplitude, in s; multisines of smaller amplitude precede it.",
)
PERIOD = click.option(
    "--period",
    "period_s",
    type=click.FloatRange(0.05, 10),
    help="Period of the multisine, in s.  [default: chosen by the width of the lightly damped mode]",
)
NEAR = click.option(
    "--near-hz",
    type=click.FloatRange(0, min_open=True),
    help="Expected frequency of the lightly damped mode, in Hz.  [default: the model's]",
)
OUT = click.option("--out", type=TARGET, help="JSON file to write; an existing file is not overwritten.")


@click.command("response")
@SERVICE_AXIS
@AMPLITUDE
@click.option(
    "--from-hz",
    type=click.FloatRange(0, min_open=True),
    help="Lowest frequency of the multisine, in Hz.  [default: 2 / period]",
)
@click.option(
    "--to-hz",
    type=click.FloatRange(0, min_open=True),
    help="Highest frequency of the multisine, in Hz.  [default: 0.45 of the loop's rate]",
)
@DURATION
@PERIOD
@NEAR
@OUT
@PLOT
@JSON
@click.pass_context
@report_errors
def service_response(
    context: click.Context, out: Path | None, plot: Path | None, as_json: bool, **request: object
) -> None:
    """Measure the closed loop of AXIS: L, S, margins.

    Adds a multisine to the held reference, which is restored afterwards, also at Ctrl-C and at any error.
    """
    from rtloop.design.identification.model_sections import require_new

    require_new(out)
    _report_response(_measure(context, request), out, plot, as_json)


@click.command("resonance")
@SERVICE_AXIS
@AMPLITUDE
@DURATION
@PERIOD
@NEAR
@JSON
@click.pass_context
@report_errors
def service_resonance(context: click.Context, as_json: bool, **request: object) -> None:
    """Measure frequency and damping of the resonance of AXIS.

    The loop stays closed: a multisine is added to the held reference, which is restored afterwards.
    """
    _report_resonance(_measure(context, {**request, "resonance_only": True}), as_json)


@click.command("response")
@click.argument("run", type=OUTPUT)
@AXIS
@NEAR
@OUT
@PLOT
@JSON
@report_errors
def recording_response(
    run: Path, axis: str | None, near_hz: float | None, out: Path | None, plot: Path | None, as_json: bool
) -> None:
    """Compute L, S, margins and mode from a recorded response.

    RUN is a recording of a closed loop that a multisine excited: made during `rtloop ctl response`, or by the
    experiment `response`.
    """
    from rtloop.design.identification.model_sections import require_new
    from rtloop.design.identification.recorded_response import recorded_measurement

    require_new(out)
    _report_response(recorded_measurement(run, axis, near_hz).for_json(), out, plot, as_json)


@click.command("resonance")
@click.argument("run", type=OUTPUT)
@AXIS
@NEAR
@JSON
@report_errors
def recording_resonance(run: Path, axis: str | None, near_hz: float | None, as_json: bool) -> None:
    """Compute the lightly damped mode from a recorded response.

    Prints frequency and damping with their uncertainty. RUN is a recording of a closed loop as for `rtloop identify
    response`; `rtloop ctl resonance` measures the mode in a running loop.
    """
    from rtloop.design.identification.recorded_response import recorded_measurement

    _report_resonance(recorded_measurement(run, axis, near_hz).for_json(), as_json)


def _measure(context: click.Context, request: Mapping[str, Any]) -> dict[str, object]:
    """Let the service measure a closed loop by POST /response; return its answer, as `LoopMeasurement.for_json`.

    `request` are the command's options; options that are None are left out. After Ctrl-C the reference is restored and
    LoopFault is raised. Raises as `Client.measure`.
    """
    body = {name: value for name, value in request.items() if value is not None}
    return make_client(context).measure("/response", body, TIMEOUT_FACTOR * body["duration_s"] + TIMEOUT_EXTRA_S)


def _report_response(content: Mapping[str, object], out: Path | None, plot: Path | None, as_json: bool) -> None:
    """Print a measured closed loop, write it as JSON to the new file `out` and draw it to `plot`, if given.

    The files are written before the text is printed. Raises OutputError for an existing `out`, or if the system
    refuses; MissingExtra for `plot` without matplotlib, when `out` is written already.
    """
    from rtloop.design.identification.model_sections import write_new_file
    from rtloop.design.identification.plot_response import plot_response

    if out is not None:
        write_new_file(out, json.dumps(to_jsonable(content), allow_nan=False) + "\n")
    if plot is not None:
        plot_response(content, plot)
    if as_json:
        echo_json(content)
    else:
        _print_response(content, [file for file in (out, plot) if file])


def _report_resonance(content: Mapping[str, object], as_json: bool) -> None:
    """Print the lightly damped mode of a measured closed loop, `content`, as text or as JSON {resonance}.

    Raises UnsuitableData if the measurement shows no such mode.
    """
    from rtloop.design.identification.axis_recording import UnsuitableData

    if content["resonance"] is None:
        raise UnsuitableData(
            "no lightly damped mode stands out in the measured band; state its expected frequency with --near-hz HZ"
        )
    echo_json({"resonance": content["resonance"]}) if as_json else _print_resonance(content)


def _print_response(content: Mapping[str, Any], files: Sequence[Path]) -> None:
    """Print measured margins, the model's and the mode if `content` has them, the excitation, and written files."""
    out, model = console(), content["model"]
    rows = table("margin", "measured", "± (1σ)", "model", "")
    for name, label, unit in MARGINS:
        margin = content["margins"][name]
        model_text = format_number(model and model["margins"].get(name))
        rows.add_row(label, format_number(margin["value"]), format_number(margin["std"], ".2g"), model_text, unit)
    out.print(rows)
    if model:
        out.print(f"median of measured |L| divided by |L| of the model: {format_number(model['gain_ratio'])}")
    if content["resonance"]:
        _print_resonance(content)
    out.print(
        f"multisine of {content['lines']} frequencies, {content['from_hz']:g} … {content['to_hz']:g} Hz, "
        f"{content['periods']} periods; "
        f"the position moved by up to {content['moved_um']:.3g} µm"
    )
    for file in files:
        out.print(file, markup=False)


def _print_resonance(content: Mapping[str, Any]) -> None:
    """Print frequency and damping of the lightly damped mode with their uncertainty; warn of a large misfit."""
    from rtloop.analysis.measured.mode import LARGEST_MISFIT, NOT_LINEAR

    mode = content["resonance"]
    console().print(
        f"resonance {mode['hz']:.3f} ± {mode['hz_std']:.2g} Hz, damping {mode['damping']:.5f} ± "
        f"{mode['damping_std']:.2g} (1σ), fitted from {mode['from_hz']:g} to {mode['to_hz']:g} Hz; the residuals are "
        f"{mode['misfit']:.2g} times as large as the measurement's uncertainty explains"
    )
    if mode["misfit"] > LARGEST_MISFIT:
        console().print(f"[yellow]{NOT_LINEAR}[/]")
