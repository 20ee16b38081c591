"""`rtloop design synthesise`: an H∞ controller from a specification, as a configuration or its section."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, OUTPUT
from rtloop.cli.output import echo_json
from rtloop.cli.output.files import path_from, write_configuration
from rtloop.errors import ConfigError, NoDesign

if TYPE_CHECKING:
    from rtloop.design.synthesis.specification import DesignOptions
    from rtloop.design.synthesis.synthesise import Synthesis
    from rtloop.linear.transfer import Transfer


@click.group()
def design() -> None:
    """Design controllers from specifications, and verify them."""


@design.command()
@click.argument("spec", type=OUTPUT)
@click.option("--out", type=OUTPUT, help="The configuration to write [the section alone, to stdout].")
@click.option("--axis", default="x", show_default=True, help="Name of the axis in the configuration that is written.")
@click.option("--cross-check", is_flag=True, help="Compute γ with SLICOT as well (needs the extra 'slycot').")
@JSON
@report_errors
def synthesise(spec: Path, out: Path | None, axis: str, cross_check: bool, as_json: bool) -> None:
    """Compute the H∞ controller for SPEC.toml.

    The order of the controller is reduced; the result is written as [axis.controller].

    SPEC.toml names plant and specification; deploy/paper-spec.toml is a complete example. The file of --out is a
    configuration with a simulated rig of that plant, for `check`, `run` and `ctl controller`. Exit 1 where no
    controller meets the specification; the message names the condition that fails.
    """
    from rtloop.design.synthesis.section import controller_configuration, controller_section
    from rtloop.design.synthesis.specification_file import load_specification
    from rtloop.design.synthesis.synthesise import synthesise_design

    path, text, design = load_specification(spec)
    with design_errors(spec):
        synthesis = synthesise_design(design)
    slicot = _slicot_gamma(synthesis, design) if cross_check else None
    if out is not None:
        content = controller_configuration(synthesis, design, path.name, text, axis, path_from(out, path))
        write_configuration(out, content)
    if as_json:
        echo_json(_as_dict(synthesis, slicot, out))
        return
    _print_synthesis(synthesis, slicot)
    if out is None:
        click.echo(controller_section(synthesis, design, path.name, text), nl=False)
    else:
        click.echo(
            f"{out} is written. To judge it: rtloop check {out}. To swap it into a running loop: "
            f"rtloop ctl controller {axis} {out}"
        )


@contextmanager
def design_errors(spec: Path) -> Iterator[None]:
    """Convert NoController to NoDesign, and ValueError to ConfigError, inside the block; both name the file `spec`."""
    from rtloop.design.synthesis.hinf.assumptions import NoController

    try:
        yield
    except NoController as error:
        raise NoDesign(f"{spec}: {error}") from None
    except ValueError as error:
        raise ConfigError(str(spec), [str(error)]) from None


def _slicot_gamma(synthesis: Synthesis, design: DesignOptions) -> float:
    """Return γ_opt by SLICOT. Raises MissingExtra without slycot, ValueError without a plant."""
    from rtloop.design.synthesis.hinf.augment import augment
    from rtloop.design.synthesis.hinf.slicot import slicot_gamma

    if design.plant is None:
        raise ValueError("plant: missing; --cross-check needs [plant]")
    return slicot_gamma(augment(design.plant.transfer(), synthesis.weights), 10 * synthesis.hinf.gamma_opt)[0]


def _as_dict(synthesis: Synthesis, slicot: float | None, out: Path | None) -> dict[str, Any]:
    """Return the JSON report; `slicot` is γ_opt by SLICOT, or None."""
    controller = synthesis.controller
    return {
        "gamma_opt": synthesis.hinf.gamma_opt,
        "gamma": synthesis.hinf.gamma,
        "achieved": synthesis.hinf.achieved,
        "limiting": synthesis.hinf.limiting,
        "gamma_opt_slicot": slicot,
        "full_order": synthesis.full.order,
        "hankel": synthesis.hankel.tolist(),
        "order": controller.order,
        "achieved_reduced": synthesis.achieved,
        **controller_fields(controller),
        "output": None if out is None else str(out),
    }


def controller_fields(controller: Transfer) -> dict[str, Any]:
    """Return the JSON fields of a controller: gain, zeros and poles as [real, imaginary], in 1/s."""
    roots = {"zeros": controller.zeros, "poles": controller.poles}
    fields = {name: [[root.real, root.imag] for root in values] for name, values in roots.items()}
    return {"gain": controller.gain, **fields}


def _print_synthesis(synthesis: Synthesis, slicot: float | None) -> None:
    """Print γ, orders and norms on stderr; stdout is for the section."""
    hinf = synthesis.hinf
    click.echo(f"γ_opt {hinf.gamma_opt:.6g}; the condition that fails for a smaller γ: {hinf.limiting}", err=True)
    if slicot is not None:
        click.echo(
            f"γ_opt by SLICOT's SB10AD: {slicot:.6g} ({100 * (slicot / hinf.gamma_opt - 1):+.5f} % from the value "
            "above)",
            err=True,
        )
    click.echo(
        f"‖F_l(P, C)‖∞ on the model with its delay: {hinf.achieved:.6g} with the controller of order "
        f"{synthesis.full.order}, made for γ = {hinf.gamma:.6g}; {synthesis.achieved:.6g} with the written controller "
        f"of order {synthesis.controller.order}",
        err=True,
    )
