"""`rtloop design synthesise`: from a specification to a controller, as a configuration or its section."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from rtloop.commands.output import write_configuration
from rtloop.design.synthesis.hinf.assumptions import NoController
from rtloop.design.synthesis.hinf.augment import augment
from rtloop.design.synthesis.section import controller_configuration, controller_section
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.design.synthesis.synthesise import Synthesis, synthesise_design
from rtloop.errors import ConfigError, NoDesign
from rtloop.terminal.design import print_synthesis
from rtloop.terminal.machine import echo_json


def synthesise_specification(spec: Path, out: Path | None, axis: str, cross_check: bool, as_json: bool) -> int:
    """Write a configuration with the controller on `axis` to `out`, or [axis.controller] to stdout.

    Raises ConfigError, NoDesign, OutputError, MissingExtra.
    """
    path, text, design = load_specification(spec)
    try:
        found = synthesise_design(design)
    except NoController as error:
        raise NoDesign(f"{spec}: {error}") from None
    except ValueError as error:
        raise ConfigError(str(spec), [str(error)]) from None
    other = _slicot(found, design) if cross_check else None
    if out is not None:
        beside = os.path.relpath(path.resolve(), out.resolve().parent)
        whole = controller_configuration(found, design, path.name, text, axis, beside)
        write_configuration(out, whole)
    if as_json:
        echo_json(_as_dict(found, other, out))
        return 0
    print_synthesis(found, other)
    if out is None:
        click.echo(controller_section(found, design, path.name, text), nl=False)
    else:
        click.echo(f"{out}: rtloop check judges it; rtloop ctl controller {axis} {out} swaps it into a running loop")
    return 0


def _slicot(found: Synthesis, design: DesignOptions) -> float:
    from rtloop.design.synthesis.hinf.slicot import slicot_gamma

    assert design.plant is not None
    return slicot_gamma(augment(design.plant.transfer(), found.weights), 10 * found.hinf.gamma_opt)[0]


def _as_dict(found: Synthesis, other: float | None, out: Path | None) -> dict[str, Any]:
    controller = found.controller
    return {
        "gamma_opt": found.hinf.gamma_opt,
        "gamma": found.hinf.gamma,
        "achieved": found.hinf.achieved,
        "limiting": found.hinf.limiting,
        "gamma_opt_slicot": other,
        "full_order": found.full.order,
        "hankel": found.hankel.tolist(),
        "order": controller.order,
        "achieved_reduced": found.achieved,
        "gain": controller.gain,
        "zeros": [[root.real, root.imag] for root in controller.zeros],
        "poles": [[root.real, root.imag] for root in controller.poles],
        "output": None if out is None else str(out),
    }
