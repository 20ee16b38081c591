"""`rtloop design auto`: two recordings and a specification in, a configuration and its verification out."""

from __future__ import annotations

import os
from pathlib import Path

import click

from rtloop.commands.design import verify_configuration
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.design.chain import Chain, configuration_text, designed
from rtloop.design.identification.identified import write_new
from rtloop.design.identification.measured import measured
from rtloop.design.synthesis.hinf.assumptions import NoController
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.errors import ConfigError, NoDesign


def design_from_recordings(
    hysteresis: Path, step: Path, specs: Path, out: Path, axis: str | None, order: int | None, as_json: bool
) -> int:
    """Write the configuration `out`, verify it, and return the verdict's exit code. Raises RtloopError."""
    chain = write_design(hysteresis, step, specs, out, axis, order)
    dynamics, found = chain.dynamics, chain.synthesis
    modes = ", ".join(f"{mode.frequency_hz:.1f} Hz (ζ {mode.damping:.4f})" for mode in dynamics.modes)
    click.echo(
        f"{out}: h/H {chain.hysteresis.model_loop.percent:.2f} %; {modes}; {dynamics.delay_ticks} samples of delay; "
        f"γ {found.achieved:.4g}, controller of order {found.controller.order}",
        err=True,
    )
    return verify_configuration(out, None, None, as_json)


def write_design(
    hysteresis: Path, step: Path, specs: Path, out: Path, axis: str | None = None, order: int | None = None
) -> Chain:
    """From two recordings and a specification to a configuration at `out` that `check` accepts. Raises RtloopError."""
    specification = load_specification(specs)
    slow, fast = measured(hysteresis, axis), measured(step, axis)
    try:
        chain = designed(slow, fast, specification.design, order)
    except NoController as error:
        raise NoDesign(f"{specs}: {error}") from None
    except ValueError as error:
        raise ConfigError(str(specs), [str(error)]) from None
    folder = out.resolve().parent
    name = os.path.relpath(specs.resolve(), folder)
    text = configuration_text(chain, slow, fast, axis, name, specification.text)
    prepare(parse(text, out.stem, folder, str(out)))
    write_new(out, text)
    return chain
