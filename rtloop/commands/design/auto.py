"""`rtloop design auto`: two recordings and a specification in, a configuration and its verification out."""

from __future__ import annotations

import os
from pathlib import Path

import click

from rtloop.commands.design.verify import verify_configuration
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.design.chain import Chain, configuration_text, design_controller, identify_stage
from rtloop.design.identification.axis_recording import read_axis_recording
from rtloop.design.identification.model_sections import write_new_file
from rtloop.design.robust.chain import RobustChain, design_robust_loop, require_specified
from rtloop.design.robust.search import Progress
from rtloop.design.synthesis.hinf.assumptions import NoController
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.errors import ConfigError, NoDesign
from rtloop.terminal.robust import print_shaped


def design_from_recordings(
    hysteresis: Path, step: Path, specs: Path, out: Path, axis: str | None, order: int | None, robust: bool,
    as_json: bool,
) -> int:  # fmt: skip
    """Write the configuration `out`, verify it, and return the verdict's exit code. Raises RtloopError."""
    if robust:
        made = write_robust_design(hysteresis, step, specs, out, axis, order, lambda line: click.echo(line, err=True))
        print_shaped(made.taps, made.subject)
        click.echo(
            f"{out}: {made.stage.describe()}; bears resonances within ±{made.design.scenarios.resonance_percent:g} %, "
            f"{made.subject.options.taps} taps a row for ±{made.subject.options.scenarios.resonance_percent:g} %",
            err=True,
        )
        return verify_configuration(out, None, None, as_json)
    chain = write_design(hysteresis, step, specs, out, axis, order)
    found = chain.synthesis
    click.echo(
        f"{out}: {chain.stage.describe()}; γ {found.achieved:.4g}, controller of order {found.controller.order}",
        err=True,
    )
    return verify_configuration(out, None, None, as_json)


def write_design(
    hysteresis: Path, step: Path, specs: Path, out: Path, axis: str | None = None, order: int | None = None
) -> Chain:
    """From two recordings and a specification to a configuration at `out` that `check` accepts. Raises RtloopError."""
    specification = load_specification(specs)
    stage = identify_stage(read_axis_recording(hysteresis, axis), read_axis_recording(step, axis), order)
    try:
        chain = design_controller(stage, specification.design)
    except NoController as error:
        raise NoDesign(f"{specs}: {error}") from None
    except ValueError as error:
        raise ConfigError(str(specs), [str(error)]) from None
    _write(configuration_text(chain, axis, _beside(specs, out), specification.text), out)
    return chain


def write_robust_design(
    hysteresis: Path, step: Path, specs: Path, out: Path, axis: str | None = None, order: int | None = None,
    progress: Progress = lambda _: None,
) -> RobustChain:  # fmt: skip
    """The same with a controller that damps the resonance, and taps. Raises RtloopError."""
    specification = load_specification(specs)
    require_specified(specification.design, str(specs))
    stage = identify_stage(read_axis_recording(hysteresis, axis), read_axis_recording(step, axis), order)
    progress(stage.describe())
    try:
        chain, text = design_robust_loop(
            stage, specification.design, axis, out.resolve().parent, _beside(specs, out), specification.text, progress
        )
    except NoDesign as error:
        raise NoDesign(f"{specs}: {error}") from None
    _write(text, out)
    return chain


def _beside(specs: Path, out: Path) -> str:
    return os.path.relpath(specs.resolve(), out.resolve().parent)


def _write(text: str, out: Path) -> None:
    """Checked as `check` does, then written."""
    prepare(parse(text, out.stem, out.resolve().parent, str(out)))
    write_new_file(out, text)
