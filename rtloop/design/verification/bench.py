"""A configuration on a simulated rig, run in this process and in virtual time by the same loop as on hardware.

A configured rig is used unchanged. Hardware is replaced by a rig of its models: for each axis the dynamics of its
model, the model of its hysteresis, and the sensor of its specification, and for all axes the longest delay of one of
them. Hysteresis that the model does not describe is unknown here; `residual_percent` adds as much of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, cast

from rtloop.analysis.held_plant import POINTS
from rtloop.configuration.axis import AxisOptions, ModelOptions
from rtloop.configuration.checks import delay_ticks
from rtloop.configuration.file import ChannelOptions, Configuration
from rtloop.configuration.prepare import prepare
from rtloop.configuration.reference_options import HoldOptions, StepsOptions
from rtloop.configuration.references import TableOfSamples, generator_values
from rtloop.configuration.rig import true_positions
from rtloop.drivers.sim import SimDriver
from rtloop.engine.in_process import run_in_process
from rtloop.foundation.arrays import Real
from rtloop.hil.options import (
    BoardOptions,
    DynamicsOptions,
    HysteresisOptions,
    PlantOptions,
    RigOptions,
    SensorOptions,
)
from rtloop.hysteresis.residual_hysteresis import add_residual_hysteresis
from rtloop.signals import Mode


class HardwareModel(NamedTuple):
    """Model of an axis's hardware: plant (None: unknown), white noise (µm rms), resolution and bandwidth (None: no lag)
    of its sensor, and the hysteresis h/H in percent that its inverse leaves (0 if unknown).
    """

    model: ModelOptions | None
    noise_um: float
    resolution_um: float
    bandwidth_hz: float | None
    residual_percent: float


class Bench:
    """Simulated steps of one axis while the others rest, on a rig with the options `rig`, at `rate_hz`.

    `is_configured` is True for a configured rig, False for one made of `hardware_models`, by axis. Raises ValueError if
    no rig can represent the hardware, and ConfigError for a configuration that cannot run.
    """

    def __init__(self, configuration: Configuration, hardware_models: Mapping[str, HardwareModel]) -> None:
        """Prepare the configured rig, or one of `hardware_models` by axis, without running it.

        Raises ValueError if no rig can represent the hardware, ConfigError for a configuration that cannot run.
        """
        self.is_configured = configuration.driver_kind == "sim" or isinstance(
            configuration.driver_options, BoardOptions
        )
        rig_configuration, self.rig = _place_on_rig(configuration, hardware_models, self.is_configured)
        plan = prepare(rig_configuration, paced=False).plan
        self._plan, self.rate_hz = replace(plan, mode=Mode.CLOSED_LOOP), plan.pacing.rate_hz

    def run(self, axis: str, levels_um: Sequence[float], dwell_s: float, noise_draw: int = 0) -> dict[str, Real]:
        """Simulate a run in which the reference of `axis` holds each of the levels for `dwell_s`, from rest on. Returns
        every recorded column by name, (ticks,); fewer ticks if the loop ends earlier.

        `noise_draw` is added to the seed of the rig's noise. Each run begins anew from rest.
        """
        table, generators = TableOfSamples(), self._plan.generators.copy()
        steps = StepsOptions(kind="steps", levels=tuple(levels_um), dwell_s=dwell_s, repeat=False)
        values = generator_values(steps, self.rate_hz, (), Path(), table)
        axis_index = self._plan.axes.index(axis)
        generators["kind"][axis_index] = values[0]
        generators["parameters"][axis_index, : len(values) - 1] = values[1:]
        ticks = round(dwell_s * self.rate_hz) * len(levels_um)
        plan = replace(
            self._plan,
            generators=generators,
            table=table.samples,
            ticks=ticks,
            driver_options={**self._plan.driver_options, "seed": self.rig.seed + noise_draw},
        )
        return dict(zip(plan.columns, run_in_process(plan, plan.driver(), ticks).T, strict=True))

    def true_positions(self, run: Mapping[str, Real], axis: str) -> Real:
        """Return the true positions of a run in µm at POINTS times in each period, the tick first, (ticks, POINTS)."""
        driver = cast("SimDriver", self._plan.driver())
        return true_positions(driver, driver.rig, axis, run, POINTS)


def _place_on_rig(
    configuration: Configuration, hardware_models: Mapping[str, HardwareModel], is_configured: bool
) -> tuple[Configuration, RigOptions]:
    """Return a copy of the configuration in closed loop, at rest, without schedule, on a rig, and the rig's options.

    A configured rig is used; otherwise one is made. Raises ValueError for [inputs] or [outputs] without a configured
    rig 'sim', for an axis without a model, and for a residual hysteresis that cannot be made.
    """
    loop = configuration.loop.model_copy(update={"mode": "closed_loop", "enable_input": None, "hold_input": None})
    axes = tuple(axis.model_copy(update={"reference": HoldOptions()}) for axis in configuration.axes)
    changed = replace(configuration, loop=loop, axes=axes, schedule=())
    if isinstance(configuration.driver_options, RigOptions) and configuration.driver_kind == "sim":
        return changed, configuration.driver_options
    if configuration.inputs or configuration.outputs:
        raise ValueError(
            "the rig that replaces the hardware has no channels for [inputs] and [outputs]; verify a copy of the "
            "configuration without these sections"
        )
    board = configuration.driver_options
    channels = {}
    for number, axis in enumerate(axes):
        scale = abs(configuration.channels[axis.name].um_per_v)
        channels[axis.name] = ChannelOptions(input=f"adc{number}", output=f"dac{number}", um_per_v=scale)
    if is_configured:
        rig = RigOptions(**{name: getattr(board, name) for name in RigOptions.model_fields})
    else:
        coupling = {axis.name: axis.model.coupling for axis in axes if axis.model and axis.model.coupling}
        rig = RigOptions(
            plants={
                axis.name: _plant(axis, hardware_models[axis.name], channels[axis.name].um_per_v)
                for axis in axes
                if axis.name in hardware_models
            },
            latency_ticks=max(delay_ticks(configuration, axis) for axis in axes),
            coupling=coupling,
        )
    return replace(changed, driver_kind="sim", driver_options=rig, channels=channels), rig


def _plant(axis: AxisOptions, hardware_model: HardwareModel, um_per_v: float) -> PlantOptions:
    """Return the simulated plant for an axis's hardware; its sensor has the scale `um_per_v`.

    Raises ValueError without a model, and for a residual hysteresis that `add_residual_hysteresis` cannot make.
    """
    model = hardware_model.model
    if model is None:
        raise ValueError(f"axis.{axis.name}.model: missing; the simulation of the hardware needs a model")
    plant = model.transfer()
    actuator = add_residual_hysteresis(
        axis.feedforward.actuator(), hardware_model.residual_percent, axis.limits.drive_v
    )
    return PlantOptions(
        hysteresis=HysteresisOptions(
            truth="custom",
            thresholds_v=tuple(actuator.thresholds.tolist()),
            weights_um_per_v=tuple(actuator.weights.tolist()),
        ),
        dynamics=DynamicsOptions(
            form="zpk",
            gain=plant.gain,
            zeros=tuple((root.real, root.imag) for root in plant.zeros.tolist()),
            poles=tuple((root.real, root.imag) for root in plant.poles.tolist()),
        ),
        sensor=SensorOptions(
            um_per_v=um_per_v,
            noise_um=hardware_model.noise_um,
            resolution_um=hardware_model.resolution_um,
            bandwidth_hz=hardware_model.bandwidth_hz,
        ),
    )
