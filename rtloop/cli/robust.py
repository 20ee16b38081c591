"""`rtloop design robust` and `rtloop design shape`: a controller that damps uncertain resonances, and its taps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import CONFIG, JSON, OUTPUT, TARGET
from rtloop.cli.output import echo_json
from rtloop.errors import ConfigError, NoDesign
from rtloop.workbench.written_files import path_from, write_configuration, write_output

if TYPE_CHECKING:
    from rtloop.design.robust.search import RobustDesign
    from rtloop.design.robust.shape import Subject, TapDesign


@click.command()
@click.argument("spec", type=OUTPUT)
@click.option(
    "--config", type=OUTPUT, help="Configuration in which the controller is replaced.  [default: a new configuration]"
)
@click.option(
    "--out",
    type=TARGET,
    help="Configuration file to write: a copy of --config with the new controller; without --config, a new "
    "configuration with a simulated rig.  [default: to stdout; without --config, only [axis.controller]]",
)
@click.option("--axis", default="x", show_default=True, help="Name of the axis in the configuration that is written.")
@JSON
@report_errors
def robust(spec: Path, config: Path | None, out: Path | None, axis: str, as_json: bool) -> None:
    """Search a controller for the ranges of SPEC.toml.

    It damps the resonances anywhere in their ranges. The controller is a PI part and biquads. Its slowest closed-loop
    mode around a resonance decays as fast as possible over all [scenarios], within limits on max |S|, disturbance and
    noise. It is certified over sweeps and random plants.

    Takes minutes; deploy/robust-spec.toml is a complete example. Exit 1 where no controller meets the limits.
    """
    from rtloop.configuration.file import load
    from rtloop.configuration.text_files import read_text
    from rtloop.design.robust.search import find_robust_controller
    from rtloop.design.robust.section import insert_controller, robust_configuration, robust_section
    from rtloop.design.synthesis.specification_file import load_specification
    from rtloop.workbench.design import design_errors

    path, text, design = load_specification(spec)
    if config is not None:
        names = [entry.name for entry in load(config).axes]
        if axis not in names:  # said now, not after minutes of searching
            raise ConfigError(str(config), [f"axis: {axis!r} is unknown; allowed: {', '.join(names)}"])
    with design_errors(spec):
        robust = find_robust_controller(design, lambda line: click.echo(line, err=True))
    content = None
    if config is not None:
        content = insert_controller(read_text(config), robust, design, path.name, text, axis)
    elif out is not None:
        content = robust_configuration(robust, design, path.name, text, axis, path_from(out, path))
    if out is not None and content is not None:
        write_configuration(out, content)
    if as_json:
        echo_json(_robust_as_dict(robust, out))
        return
    _print_robust(robust)
    if out is None:
        click.echo(content if content is not None else robust_section(robust, design, path.name, text), nl=False)
    else:
        click.echo(f"{out} is written. To make the taps of its reference: rtloop design shape {out}")


@click.command()
@CONFIG
@click.option("--spec", type=OUTPUT, help="Specification file.  [default: key `specification` of the axis]")
@click.option(
    "--out",
    type=TARGET,
    help="Configuration file to write: CONFIG with the new taps.  [default: only [axis.prefilter], to stdout]",
)
@click.option("--axis", default="x", show_default=True, help="Name of the axis for which the taps are made.")
@click.option(
    "--plot",
    type=TARGET,
    help="Picture (.png) to write: overshoot over settling time, and the step (needs rtloop[plot]).",
)
@JSON
@report_errors
def shape(config: Path, spec: Path | None, out: Path | None, axis: str, plot: Path | None, as_json: bool) -> None:
    """Make taps for the fastest steps that the drive allows.

    Computes both rows of [axis.prefilter] by linear programming over [shape.scenarios]: the least settling time, or
    shape.settling_ms if it is set, with which overshoot, undershoot and the command v stay within their limits, then
    the least variation of v.

    Exit 1 where no taps meet the limits; the message names a limit to relax, or the settling time that is possible.
    """
    from rtloop.configuration.file import load
    from rtloop.configuration.text_files import read_text
    from rtloop.design.robust.section import insert_taps, taps_section
    from rtloop.design.robust.shape import design_taps
    from rtloop.design.robust.subject import load_subject

    configuration = load(config)
    _, subject, spec = load_subject(configuration, axis, spec)
    try:
        tap_design = design_taps(subject, curve=plot is not None, progress=lambda line: click.echo(line, err=True))
    except NoDesign as error:
        raise NoDesign(f"{config}: {error}") from None
    if out is not None:
        write_configuration(
            out, insert_taps(read_text(config), tap_design, subject, config.name, axis, path_from(out, spec))
        )
    if plot is not None:
        from rtloop.design.robust.plots import draw_taps

        write_output(plot, draw_taps(tap_design, subject, f"{configuration.name}, axis {axis}"))
    files = [file for file in (out, plot) if file is not None]
    if as_json:
        echo_json(_taps_as_dict(tap_design, files))
        return
    print_taps(tap_design, subject, to_stderr=out is None)
    if out is None:
        click.echo(taps_section(tap_design, subject, config.name), nl=False)
    else:
        click.echo(f"{out} is written. To judge it: rtloop design verify {out}")
    if plot is not None:
        click.echo(plot, err=True)


def _robust_as_dict(robust: RobustDesign, out: Path | None) -> dict[str, object]:
    """Return the JSON report of a controller with its worst figures over all certified plants: {gain, zeros, poles,
    plants: their number, worst: {figure: {value, scenario: text}}, output: `out` as text}.

    `out` is the configuration that was written, None if there is none.
    """
    from rtloop.workbench.design import controller_fields

    controller, proof = robust.controller, robust.certificate
    return {
        **controller_fields(controller),
        "plants": proof.plants,
        "worst": {
            name: {"value": worst_case.value, "scenario": str(worst_case.scenario)}
            for name, worst_case in zip(proof._fields[1:], proof[1:], strict=True)
        },
        "output": None if out is None else str(out),
    }


def _taps_as_dict(tap_design: TapDesign, files: list[Path]) -> dict[str, object]:
    """Return the JSON report of both rows of taps: {taps, command_taps, settling_ms, fastest_ms: the least possible,
    variation, plants: number of proved ones, worst: figures over them, trade_off: [[settling ms, overshoot], …],
    files}.

    The overshoot is a fraction; `trade_off` is [] if it was not computed. `files` are the files that were written.
    """
    return {
        "taps": tap_design.taps.reference.tolist(),
        "command_taps": tap_design.taps.command.tolist(),
        "settling_ms": tap_design.settling_ms,
        "fastest_ms": tap_design.fastest_ms,
        "variation": tap_design.variation,
        "plants": tap_design.proved_count,
        "worst": tap_design.proof._asdict(),
        "trade_off": [list(point) for point in tap_design.curve],
        "files": [str(file) for file in files],
    }


def _print_robust(robust: RobustDesign) -> None:
    """Print the worst value of each certified figure on stderr, because stdout may get the controller's section."""
    from rtloop.design.robust.section import certified_values

    click.echo(
        f"the controller is designed for {robust.scenario_count} scenarios; worst figures on "
        f"{robust.certificate.plants} plants:",
        err=True,
    )
    for name, value, scenario in certified_values(robust.certificate):
        click.echo(f"  {name} {value:.4g}   ({scenario})", err=True)


def print_taps(tap_design: TapDesign, subject: Subject, *, to_stderr: bool = True) -> None:
    """Print settling time, overshoot and range of the command v of taps, for the plants and bounds of `subject`.

    The least overshoot for each settling time is printed too, if it was computed.

    The lines go to stderr, because stdout may get another result, or to stdout if `to_stderr` is False.
    """
    proof = tap_design.proof
    for line in (
        f"settling time ({subject.options.band_percent:g} %) {tap_design.settling_ms:.4g} ms; with overshoot ≤ "
        f"{100 * subject.overshoot:g} %, the least possible is {tap_design.fastest_ms:.4g} ms. "
        "A longer shape.settling_ms gives less overshoot. "
        f"Total variation of the command v: {tap_design.variation:.3g} per unit step",
        f"worst figures of {tap_design.proved_count} plants, between ticks too: settling (5 %) "
        f"{proof.settling_ms:.4g} ms, overshoot {100 * proof.overshoot:.3g} %, "
        f"undershoot {100 * proof.undershoot:.3g} %, "
        f"v {proof.lowest_command:.4g} … {proof.highest_command:.4g} per unit step",
        f"steps of up to {subject.bounds.step_um:g} µm between {subject.bounds.lowest_um:.4g} and "
        f"{subject.bounds.highest_um:.4g} µm keep the command v within "
        f"{subject.bounds.low_um:.4g} … {subject.bounds.high_um:.4g} µm",
    ):
        click.echo(line, err=to_stderr)
    if tap_design.curve:
        points = ", ".join(
            f"{settling_ms:.3g} ms: {100 * overshoot:.2g} %" for settling_ms, overshoot in tap_design.curve
        )
        click.echo(f"least overshoot for each settling time: {points}", err=to_stderr)
