"""The simulated rig keeps the contract, for one axis and for three, with converters of any range."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from rtloop.drivers.base import Driver, Wiring
from rtloop.drivers.contract import DriverCalls, DriverContract
from rtloop.drivers.sim import SimDriver
from rtloop.hil.options import RigOptions

ONE_AXIS = {"x": Wiring("adc0", "dac0")}
THREE_AXES = {"z": Wiring("adc2", "dac2"), "x": Wiring("adc0", "dac0"), "y": Wiring("adc1", "dac1")}


class TestOneAxis(DriverContract):
    def driver(self) -> Driver:
        return SimDriver(RigOptions(), ONE_AXIS, 10_000.0)

    def outputs(self, driver: Driver) -> Sequence[float] | None:
        return driver.outputs_v()


class TestThreeAxes(TestOneAxis):
    def driver(self) -> Driver:
        return SimDriver(RigOptions(latency_ticks=2, seed=9), THREE_AXES, 5_000.0)


class TestNarrowConverters(TestOneAxis):
    def driver(self) -> Driver:
        plant = {"dac": {"range_v": 5.0, "bits": 12}, "adc": {"range_v": 2.5, "min_v": 0.0}}
        return SimDriver(RigOptions.model_validate({"plants": {"y": plant}}), THREE_AXES, 10_000.0)


def test_ranges_are_the_converters():
    facts = TestNarrowConverters().driver().facts
    assert [(c.name, c.maximum_v) for c in facts.outputs] == [("dac0", 10.0), ("dac1", 5.0), ("dac2", 10.0)]
    assert [(c.name, c.minimum_v) for c in facts.inputs] == [("adc0", -10.0), ("adc1", 0.0), ("adc2", -10.0)]


def test_observed_signals_have_the_name_of_their_plant_s_axis():
    """A plant's observed signals have the name of the axis wired to the plant, in any order of the axes."""
    driver = SimDriver(RigOptions(), THREE_AXES, 10_000.0)
    calls = DriverCalls(driver.open(), driver.facts)
    for _ in range(200):
        calls.read()
        calls.write([1.0, 2.0, 3.0])
    values = calls.read()[1]
    observed = dict(zip(driver.facts.observed, values[4:], strict=True))
    assert observed["x_hysteresis_um"] < observed["y_hysteresis_um"] < observed["z_hysteresis_um"]


@pytest.mark.parametrize(
    ("wiring", "message"),
    [
        ({"x": Wiring("adc0", "dac1")}, r"channels\.x: input 'adc0' with output 'dac1'"),
        ({"x": Wiring("adc0", "dac0"), "y": Wiring("adc0", "dac0")}, r"channels\.y: axis x uses 'dac0' already"),
        ({"x": Wiring("ai0", "ao0")}, "allowed on the simulated rig: 'adc<i>' with 'dac<i>', i from 0 to 0"),
    ],
)
def test_bad_wiring_is_refused(wiring, message):
    with pytest.raises(ValueError, match=message):
        SimDriver(RigOptions(), wiring, 10_000.0)
