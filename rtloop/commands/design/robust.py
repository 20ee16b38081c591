"""What `rtloop design robust` and `rtloop design shape` do: from files to files and words."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from rtloop.commands.output import write_configuration, write_over
from rtloop.configuration.file import load
from rtloop.configuration.text_files import read_text
from rtloop.design.robust.search import RobustDesign, find_robust_controller
from rtloop.design.robust.section import (
    insert_controller,
    insert_taps,
    robust_configuration,
    robust_section,
    taps_section,
)
from rtloop.design.robust.shape import TapDesign, design_taps
from rtloop.design.robust.subject import load_subject
from rtloop.design.synthesis.hinf.assumptions import NoController
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.errors import ConfigError, NoDesign
from rtloop.terminal.machine import echo_json
from rtloop.terminal.robust import print_robust, print_shaped


def search_specification(spec: Path, config: Path | None, out: Path | None, axis: str, as_json: bool) -> int:
    """Write a configuration with the controller to `out`, or its section to stdout.

    `config` is the configuration that it goes into. Raises ConfigError, NoDesign, OutputError.
    """
    path, text, design = load_specification(spec)
    if config is not None:
        _require_axis(config, axis)
    try:
        found = find_robust_controller(design, lambda line: click.echo(line, err=True))
    except NoController as error:
        raise NoDesign(f"{spec}: {error}") from None
    except ValueError as error:
        raise ConfigError(str(spec), [str(error)]) from None
    whole = None
    if config is not None:
        whole = insert_controller(read_text(config), found, design, path.name, text, axis)
    elif out is not None:
        beside = os.path.relpath(path.resolve(), out.resolve().parent)
        whole = robust_configuration(found, design, path.name, text, axis, beside)
    if out is not None and whole is not None:
        write_configuration(out, whole)
    if as_json:
        echo_json(_robust_as_dict(found, out))
        return 0
    print_robust(found)
    if out is None:
        click.echo(whole if whole is not None else robust_section(found, design, path.name, text), nl=False)
    else:
        click.echo(f"{out}: rtloop design shape {out} makes the taps of its reference")
    return 0


def shape_configuration(
    config: Path, spec: Path | None, out: Path | None, axis: str, plot: Path | None, as_json: bool
) -> int:
    """Write CONFIG with both rows of taps to `out`, or their section to stdout; a picture to `plot`.

    Raises ConfigError, NoDesign, OutputError, MissingExtra.
    """
    configuration = load(config)
    _, subject, spec = load_subject(configuration, axis, spec)
    try:
        found = design_taps(subject, curve=plot is not None, progress=lambda line: click.echo(line, err=True))
    except NoDesign as error:
        raise NoDesign(f"{config}: {error}") from None
    files = []
    if out is not None:
        beside = os.path.relpath(spec.resolve(), out.resolve().parent)
        write_configuration(out, insert_taps(read_text(config), found, subject, config.name, axis, beside))
        files.append(out)
    if plot is not None:
        from rtloop.design.robust.plots import draw_taps

        write_over(plot, draw_taps(found, subject, f"{configuration.name}, axis {axis}"))
        files.append(plot)
    if as_json:
        echo_json(_shaped_as_dict(found, files))
        return 0
    print_shaped(found, subject)
    if out is None:
        click.echo(taps_section(found, subject, config.name), nl=False)
    for file in files:
        click.echo(file, err=True)
    return 0


def _require_axis(config: Path, axis: str) -> None:
    """Before minutes are spent. Raises ConfigError."""
    names = [one.name for one in load(config).axes]
    if axis not in names:
        raise ConfigError(str(config), [f"axis: {axis!r} is not there; the configuration has {', '.join(names)}"])


def _robust_as_dict(found: RobustDesign, out: Path | None) -> dict[str, Any]:
    controller, proof = found.controller, found.certificate
    return {
        "gain": controller.gain,
        "zeros": [[root.real, root.imag] for root in controller.zeros],
        "poles": [[root.real, root.imag] for root in controller.poles],
        "plants": proof.plants,
        "worst": {
            name: {"value": worst.value, "scenario": str(worst.scenario)}
            for name, worst in zip(proof._fields[1:], proof[1:], strict=True)
        },
        "output": None if out is None else str(out),
    }


def _shaped_as_dict(found: TapDesign, files: list[Path]) -> dict[str, Any]:
    return {
        "taps": found.taps.reference.tolist(),
        "command_taps": found.taps.command.tolist(),
        "settling_ms": found.settling_ms,
        "fastest_ms": found.fastest_ms,
        "variation": found.variation,
        "plants": found.proved_count,
        "worst": found.proof._asdict(),
        "trade_off": [list(point) for point in found.curve],
        "files": [str(file) for file in files],
    }
