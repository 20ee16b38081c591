"""What is known of the axes before they run: their controllers as they will run, and their loops on their models."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rtloop.analysis.closed_loop import Loop, continuous_loop, discrete_loop
from rtloop.analysis.comparison import ControllerComparison, compare_controllers
from rtloop.analysis.coupled_loop import CoupledLoop, CoupledPlant, SimultaneousMargins, coupling_matrix
from rtloop.analysis.loop_analysis import LoopAnalysis, analyse_loop
from rtloop.analysis.margins import Margins, loop_margins
from rtloop.analysis.reference import UNFILTERED, ReferencePath
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.coefficients import controller_of
from rtloop.configuration.extras import connect
from rtloop.configuration.file import Configuration
from rtloop.configuration.rig import rig_delay_ticks
from rtloop.laws.contract import Controller, CoupledController
from rtloop.laws.limited.trial import needs_limited_process, run_limited
from rtloop.laws.linearise import linear_part
from rtloop.laws.options import ControllerOptions
from rtloop.laws.shipped.transfer import TransferController
from rtloop.linear.coupled_systems import SampledCoupledSystem
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.sampled import SampledController
from rtloop.linear.transfer import Transfer

COMPARED_PART = 0.2
"""C(z) is compared with C(s) up to this part of the rate; toward half of it every method must differ."""


@dataclass
class Findings:
    """What is wrong with a configuration, and what should not be."""

    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @contextmanager
    def at(self, where: str) -> Iterator[None]:
        """A ValueError raised within is a fault at `where`, and what follows goes on."""
        try:
            yield
        except ValueError as error:
            self.faults.append(f"{where}{error}")


@dataclass(frozen=True)
class Together:
    """Of an axis whose controller has several: their names, its number among them, and their loop on their models."""

    axes: tuple[str, ...]
    place: int
    law: CoupledController
    linear: SampledCoupledSystem | None = None
    plant: CoupledPlant | None = None
    loop: CoupledLoop | None = None

    @property
    def margins(self) -> SimultaneousMargins | None:
        """Of all its axes at once."""
        return None if self.loop is None else self.loop.margins

    def alone(self, dynamics: Transfer, delay_ticks: int, reference: ReferencePath) -> Loop:
        """The loop of this axis with other dynamics, broken alone. Raises ValueError where a part is not known."""
        if self.linear is None or self.plant is None:
            raise ValueError(f"controller: of axes {', '.join(self.axes)}: its linear part, or a model, is not known")
        plant = self.plant.with_axis_replaced(self.place, dynamics, delay_ticks)
        return CoupledLoop(self.linear, plant).axis_loop(self.place, reference)


@dataclass(frozen=True)
class AxisCheck:
    """What is known of an axis before it runs; None where there is no controller or no model.

    `delay_ticks` are those of its loop, as its model or the simulated rig has them, and `reference` is its pre-filter.
    `on_paper` is its loop as C(s), `on_model` as it will run; of an axis that shares its controller broken alone, and
    `together` knows the rest. What takes long to find out is found out when it is asked for.
    """

    name: str
    law: Controller | None = None
    linear: DiscreteController | SampledController | None = None
    controller: Transfer | None = None
    discrete: DiscreteController | None = None
    comparison: ControllerComparison | None = None
    plant: Transfer | None = None
    delay_ticks: int = 0
    reference: ReferencePath = UNFILTERED
    on_paper: Loop | None = None
    on_model: Loop | None = None
    together: Together | None = None

    @cached_property
    def continuous(self) -> LoopAnalysis | None:
        """All there is to know of the loop on paper."""
        return None if self.on_paper is None else analyse_loop(self.on_paper, loop_margins(self.on_paper), 0)

    @cached_property
    def running(self) -> LoopAnalysis | None:
        """All there is to know of the loop as it will run."""
        if self.on_model is None or self.margins is None:
            return None
        return analyse_loop(self.on_model, self.margins, self.delay_ticks)

    @cached_property
    def margins(self) -> Margins | None:
        """Of the loop as it will run."""
        return None if self.on_model is None else loop_margins(self.on_model)

    @property
    def is_known(self) -> bool:
        """Whether `loop` can say anything."""
        if self.together is not None:
            return self.together.linear is not None and self.together.plant is not None
        return self.linear is not None

    def loop(self, dynamics: Transfer, delay_ticks: int) -> Loop:
        """The loop as it runs, on such dynamics. Raises ValueError where nothing linear is known of its law."""
        if self.together is not None:
            return self.together.alone(dynamics, delay_ticks, self.reference)
        if self.linear is None:
            raise ValueError("controller: nothing linear is known of it")
        return discrete_loop(self.linear, dynamics, delay_ticks, self.reference)


def check_axes(configuration: Configuration, findings: Findings) -> list[AxisCheck]:
    """Of every axis, in their order; what is wrong with one goes to `findings`.

    In the limited process where a law is somebody's own. Raises ConfigError for what its code does wrong there.
    """
    if needs_limited_process(configuration.laws):
        checks, limited_findings = run_limited(configuration.source, _checks_and_findings, configuration)
        findings.faults += limited_findings.faults
        findings.warnings += limited_findings.warnings
        return checks
    axis_checks = list[AxisCheck]()
    for number, axis in enumerate(configuration.axes):
        if len(configuration.together(number)) == 1:
            axis_checks.append(_check(configuration, axis, findings))
        elif number == configuration.owners[number]:
            axis_checks += _check_together(configuration, number, findings)
        law = axis_checks[-1].law
        if law is not None and number == configuration.owners[number]:
            controller_axes = [configuration.axes[i].name for i in configuration.together(number)]
            with findings.at(f"axis.{axis.name}.controller: "):
                connect(law, controller_axes, list(configuration.inputs), configuration.outputs)
    return axis_checks


def _checks_and_findings(configuration: Configuration) -> tuple[list[AxisCheck], Findings]:
    """As `check_axes`, for another process."""
    findings = Findings()
    return check_axes(configuration, findings), findings


def delay_ticks(configuration: Configuration, axis: AxisOptions) -> int:
    """Samples of delay in an axis's loop: those that its model states, else those of the simulated rig."""
    return loop_delay_ticks(axis, rig_delay_ticks(configuration))


def loop_delay_ticks(axis: AxisOptions, rig_delay_ticks: int) -> int:
    """Samples of delay that the axis's model states, else `rig_delay_ticks`.

    Never their sum or larger one: a model that states its delay was identified with it, and what the rig delays
    beyond that is in the model's dynamics.
    """
    if axis.model is None or "delay_ticks" not in axis.model.model_fields_set:
        return rig_delay_ticks
    return axis.model.delay_ticks


def promised_loop(axis: AxisOptions, rate_hz: float, delay: int, plant: Transfer | None = None) -> Loop | None:
    """The loop of an axis with a controller of its own, on its model or another `plant`, with a `delay` in samples.

    None where there is none, or nothing linear is known of it.
    """
    law = controller_of(axis, 1 / rate_hz)
    if axis.model is None or law is None or law.count > 1:
        return None
    try:
        return discrete_loop(linear_part(law), plant or axis.model.transfer(), delay, axis.prefilter.path())
    except ValueError:
        return None


def _check(configuration: Configuration, axis: AxisOptions, findings: Findings) -> AxisCheck:
    """The controller, C(z)'s agreement with C(s), and the loop on the axis's model as far as the law is linear."""
    delay, period_s = delay_ticks(configuration, axis), 1.0 / configuration.loop.rate_hz
    if axis.controller is None:
        return AxisCheck(axis.name)
    key, linear = f"axis.{axis.name}.controller", None
    law = controller_of(axis, period_s)
    check = AxisCheck(axis.name, law, delay_ticks=delay, reference=axis.prefilter.path())
    if isinstance(law, TransferController):
        with findings.at(f"{key}: "):
            linear, transfer = law.discrete, law.options.transfer()
            comparison = compare_controllers(transfer, linear, up_to_hz=COMPARED_PART / period_s)
            findings.warnings += [f"{key}: {warning}" for warning in comparison.warnings]
            check = replace(check, controller=transfer, discrete=linear, comparison=comparison)
        if linear is None:
            return replace(check, law=None)
    elif law is not None:
        try:
            linear = linear_part(law)
        except ValueError as error:
            findings.warnings.append(f"{key}: stability and margins are not checked: {error}")
            return check
    if axis.model is None or linear is None:
        findings.warnings.append(f"axis.{axis.name}.model: missing; stability and margins are not checked")
        return replace(check, linear=linear)
    plant, continuous, running = axis.model.transfer(), None, None
    check = replace(check, linear=linear)
    with findings.at(f"axis.{axis.name}.model: "):
        continuous = None if check.controller is None else continuous_loop(check.controller, plant)
        running = check.loop(plant, delay)
    if running is not None:
        _require_stable(running, axis.controller, key, f"axis.{axis.name}.model", findings)
    return replace(check, plant=plant, on_paper=continuous, on_model=running)


def _require_stable(loop: Loop, options: ControllerOptions, where: str, models: str, findings: Findings) -> None:
    if loop.is_stable or loop.period_s is None:
        return
    fault = (
        f"{where}: the loop is unstable on {models} at {1 / loop.period_s:g} Hz "
        f"(largest |pole| {np.abs(loop.poles).max():.6f}, must be below 1)"
    )
    if options.allow_unstable:
        findings.warnings.append(fault)
    else:
        findings.faults.append(f"{fault}; allow_unstable = true runs it all the same")


def _check_together(configuration: Configuration, number: int, findings: Findings) -> list[AxisCheck]:
    """Of axes that share the controller of axis `number`: each one's loop broken alone, and all of them at once."""
    axes = [configuration.axes[i] for i in configuration.together(number)]
    names, options, key = tuple(axis.name for axis in axes), axes[0].controller, f"axis.{axes[0].name}.controller"
    law = controller_of(axes[0], 1.0 / configuration.loop.rate_hz, [axis.model for axis in axes])
    assert isinstance(law, CoupledController)
    assert options is not None
    delays = [delay_ticks(configuration, axis) for axis in axes]
    checks = [
        AxisCheck(
            axis.name,
            law,
            delay_ticks=delay,
            reference=axis.prefilter.path(),
            together=Together(names, place, law),
        )
        for place, (axis, delay) in enumerate(zip(axes, delays, strict=True))
    ]
    linear, plant, loop = None, _coupled_plant(axes, delays, findings), None
    try:
        linear = linear_part(law)
    except ValueError as error:
        if type(law).shipped:
            findings.faults.append(f"{key}: {error}")
            return [replace(check, law=None) for check in checks]
        findings.warnings.append(f"{key}: stability and margins are not checked: {error}")
    if linear is not None and plant is not None:
        with findings.at(f"{key}: "):
            loop = CoupledLoop(linear, plant)
    if loop is None or linear is None or plant is None:
        return checks
    axis_loops = [loop.axis_loop(place, check.reference) for place, check in enumerate(checks)]
    coupled_checks = [
        replace(
            check,
            plant=plant.dynamics[place],
            on_model=axis_loops[place],
            together=Together(names, place, law, linear, plant, loop),
        )
        for place, check in enumerate(checks)
    ]
    _require_stable(axis_loops[0], options, key, f"the models of {', '.join(names)}", findings)
    return coupled_checks


def _coupled_plant(axes: Sequence[AxisOptions], delays: Sequence[int], findings: Findings) -> CoupledPlant | None:
    """The plant of axes that have a model each, None where one has none."""
    models = [axis.model for axis in axes if axis.model is not None]
    names = [axis.name for axis in axes]
    missing = [axis.name for axis in axes if axis.model is None]
    findings.warnings += [f"axis.{name}.model: missing; stability and margins are not checked" for name in missing]
    for axis, model in zip(axes, models, strict=False):
        for other_name in model.coupling:
            if other_name not in names or other_name == axis.name:
                findings.faults.append(f"axis.{axis.name}.model.coupling.{other_name}: no other axis of its controller")
    if missing:
        return None
    return CoupledPlant(
        tuple(model.transfer() for model in models),
        tuple(delays),
        coupling_matrix(names, [model.coupling for model in models]),
    )
