"""`rtloop design auto`: two recordings and a specification in, a verified configuration out."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.identify import AXIS
from rtloop.cli.options import JSON, OUTPUT, TARGET
from rtloop.cli.output.progress import StatusLine
from rtloop.cli.robust import print_taps
from rtloop.cli.verify import verify_configuration
from rtloop.errors import NoDesign
from rtloop.workbench.written_files import path_from

if TYPE_CHECKING:
    from rtloop.design.chain import Chain
    from rtloop.design.robust.chain import RobustChain
    from rtloop.design.robust.search import Progress


@click.command()
@click.argument("hysteresis", metavar="HYST", type=OUTPUT)
@click.argument("step", metavar="STEP", type=OUTPUT)
@click.option("--specs", type=OUTPUT, required=True, help="Specification of the loop; its [plant] is not used.")
@click.option(
    "--out", type=TARGET, required=True, help="Configuration file to write; an existing file is not overwritten."
)
@AXIS
@click.option(
    "--order", type=click.IntRange(1, 20), help="Number of poles of the dynamics.  [default: found by a search]"
)
@click.option(
    "--robust",
    is_flag=True,
    help="Design a controller that damps the resonance, and the taps of the pre-filter; takes minutes, not seconds.",
)
@JSON
@report_errors
def auto(
    hysteresis: Path, step: Path, specs: Path, out: Path, axis: str | None, order: int | None, robust: bool,
    as_json: bool,
) -> int:  # fmt: skip
    """Identify, synthesise, write a configuration, verify it.

    Makes a runnable configuration from two recordings and a specification. With --robust: the controller of
    `rtloop design robust` and the taps of `rtloop design shape`, by [scenarios], [robust] and [shape] of the
    specification.

    HYST is a slow sine from rest, STEP a step; driver and limits are taken from the recording STEP. Exit 1 where
    the loop misses the specification; the configuration is written even then.
    """
    from rtloop.design.chain import reference_values
    from rtloop.design.identification.model_sections import require_new
    from rtloop.design.written_reference import describe_reference

    require_new(out)
    recordings = (hysteresis, step, specs, out, axis, order)
    synthesised_norm = 0.0
    if robust:
        with StatusLine("identifying the stage", sys.stderr) as status:

            def show(line: str) -> None:
                click.echo(line, err=True)
                status.update("searching a controller and taps")

            loop = write_robust_design(*recordings, show)
        print_taps(loop.taps, loop.subject)
        controller_percent, options = loop.design.scenarios.resonance_percent, loop.subject.options
        figures = (
            f"the controller damps resonances within ±{controller_percent:g} % of the model's; the pre-filter has "
            f"{options.taps} taps in each row, for resonances within ±{options.scenarios.resonance_percent:g} % and "
            f"gains within ±{options.scenarios.gain_percent:g} % (shape.scenarios)"
        )
        stage = loop.stage
    else:
        with StatusLine("identifying the stage and synthesising a controller", sys.stderr):
            chain = write_design(*recordings)
        synthesis, stage = chain.synthesis, chain.stage
        synthesised_norm = synthesis.achieved
        figures = (
            f"controller of order {synthesis.controller.order}; ‖F_l(P, C)‖∞, the norm of the weighted closed loop, is "
            f"{synthesised_norm:.4g} on the model with its delay"
        )
    click.echo(f"{out} is written. Identified: {stage.describe()}. Designed: {figures}", err=True)
    reference = describe_reference(reference_values(stage, axis))
    click.echo(f"[axis.reference] of {out}: {reference}. These steps replace the recordings' excitation", err=True)
    code = verify_configuration(out, None, None, as_json)
    if code and synthesised_norm > 1:
        click.echo(
            f"‖F_l(P, C)‖∞ is {synthesised_norm:.4g}, above 1: the loop may miss each requirement by up to this "
            "factor. Demand more in [weights.tracking] than the requirement does, or use --robust",
            err=True,
        )
    return code


def write_design(
    hysteresis: Path, step: Path, specs: Path, out: Path, axis: str | None = None, order: int | None = None
) -> Chain:
    """Identify the stage from two recordings, synthesise a controller, write the new configuration file `out`.

    Returns the Chain of all results: `stage`, `design` and `synthesis`. `hysteresis` records a slow sine from rest,
    `step` a step; `specs` is the specification file. `axis` None: the only axis; `order`, the number of poles of the
    dynamics, None: found by a search. Raises NoDesign if no controller exists, OutputError for an existing `out`,
    ConfigError for an invalid specification or a result that cannot run, other RtloopError for files that are
    unreadable or unsuitable; then nothing is written.
    """
    from rtloop.design.chain import configuration_text, design_controller, identify_stage
    from rtloop.design.identification.axis_recording import read_axis_recording
    from rtloop.design.synthesis.specification_file import load_specification
    from rtloop.workbench.design import design_errors

    specification = load_specification(specs)
    stage = identify_stage(read_axis_recording(hysteresis, axis), read_axis_recording(step, axis), order)
    with design_errors(specs):
        chain = design_controller(stage, specification.design)
    _check_and_write(configuration_text(chain, axis, path_from(out, specs), specification.text), out)
    return chain


def write_robust_design(
    hysteresis: Path, step: Path, specs: Path, out: Path, axis: str | None = None, order: int | None = None,
    progress: Progress = lambda _: None,
) -> RobustChain:  # fmt: skip
    """Identify the stage, and write a configuration with a controller that damps the resonance and with taps.

    The parameters are as for `write_design`; `progress` receives lines of text. Returns the RobustChain of all results.
    Raises the errors of `write_design`; if a controller exists but no taps, the configuration is written without taps,
    and NoDesign is raised.
    """
    from rtloop.design.chain import identify_stage
    from rtloop.design.identification.axis_recording import read_axis_recording
    from rtloop.design.robust.chain import NoTaps, design_robust_loop, require_specified
    from rtloop.design.synthesis.specification_file import load_specification

    specification = load_specification(specs)
    require_specified(specification.design, str(specs))
    stage = identify_stage(read_axis_recording(hysteresis, axis), read_axis_recording(step, axis), order)
    progress(stage.describe())
    folder, reference = out.resolve().parent, path_from(out, specs)
    try:
        chain, text = design_robust_loop(
            stage, specification.design, axis, folder, reference, specification.text, progress
        )
    except NoTaps as error:
        _check_and_write(error.text, out)
        raise NoDesign(
            f"{specs}: {error}. {out} is written with the controller that was found, but without taps, so that steps "
            f"of the reference are not shaped. To judge the loop: rtloop design verify {out}"
        ) from None
    except NoDesign as error:
        raise NoDesign(f"{specs}: {error}") from None
    _check_and_write(text, out)
    return chain


def _check_and_write(text: str, out: Path) -> None:
    """Write a configuration to the new file `out`, once `prepare` accepts it.

    Raises ConfigError for a configuration that cannot run, OutputError for a file that exists or cannot be written.
    """
    from rtloop.configuration.file import parse
    from rtloop.configuration.prepare import prepare
    from rtloop.design.identification.model_sections import write_new_file

    prepare(parse(text, out.stem, out.resolve().parent, str(out)))
    write_new_file(out, text)
