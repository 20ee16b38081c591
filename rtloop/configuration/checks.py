"""Controllers of the axes and their loops on the models: built, and refused where unstable, before a run.

`check_axes` builds and refuses. Margins, step figures and the comparison of C(z) with C(s) are properties of an
AxisCheck, computed when first read: `check`, previews and warnings read them, the start of a loop does not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from rtloop.analysis.closed_loop import REFERENCE_NOT_LINEAR, Loop, continuous_loop, discrete_loop
from rtloop.analysis.comparison import ControllerComparison, compare_controllers
from rtloop.analysis.coupled_loop import CoupledLoop, CoupledPlant, SimultaneousMargins, coupling_matrix
from rtloop.analysis.loop_analysis import LoopAnalysis, analyse_loop
from rtloop.analysis.margins import Margins, loop_margins
from rtloop.analysis.reference import UNFILTERED, ReferencePath
from rtloop.configuration.axis import AxisOptions, ModelOptions
from rtloop.configuration.coefficients import make_controller
from rtloop.configuration.extras import connect
from rtloop.configuration.file import Configuration
from rtloop.configuration.rig import driver_delay_ticks
from rtloop.laws.contract import Controller, CoupledController
from rtloop.laws.limited.trial import needs_limited_process, run_limited
from rtloop.laws.linearise import NOT_LINEAR, linear_part
from rtloop.laws.options import ControllerOptions
from rtloop.laws.shipped.transfer import TransferController
from rtloop.linear.coupled_systems import SampledCoupledSystem
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.sampled import SampledController
from rtloop.linear.transfer import Transfer

COMPARED_PART = 0.2
"""C(z) is compared with C(s) up to this fraction of the rate; toward half the rate every method must differ."""


@dataclass
class Findings:
    """Faults, which refuse a configuration, and warnings, which do not; a line each."""

    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @contextmanager
    def collect_faults(self, key: str) -> Iterator[None]:
        """Append a ValueError raised in the block to the faults, as `key` and its message; continue after the block."""
        try:
            yield
        except ValueError as error:
            self.faults.append(f"{key}{error}")


@dataclass(frozen=True)
class SharedLoop:
    """Controller of several axes, from the view of axis number `place` of `axes`, and its loop on their models.

    `linear`, `plant` and `loop` are None where the law is not linear or a model is missing.
    """

    axes: tuple[str, ...]
    place: int
    law: CoupledController
    linear: SampledCoupledSystem | None = None
    plant: CoupledPlant | None = None
    loop: CoupledLoop | None = None

    @property
    def margins(self) -> SimultaneousMargins | None:
        """Margins of all axes at once; None without a loop."""
        return None if self.loop is None else self.loop.margins

    def broken_loop(self, dynamics: Transfer, delay_ticks: int, reference: ReferencePath) -> Loop:
        """Return the loop broken at axis `place`, with the plant `dynamics` behind `delay_ticks` samples in place of
        this axis's model.

        The other axes' loops stay closed. Raises ValueError where the law is not linear or a model is missing.
        """
        if self.linear is None or self.plant is None:
            fault = f"the law {NOT_LINEAR}" if self.linear is None else "an axis has no model"
            raise ValueError(
                f"controller of axes {', '.join(self.axes)}: {fault}; the analysis of a loop needs a linear controller "
                "and the models of all axes"
            )
        plant = self.plant.replace_axis(self.place, dynamics, delay_ticks)
        return CoupledLoop(self.linear, plant).axis_loop(self.place, reference)


@dataclass(frozen=True)
class AxisCheck:
    """Controller of an axis and its loop; None without a controller, a model or, for loops, a linear law.

    `linear` is the law linearised at rest. `on_model` is the loop as it will run, with `delay_ticks` of the model or
    the simulated rig and the pre-filter `reference`. Of a controller with several axes, `on_model` is broken at this
    axis alone, and `together` has the rest.
    """

    name: str
    law: Controller | None = None
    linear: DiscreteController | SampledController | None = None
    plant: Transfer | None = None
    delay_ticks: int = 0
    reference: ReferencePath = UNFILTERED
    on_model: Loop | None = None
    together: SharedLoop | None = None

    @property
    def discrete(self) -> DiscreteController | None:
        """C(z) of a law given as a transfer function; None for other laws."""
        return self.law.discrete if isinstance(self.law, TransferController) else None

    @cached_property
    def controller(self) -> Transfer | None:
        """C(s) of a law given as a transfer function; None for other laws."""
        return self.law.options.transfer() if isinstance(self.law, TransferController) else None

    @cached_property
    def comparison(self) -> ControllerComparison | None:
        """Deviation of C(z) from C(s); None for laws that are no transfer function."""
        if self.controller is None or self.discrete is None:
            return None
        return compare_controllers(self.controller, self.discrete, up_to_hz=COMPARED_PART / self.discrete.period_s)

    @cached_property
    def continuous(self) -> LoopAnalysis | None:
        """Analysis of C(s) with the model, without sampling or delay; None without C(s) or a loop."""
        if self.controller is None or self.plant is None or self.on_model is None:
            return None
        loop = continuous_loop(self.controller, self.plant)
        return analyse_loop(loop, loop_margins(loop), 0)

    @cached_property
    def running(self) -> LoopAnalysis | None:
        """Analysis of the loop as it will run; None without a loop."""
        if self.on_model is None or self.margins is None:
            return None
        return analyse_loop(self.on_model, self.margins, self.delay_ticks)

    @cached_property
    def margins(self) -> Margins | None:
        """Margins of the loop as it will run, computed also for an unstable one; None without a loop."""
        return None if self.on_model is None else loop_margins(self.on_model)

    @property
    def is_known(self) -> bool:
        """Whether the method `loop` can return a loop: the law is linear and, if axes share it, all have a model."""
        if self.together is not None:
            return self.together.linear is not None and self.together.plant is not None
        return self.linear is not None

    def loop(self, dynamics: Transfer, delay_ticks: int) -> Loop:
        """Return the sampled loop with the plant `dynamics` behind `delay_ticks` samples in place of the model's.

        Raises ValueError without a law, for a law that is not linear, and for a shared controller with an unknown
        model.
        """
        if self.together is not None:
            return self.together.broken_loop(dynamics, delay_ticks, self.reference)
        if self.linear is None:
            fault = "missing" if self.law is None else f"the law {NOT_LINEAR}"
            raise ValueError(f"controller: {fault}; the analysis of a loop needs a linear controller")
        return discrete_loop(self.linear, dynamics, delay_ticks, self.reference)


def check_axes(configuration: Configuration, findings: Findings) -> list[AxisCheck]:
    """Build each axis's controller and its loop on the model. Returns a check for each axis, in their order.

    Faults, such as unstable loops, and warnings are appended to `findings`. Each law gets the numbers of its inputs and
    outputs. With a user law, all this is done in the limited process, which is killed if a law does not return. Raises
    ConfigError for mistakes in the code of such a law, AbandonedJob if that process fails while no law runs.
    """
    if needs_limited_process(configuration.laws):
        checks, limited_findings = run_limited(configuration.source, _checks_and_findings, configuration)
        findings.faults += limited_findings.faults
        findings.warnings += limited_findings.warnings
        return checks
    axis_checks = list[AxisCheck]()
    for owner in dict.fromkeys(configuration.owners):
        axes = [configuration.axes[i] for i in configuration.axes_sharing(owner)]
        check_controller = _check_axis if len(axes) == 1 else _check_shared
        checks = check_controller(configuration, axes, findings)
        axis_checks += checks
        if (law := checks[-1].law) is not None:
            with findings.collect_faults(f"axis.{axes[0].name}.controller: "):
                connect(law, [axis.name for axis in axes], list(configuration.inputs), configuration.outputs)
    return axis_checks


def _checks_and_findings(configuration: Configuration) -> tuple[list[AxisCheck], Findings]:
    """Return what `check_axes` returns, and its findings; called in the limited process, which shares no memory."""
    findings = Findings()
    return check_axes(configuration, findings), findings


def delay_ticks(configuration: Configuration, axis: AxisOptions) -> int:
    """Return the samples of delay in an axis's loop: the model's, where it states them, else the driver's."""
    return loop_delay_ticks(axis.model, driver_delay_ticks(configuration))


def loop_delay_ticks(model: ModelOptions | None, driver_delay_ticks: int) -> int:
    """Return the samples of delay that the model states, or `driver_delay_ticks` if it states none.

    Neither their sum nor the larger one: a model that states its delay was identified with it, and its dynamics hold
    any further delay of the rig.
    """
    if model is None or "delay_ticks" not in model.model_fields_set:
        return driver_delay_ticks
    return model.delay_ticks


def _delayed_model(axis: AxisOptions, delay: int) -> ModelOptions | None:
    """Return the model of an axis with its loop's delay, `delay` samples, as `delay_ticks`; None without a model."""
    return None if axis.model is None else axis.model.model_copy(update={"delay_ticks": delay})


def promised_loop(axis: AxisOptions, rate_hz: float, delay: int, plant: Transfer | None = None) -> Loop | None:
    """Return the loop of an axis on its model, or on another `plant`, with a `delay` in samples.

    None if the axis has no model, even with `plant`; if it has no controller or one for several axes; and if its law is
    not linear.
    """
    law = make_controller(axis, 1 / rate_hz)
    if axis.model is None or law is None or law.count > 1:
        return None
    try:
        linear = linear_part(law, axis.limits.command_um)
        return discrete_loop(linear, plant or axis.model.transfer(), delay, axis.prefilter.path())
    except ValueError:
        return None


def _check_axis(configuration: Configuration, axes: Sequence[AxisOptions], findings: Findings) -> list[AxisCheck]:
    """Return the check of one axis that shares its controller with no other, and append faults and warnings to
    `findings`.

    `axes` has one entry, and the returned list too. The check has no law if there is no controller, or if this is a
    transfer function that cannot be discretised.
    """
    (axis,) = axes
    key, delay = f"axis.{axis.name}.controller", delay_ticks(configuration, axis)
    law = make_controller(axis, 1.0 / configuration.loop.rate_hz, [_delayed_model(axis, delay)])
    if law is None:
        return [AxisCheck(axis.name)]
    linear = _linear_part(law, key, axes, findings, isinstance(law, TransferController))
    if linear is None and isinstance(law, TransferController):
        return [AxisCheck(axis.name, delay_ticks=delay, reference=axis.prefilter.path())]
    check = AxisCheck(axis.name, law, linear, delay_ticks=delay, reference=axis.prefilter.path())
    if linear is None:
        return [check]
    if axis.model is None:
        _warn_of_missing_model(axis, findings)
        return [check]
    plant = axis.model.transfer()
    with findings.collect_faults(f"axis.{axis.name}.model: "):
        loop = check.loop(plant, delay)
        _report_instability(loop, law.options, key, f"axis.{axis.name}.model", findings)
        return [replace(check, plant=plant, on_model=loop)]
    return [replace(check, plant=plant)]


def _linear_part(law: Controller, key: str, axes: Sequence[AxisOptions], findings: Findings, is_required: bool) -> Any:
    """Return the law linearised at rest; None where it is not linear: a fault if `is_required`, else a warning.

    A law that is not linear for references within the limits of `axes` gives a warning, too.
    """
    try:
        linear = linear_part(law, max(axis.limits.command_um for axis in axes))
        if not isinstance(linear, DiscreteController) and linear.reference_fault:
            findings.warnings.append(f"{key}: the law is {REFERENCE_NOT_LINEAR}: {linear.reference_fault}; settling, "
                                     "overshoot, static error and peak command are not computed")  # fmt: skip
        return linear
    except ValueError as error:
        if is_required:
            findings.faults.append(f"{key}: {error}")
        else:
            findings.warnings.append(f"{key}: {error}; stability and margins are not checked")
        return None


def _warn_of_missing_model(axis: AxisOptions, findings: Findings) -> None:
    """Append the warning that this axis is not checked, because it has no model; the caller has made sure of that."""
    findings.warnings.append(f"axis.{axis.name}.model: missing; stability and margins are not checked")


def _report_instability(loop: Loop, options: ControllerOptions, key: str, models: str, findings: Findings) -> None:
    """Append to `findings` a fault, or with `allow_unstable` a warning, where a sampled loop is unstable.

    The message begins with the `key` of the controller; `models` is the text in it that names the plants.
    """
    if loop.is_stable or loop.period_s is None:
        return
    fault = (
        f"{key}: the loop is unstable on {models} at {1 / loop.period_s:g} Hz "
        f"(largest |pole| {np.abs(loop.poles).max():.6f}; allowed: below 1)"
    )
    if options.allow_unstable:
        findings.warnings.append(fault)
    else:
        findings.faults.append(f"{fault}; allow_unstable = true runs the loop anyway")


def _check_shared(configuration: Configuration, axes: Sequence[AxisOptions], findings: Findings) -> list[AxisCheck]:
    """Return a check of each of `axes`, which share the controller of the first one; append faults and warnings to
    `findings`.

    The loops are judged one axis at a time, with the other loops closed, and all axes at once. A check has no law if a
    shipped law is not linear. Raises TypeError for a law that controls one axis only.
    """
    names, key = tuple(axis.name for axis in axes), f"axis.{axes[0].name}.controller"
    delays = [delay_ticks(configuration, axis) for axis in axes]
    models = [_delayed_model(axis, delay) for axis, delay in zip(axes, delays, strict=True)]
    law = make_controller(axes[0], 1.0 / configuration.loop.rate_hz, models)
    if not isinstance(law, CoupledController):
        raise TypeError(f"{key}: {law!r} controls one axis only, but the axes here are {', '.join(names)}")
    plant, loop = _coupled_plant(axes, delays, findings), None
    linear = _linear_part(law, key, axes, findings, type(law).shipped)
    if linear is not None and plant is not None:
        with findings.collect_faults(f"{key}: "):
            loop = CoupledLoop(linear, plant)
    checks = []
    for place, (axis, delay) in enumerate(zip(axes, delays, strict=True)):
        shared = SharedLoop(names, place, law)
        if loop is not None:
            shared = replace(shared, linear=linear, plant=plant, loop=loop)
        check = AxisCheck(
            axis.name,
            law if linear is not None or not type(law).shipped else None,
            delay_ticks=delay,
            reference=axis.prefilter.path(),
            together=shared,
        )
        if loop is not None and plant is not None:
            check = replace(check, plant=plant.dynamics[place], on_model=loop.axis_loop(place, check.reference))
        checks.append(check)
    if checks[0].on_model is not None:
        _report_instability(checks[0].on_model, law.options, key, f"the models of {', '.join(names)}", findings)
    return checks


def _coupled_plant(axes: Sequence[AxisOptions], delays: Sequence[int], findings: Findings) -> CoupledPlant | None:
    """Return the plant of several axes; None where models are missing, with a warning in `findings` for each of these.

    A coupling to an axis that the controller does not have is a fault.
    """
    names = [axis.name for axis in axes]
    models = [axis.model for axis in axes if axis.model is not None]
    for axis in axes:
        if axis.model is None:
            _warn_of_missing_model(axis, findings)
            continue
        for other_name in axis.model.coupling:
            if other_name not in names or other_name == axis.name:
                allowed_names = ", ".join(name for name in names if name != axis.name)
                findings.faults.append(
                    f"axis.{axis.name}.model.coupling.{other_name}: unknown; allowed: the controller's other axes"
                    f" ({allowed_names or 'there are none'})"
                )
    if len(models) < len(axes):
        return None
    return CoupledPlant(
        tuple(model.transfer() for model in models),
        tuple(delays),
        coupling_matrix(names, [model.coupling for model in models]),
    )
