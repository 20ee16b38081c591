"""A small driver in Python with two outputs looped back to two inputs, whose voltages a test can read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rtloop.drivers.base import Channel, Driver, Facts, Wiring
from rtloop.drivers.contract import DriverCalls, DriverContract
from rtloop.drivers.python import PythonDriver

WIRING = {"x": Wiring("ai0", "ao0")}


@contextmanager
def open_driver(driver: Driver) -> Iterator[DriverCalls]:
    """Open a driver, yield its calls, and close it."""
    yield DriverCalls(driver.open(), driver.facts)
    driver.close()


class LoopBack(PythonDriver):
    """A driver whose hardware is the list `volts`."""

    kind = "loopback"

    def __init__(self) -> None:
        super().__init__(self.options_model(), WIRING, 1000.0)
        self.volts = [0.7, 0.7]  # Voltages left by an earlier user.

    @property
    def facts(self) -> Facts:
        outputs = Channel("ao0", -5.0, 5.0), Channel("ao1", 0.0, 10.0, safe_v=2.0)
        return Facts((Channel("ai0"), Channel("ai1")), outputs, ("x_temperature",), max_rate_hz=2000.0)

    def start(self) -> None:
        self.volts = [0.0, 2.0]

    def stop(self) -> None:
        """Do nothing: the driver holds no resource."""

    def read(self) -> Sequence[float]:
        return self.volts

    def observe(self) -> Sequence[float]:
        return (21.5,)

    def write(self, volts: Sequence[float]) -> None:
        self.volts = list(volts)


class LoopBackContract(DriverContract):
    """The drivers' contract on LoopBack, or on a subclass `kind`; the outputs are read from the driver."""

    tolerance_v = 0.0
    kind: type[LoopBack] = LoopBack

    def driver(self) -> Driver:
        return self.kind()

    def outputs(self, driver: Driver) -> Sequence[float] | None:
        assert isinstance(driver, LoopBack)
        return driver.volts
