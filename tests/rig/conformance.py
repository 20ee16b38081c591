"""The drivers' conformance suite on the kernel's comedi board, whose outputs are looped back to its inputs in codes."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import pytest

from rtloop.drivers.base import Driver, Wiring
from rtloop.drivers.comedi import ComediDriver, ComediOptions
from rtloop.drivers.contract import DriverContract
from rtloop.drivers.errors import DriverError

LIBRARY = ctypes.CDLL("libcomedi.so.0")
LIBRARY.comedi_open.restype = ctypes.c_void_p
INPUTS, PLUS_MINUS_10_V, GROUND = 0, 0, 0
DEVICE = "/dev/comedi0"
LSB_V = 20.0 / 65535


def make_driver(wiring: dict[str, Wiring], **options: object) -> ComediDriver:
    """Return a comedi driver at 500 Hz."""
    return ComediDriver(ComediOptions.model_validate(options), wiring, 500.0)


def looped_back_v(handle: int, channel: int) -> float:
    """Read an input channel directly by libcomedi; return its voltage."""
    code = ctypes.c_uint()
    arguments = INPUTS, channel, PLUS_MINUS_10_V, GROUND
    assert LIBRARY.comedi_data_read(ctypes.c_void_p(handle), *arguments, ctypes.byref(code)) == 1
    return -10.0 + code.value * LSB_V


class TestOneAxis(DriverContract):
    tolerance_v = LSB_V
    wiring = {"x": Wiring("ai0", "ao0")}  # noqa: RUF012

    def driver(self) -> Driver:
        return make_driver(self.wiring)

    def outputs(self, driver: Driver) -> Sequence[float] | None:
        """Read the outputs by a separate handle, or by the driver's handle while the driver has the board open."""
        assert isinstance(driver, ComediDriver)
        channels = [int(channel.name[2:]) for channel in driver.facts.outputs]
        if driver._board is not None:
            return [looped_back_v(driver._board.addresses[0], channel) for channel in channels]
        handle = LIBRARY.comedi_open(DEVICE.encode())
        try:
            return [looped_back_v(handle, channel) for channel in channels]
        finally:
            LIBRARY.comedi_close(ctypes.c_void_p(handle))


class TestThreeAxes(TestOneAxis):
    wiring = {"z": Wiring("ai5", "ao5"), "x": Wiring("ai7", "ao7"), "y": Wiring("ai0", "ao0")}  # noqa: RUF012


@pytest.mark.parametrize(
    ("wiring", "options", "message"),
    [
        ({"x": Wiring("ai0", "ao8")}, {}, r"ao8 is not a channel of this board; allowed: ao0 … ao7"),
        ({"x": Wiring("ai0", "ao0")}, {"input_range_v": [-7, 7]}, r"has no range \[-7\.0, 7\.0\] V; allowed: \[-10"),
        ({"x": Wiring("ai0", "ao0")}, {"device": "/dev/comedi9"}, "/dev/comedi9: No such file or directory"),
        ({"x": Wiring("ai0", "ao0")}, {"device": "/dev/null"}, "/dev/null: .*not a comedi device"),
    ],
)  # fmt: skip
def test_what_the_board_does_not_have(wiring, options, message):
    with pytest.raises(DriverError, match=message):
        make_driver(wiring, **options).open()


def test_a_board_in_use():
    first = make_driver(TestOneAxis.wiring)
    first.open()
    with pytest.raises(DriverError, match="/dev/comedi0: subdevice 0: another program uses this subdevice"):
        make_driver(TestOneAxis.wiring).open()
    first.close()
