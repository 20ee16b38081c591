"""`rtloop.design`: the H∞ controller of a specification, of reduced order."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtloop.analysis.closed_loop import continuous_loop
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.design.identification.model_sections import read_identified
from rtloop.design.synthesis.hinf.assumptions import NoController
from rtloop.design.synthesis.hinf.augment import augment
from rtloop.design.synthesis.section import controller_configuration, controller_section
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.design.synthesis.specification_file import SpecificationFile, load_specification
from rtloop.design.synthesis.synthesise import Synthesis, synthesise_design
from rtloop.errors import ConfigError, NoDesign
from rtloop.hysteresis.play_model import PlayModel
from rtloop.linear.transfer import Transfer
from rtloop.values import to_jsonable
from rtloop.workbench.arguments import FileName, as_path
from rtloop.workbench.result import Result
from rtloop.workbench.written_files import path_from, write_configuration

if TYPE_CHECKING:
    import control
    from matplotlib.figure import Figure
    from rich.console import Console


@dataclass(repr=False, eq=False)
class DesignResult(Result):
    """Designed controller: `synthesis` has the norms and the controller before and after reduction.

    `slicot_gamma` is γ_opt by SLICOT; None unless it was computed. `actuator` is the identified one, for the
    feedforward; None without it. `output` is the file that `write` wrote, None before.
    """

    specification: SpecificationFile
    synthesis: Synthesis
    slicot_gamma: float | None
    actuator: PlayModel | None = None
    output: Path | None = None

    @property
    def controller(self) -> Transfer:
        """C(s) of reduced order as zeros, poles (1/s) and gain."""
        return self.synthesis.controller

    @property
    def gamma(self) -> float:
        """γ, bound on the norm of the weighted closed loop, for which the controller of full order was made."""
        return self.synthesis.hinf.gamma

    @property
    def gamma_opt(self) -> float:
        """Least γ, bound on the norm of the weighted closed loop, that a controller can reach."""
        return self.synthesis.hinf.gamma_opt

    @property
    def achieved(self) -> float:
        """‖F_l(P, C)‖∞, the norm of the weighted closed loop with the controller of reduced order. Above 1, each
        requirement is met only if it is relaxed by this factor.
        """
        return self.synthesis.achieved

    @property
    def order(self) -> int:
        """Order of the controller after reduction."""
        return self.controller.order

    @property
    def full_order(self) -> int:
        """Order of the controller before reduction."""
        return self.synthesis.full.order

    @property
    def section(self) -> str:
        """The controller as the section [axis.controller] of a configuration."""
        path, text, design = self.specification
        return controller_section(self.synthesis, design, path.name, text)

    @property
    def headline(self) -> str:
        """The controller's order, its order before reduction, γ_opt and ‖F_l(P, C)‖∞, in one line."""
        order = f"controller of order {self.order} ({self.full_order} before reduction)"
        return f"{order}, γ_opt {self.gamma_opt:.6g}, ‖F_l(P, C)‖∞ {self.achieved:.6g}"

    @property
    def summary_lines(self) -> list[str]:
        """Lines with γ_opt and the condition that limits it, by SLICOT too if computed, and norms before and after the
        reduction of the order.
        """
        hinf, lines = self.synthesis.hinf, list[str]()
        lines.append(
            f"γ_opt {hinf.gamma_opt:.6g} is the smallest γ that a controller reaches, γ being the bound on the norm of "
            f"the weighted closed loop; with a smaller γ, a condition is not met: {hinf.limiting}"
        )
        if self.slicot_gamma is not None:
            deviation_percent = 100 * (self.slicot_gamma / hinf.gamma_opt - 1)
            lines.append(
                f"γ_opt by SLICOT's SB10AD: {self.slicot_gamma:.6g} ({deviation_percent:+.5f} % from the value above)"
            )
        lines.append(
            "‖F_l(P, C)‖∞, the norm of the weighted closed loop, on the model with its delay: "
            f"{hinf.achieved:.6g} with the full controller (order {self.full_order}, designed for γ = "
            f"{hinf.gamma:.6g}); {self.achieved:.6g} with the written controller (order {self.order}, after reduction)"
        )
        return lines

    def to_control(self) -> control.StateSpace | control.FrequencyResponseData:
        """Return C(s) as a continuous StateSpace of python-control, a required package."""
        from rtloop.design.interchange import to_control

        return to_control(self.controller)

    def as_dict(self) -> dict[str, Any]:
        """Return the object of `rtloop design synthesise --json`."""
        synthesis = self.synthesis
        return to_jsonable(
            {
                "gamma_opt": self.gamma_opt,
                "gamma": self.gamma,
                "achieved": synthesis.hinf.achieved,
                "limiting": synthesis.hinf.limiting,
                "gamma_opt_slicot": self.slicot_gamma,
                "full_order": self.full_order,
                "hankel": synthesis.hankel,
                "order": self.order,
                "achieved_reduced": self.achieved,
                "verdict": self.verdict,
                **controller_fields(self.controller),
                "output": self.output,
            }
        )

    def print_text(self, out: Console) -> None:
        """Print γ, orders and norms, then the section of the controller."""
        for line in [*self.summary_lines, "", self.section.rstrip()]:
            out.print(line, markup=False)

    def plot(self) -> Figure:
        """Return a picture of the loop of C(s) and the plant of the design, without sampling or delay.

        Raises MissingExtra without matplotlib.
        """
        from rtloop.workbench.loop_picture import draw_loops

        plant = self.specification.design.required_plant.transfer()
        return draw_loops({self.specification.path.stem: {"continuous C(s)": continuous_loop(self.controller, plant)}})

    def write(self, path: FileName, axis: str = "x") -> Path:
        """Write a configuration with the controller and a simulated rig of the design's plant. Returns the file's path.

        The path is also stored as `output`. An existing file is replaced. `axis` is the name of the axis. Raises
        ConfigError for a configuration that cannot run, and then writes no file; OutputError if the system refuses.
        """
        target = as_path(path, "write: path")
        source, text, design = self.specification
        reference = path_from(target, source)
        content = controller_configuration(self.synthesis, design, source.name, text, axis, reference, self.actuator)
        write_configuration(target, content)
        self.output = target
        return target

    @cached_property
    def verdict(self) -> str:
        """The sentence of `rtloop check` on the loop of the plant and the sampled controller, by the specification.

        "not judged: " and the faults if a configuration of plant and controller is invalid.
        """
        from rtloop.design.verification.axes import verify_axis  # half a second of import
        from rtloop.design.verification.text import answer

        source, text, design = self.specification
        content = controller_configuration(self.synthesis, design, source.name, text, "x", source.name, self.actuator)
        try:
            prepared = prepare(parse(content, source.stem, source.parent, str(source)))
        except ConfigError as error:
            return f"not judged: {error}"
        verification, _ = verify_axis(prepared.configuration, prepared.checks[0], None)
        return answer(verification)


def design(specification: FileName, *, model: FileName | None = None, cross_check: bool = False) -> DesignResult:
    """Compute the H∞ controller for a specification file, and reduce its order.

    `model` is a file with [axis.model], as `identify` writes it, in place of the specification's [plant]; its
    [axis.feedforward] goes into the configuration that `write` writes. `cross_check` computes γ_opt with SLICOT too.
    A controller may miss the specification: see `verdict`. Raises InputFileError for a file that cannot be read,
    ConfigError for an invalid or incomplete specification, NoDesign where no controller has γ up to the specification's
    `largest_gamma` or none runs at the rate, MissingExtra for `cross_check` without slycot.

    >>> result = rtloop.design("deploy/paper-spec.toml")
    >>> result.order, result.full_order, round(result.gamma_opt, 3)
    (5, 11, 1.676)
    """
    file, actuator = load_specification(as_path(specification, "design: specification")), None
    if model is not None:
        identified = read_identified(as_path(model, "design: model"))
        file = file._replace(design=file.design.model_copy(update={"plant": identified.model}))
        actuator = identified.feedforward and identified.feedforward.actuator()
    with design_errors(file.path):
        synthesis = synthesise_design(file.design)
    slicot = _slicot_gamma(synthesis, file.design) if cross_check else None
    absolute = file._replace(path=file.path.resolve())  # `write` may be called in another working directory
    return DesignResult(absolute, synthesis, slicot, actuator)


@contextmanager
def design_errors(spec: Path) -> Iterator[None]:
    """Convert NoController to NoDesign, and ValueError to ConfigError, inside the block; both name the file `spec`."""
    try:
        yield
    except NoController as error:
        raise NoDesign(f"{spec}: {error}") from None
    except ValueError as error:
        raise ConfigError(str(spec), [str(error)]) from None


def _slicot_gamma(synthesis: Synthesis, design: DesignOptions) -> float:
    """Return γ_opt by SLICOT. Raises MissingExtra without slycot, ValueError without a plant."""
    from rtloop.design.synthesis.hinf.slicot import slicot_gamma  # needs the extra slycot

    if design.plant is None:
        raise ValueError("plant: missing; --cross-check needs [plant] in the specification")
    return slicot_gamma(augment(design.plant.transfer(), synthesis.weights), 10 * synthesis.hinf.gamma_opt)[0]


def controller_fields(controller: Transfer) -> dict[str, object]:
    """Return {gain, zeros, poles} of a controller for JSON; the roots as lists of [real, imaginary], in 1/s."""
    roots = {"zeros": controller.zeros, "poles": controller.poles}
    fields = {name: [[root.real, root.imag] for root in values] for name, values in roots.items()}
    return {"gain": controller.gain, **fields}
