"""The simulated rig that a configuration describes: the one place in configuration and commands that knows rigs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rtloop.configuration.file import Configuration
from rtloop.drivers.errors import DriverError
from rtloop.drivers.registry import driver_class
from rtloop.drivers.sim import SimDriver
from rtloop.foundation.arrays import Real
from rtloop.hil.between import RecordedMotion, fractions_of_period, positions_between_ticks
from rtloop.hil.options import DynamicsOptions, PlantOptions, RigOptions
from rtloop.hil.rig import play_parameters, zeros_poles_gain
from rtloop.hysteresis.play_model import PlayModel
from rtloop.linear.transfer import Transfer


def rig_options(configuration: Configuration) -> RigOptions | None:
    """Return the driver's options if they can describe a simulated rig, else None.

    The options of drivers for a bus, a node or a board can, even if hardware is connected: see `simulated_plant`.
    """
    options = configuration.driver_options
    return options if isinstance(options, RigOptions) else None


def driver_delay_ticks(configuration: Configuration) -> int:
    """Return the ticks of delay that the driver adds: the simulated rig's latency, or the delay in the driver's facts.

    0 for a driver that cannot be built: `prepare` reports this fault.
    """
    options = configuration.driver_options
    if configuration.driver_kind == "sim" and isinstance(options, RigOptions):
        return options.latency_ticks
    try:
        driver = driver_class(configuration.driver_kind)(options, configuration.wiring, configuration.loop.rate_hz)
    except (DriverError, ValueError):
        return 0
    return driver.facts.delay_ticks


def simulated_plant(configuration: Configuration, axis_name: str) -> PlantOptions | None:
    """Return the plant of an axis on the simulated rig.

    None for drivers whose options describe no rig, and for a bus, a node or a board whose options set neither `plant`
    nor `plants`: the plant may then be hardware.
    """
    rig = rig_options(configuration)
    if rig is None:
        return None
    is_simulated = configuration.driver_kind == "sim" or not rig.model_fields_set.isdisjoint(("plant", "plants"))
    return rig.plants.get(axis_name, rig.plant) if is_simulated else None


def true_positions(
    driver: SimDriver, rig: tuple[np.recarray, np.recarray], axis: str, columns: Mapping[str, Real], points: int
) -> Real:
    """Return the true positions of an axis in a run of the simulated rig, in µm, (ticks, points).

    A row has the position at `points` evenly spaced times of the period, the tick first. `rig` has the coefficients and
    a copy of the state before the run, which both stay unchanged; `columns` are recorded ones by name: periods_missed,
    and AXIS_hysteresis_um of all axes.
    """
    axes = sorted(driver.wiring, key=lambda name: int(driver.wiring[name].output.removeprefix("dac")))
    number = axes.index(axis)
    factors = fractions_of_period(rig[0][number], 1 / driver.rate_hz, points)
    hysteresis_um = np.stack([columns[f"{name}_hysteresis_um"] for name in axes], axis=1)
    motion = RecordedMotion(hysteresis_um, columns["periods_missed"])
    return positions_between_ticks(*rig, number, factors, motion)


def plant_dynamics(options: DynamicsOptions) -> Transfer:
    """Return D(s) of a simulated plant, with its changes of resonance, damping and gain."""
    return Transfer.from_zpk(*zeros_poles_gain(options))


def plant_plays(plant: PlantOptions) -> PlayModel:
    """Return the plays of a simulated actuator; no plays for a Bouc-Wen actuator."""
    return PlayModel(*map(np.array, play_parameters(plant.hysteresis)))
