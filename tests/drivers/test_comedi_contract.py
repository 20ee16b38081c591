"""The comedi driver keeps the contract on a stand-in for libcomedi; `make rig` runs it on a board of the kernel."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from rtloop.drivers.base import Driver, Wiring
from rtloop.drivers.comedi import ComediDriver, ComediOptions
from rtloop.drivers.contract import DriverCalls, DriverContract
from rtloop.drivers.errors import DriverError
from tests.drivers.bench_driver import open_driver
from tests.drivers.comedi_board import hardware, new_board, output_v, stub_library
from tests.drivers.processes import completed

ONE_AXIS = {"x": Wiring("ai0", "ao0")}
CROSSED = {"y": Wiring("ai1", "ao3"), "x": Wiring("ai3", "ao1")}
LSB_V = 20.0 / 65535


def comedi(path: Path, wiring: dict[str, Wiring] = ONE_AXIS, **options: Any) -> ComediDriver:
    """Return a driver of the board in a file, on the stand-in for libcomedi."""
    values = {"device": str(path), "library": str(stub_library()), **options}
    return ComediDriver(ComediOptions.model_validate(values), wiring, 1000.0)


@pytest.fixture
def device(tmp_path: Path) -> Path:
    """Return the path of a board with its outputs at 7 V."""
    return new_board(tmp_path / "comedi0")


class TestOneAxis(DriverContract):
    tolerance_v = LSB_V
    wiring = ONE_AXIS
    options: dict[str, Any] = {}  # noqa: RUF012
    is_mute, output_range = False, 0

    @pytest.fixture(autouse=True)
    def _board(self, tmp_path: Path) -> None:
        self.device = new_board(tmp_path / "comedi0", mute=self.is_mute)
        hardware(self.device)["range"][0, 0] = self.output_range

    def driver(self) -> Driver:
        return comedi(self.device, self.wiring, **self.options)

    def outputs(self, driver: Driver) -> Sequence[float] | None:
        return [output_v(self.device, int(channel.name[2:])) for channel in driver.facts.outputs]


class TestMuteBoard(TestOneAxis):
    """A board whose outputs cannot be read back."""

    is_mute = True


class TestTwoAxesAndAnEnableInput(TestOneAxis):
    wiring = CROSSED
    options = {"more_inputs": ["ai7"], "input_subdevice": 0, "output_subdevice": 1, "aref": "diff"}  # noqa: RUF012


class TestUnipolarOutput(TestOneAxis):
    """An output whose lowest code is 0 V; the other outputs have another range and must keep their values."""

    output_range = 1
    options = {"output_range_v": [0, 5], "input_range_v": [0.0, 5.0], "safe_v": 1.0}  # noqa: RUF012

    def test_other_outputs_are_left_alone(self) -> None:
        with self.opened() as (_, calls):
            calls.write([2.0])
        assert [output_v(self.device, channel) for channel in (1, 2, 3)] == pytest.approx([7.0] * 3, abs=LSB_V)


@pytest.mark.parametrize("volts", [-10.0, -3.7, 0.0, 1e-4, 2.5, 10.0])
def test_codes_are_the_nearest_and_come_back(device, volts):
    with open_driver(comedi(device, {"x": Wiring("ai2", "ao2")})) as calls:
        assert calls.write([volts]) == 0
        assert output_v(device, 2) == pytest.approx(volts, abs=LSB_V / 2 * 1.0001)
        status, (read_v, age_us) = calls.read()
        assert (status, age_us) == (0, 0.0)
        assert read_v == pytest.approx(output_v(device, 2), abs=1e-9)


@pytest.mark.parametrize(
    ("mute", "share", "expected_v"), [(False, 0.85, 7.0), (True, 0.85, 0.0), (False, 0.0, 0.0)],
    ids=["read back", "mute", "never written"],
)  # fmt: skip
def test_an_output_stays_where_it_is_known_to_be(tmp_path, mute, share, expected_v):
    device = new_board(tmp_path / "comedi0", mute, share)
    driver = comedi(device)
    with open_driver(driver):
        assert driver.outputs_v() == pytest.approx([expected_v], abs=LSB_V)
        assert output_v(device, 0) == pytest.approx(expected_v, abs=LSB_V)


def test_channels_are_not_mixed_up(device):
    driver = comedi(device, CROSSED, more_inputs=["ai7"])
    with open_driver(driver) as calls:
        assert [channel.name for channel in driver.facts.inputs] == ["ai1", "ai3", "ai7"]
        calls.write([3.0, -4.0])  # ao3, ao1
        assert calls.read()[1] == pytest.approx([-4.0, 3.0, 0.0, 0.0], abs=LSB_V)


def test_an_uncompiled_driver_parks_its_output(device):
    program = (
        "import sys; from tests.drivers.test_comedi_contract import *\n"
        "driver = comedi(Path(sys.argv[1])); driver.open(); driver.close()"
    )
    result = completed("env", "NUMBA_DISABLE_JIT=1", sys.executable, "-c", program, device)
    assert result.returncode == 0, result.stderr
    assert output_v(device, 0) == pytest.approx(0.0, abs=LSB_V)


def test_nan_moves_no_output(device):
    with open_driver(comedi(device, CROSSED)) as calls:
        calls.write([1.0, 2.0])
        before = hardware(device)["code"].tolist()
        assert calls.write([5.0, math.nan]) < 0
        assert hardware(device)["code"].tolist() == before


def test_a_failing_board_is_a_failed_driver_that_names_the_channel(device):
    driver = comedi(device, CROSSED)
    calls = DriverCalls(driver.open(), driver.facts)
    assert driver.error is None
    hardware(device)["fail_read"] = 1
    assert calls.read()[0] < 0
    assert str(driver.error) == f"{device}: ai1: Input/output error"
    hardware(device)["fail_write"] = 1
    assert calls.write([0.0, 0.0]) < 0
    assert str(driver.error) == f"{device}: ai1, ao3: Input/output error"
    hardware(device)["fail_write"] = 1
    with pytest.raises(DriverError, match=r"the outputs could not be made safe \(.*ao3: Input/output error\)"):
        driver.close()
    driver.close()
    comedi(device).open()


FAULTS = {
    "channel": ({}, {"x": Wiring("ai0", "ao4")}, "ao4 is not a channel of this board; allowed: ao0 … ao3"),
    "range": ({"input_range_v": [-1, 1]}, ONE_AXIS,
              r"ai0 has no range \[-1.0, 1.0\] V; allowed: \[-10, 10\], \[-5, 5\]"),
    "subdevice": ({"output_subdevice": 2}, ONE_AXIS, "output_subdevice: 2 has no analogue outputs; allowed: 1"),
    "no such subdevice": ({"input_subdevice": 9}, ONE_AXIS, "input_subdevice: 9 has no analogue inputs; allowed: 0"),
}  # fmt: skip


@pytest.mark.parametrize(("options", "wiring", "message"), FAULTS.values(), ids=FAULTS)
def test_a_missing_part_of_a_board_is_named_and_the_board_released(device, options, wiring, message):
    with pytest.raises(DriverError, match=message):
        comedi(device, wiring, **options).open()
    with open_driver(comedi(device)):
        pass


@pytest.mark.parametrize(
    ("options", "wiring", "message"),
    [
        ({}, {"x": Wiring("ai0", "ao01")}, r"channels\.x\.output: 'ao01'; allowed: ao0, ao1, …"),
        ({}, {"x": Wiring("ai0", "ao0"), "y": Wiring("ai1", "ao0")}, r"channels\.y\.output: axis x uses 'ao0' already"),
        ({"more_inputs": ["enable"]}, ONE_AXIS, "more_inputs: 'enable'; allowed: ai0"),
        ({"output_range_v": [1, 5]}, ONE_AXIS, "safe_v: 0 V; allowed by output_range_v: 1 … 5 V"),
    ],
)
def test_bad_options_and_channels_are_refused_without_a_board(options, wiring, message):
    with pytest.raises(ValueError, match=message):
        ComediDriver(ComediOptions.model_validate(options), wiring, 1000.0)
