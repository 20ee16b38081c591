"""The small driver with one promise of the contract broken, in every way that the suite must see."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import replace

from drivers.base import ABI_VERSION, Channel, Facts, Pointers, Wiring
from drivers.errors import DriverError
from tests.drivers.bench_driver import LoopBack


class TouchesHardwareForItsFacts(LoopBack):
    @property
    def facts(self) -> Facts:
        self.volts = [0.0, 0.0]
        return super().facts


class UnsafeSafeValue(LoopBack):
    @property
    def facts(self) -> Facts:
        return replace(super().facts, outputs=(Channel("ao0"), Channel("ao1", 1.0, 5.0, safe_v=0.0)))


class TwoChannelsOfOneName(LoopBack):
    @property
    def facts(self) -> Facts:
        return replace(super().facts, inputs=(Channel("ai0"), Channel("ai0")))


class WiredToNothing(LoopBack):
    def __init__(self) -> None:
        super().__init__()
        self.wiring = {"x": Wiring("ai7", "ao0")}


class ForgetsAnInput(LoopBack):
    def read(self) -> Sequence[float]:
        return self.volts[:1]


class ReadsNaN(LoopBack):
    def read(self) -> Sequence[float]:
        return [math.nan, 0.0]


class ReadsBeyondItsRange(LoopBack):
    def read(self) -> Sequence[float]:
        return [0.0, 11.0]


class NegativeAge(LoopBack):
    sample_age_us = -1.0


class ObservesTooMuch(LoopBack):
    def observe(self) -> Sequence[float]:
        return 21.5, 22.5


class RefusesTheEndOfItsRange(LoopBack):
    def write(self, volts: Sequence[float]) -> None:
        if volts[0] >= 5.0:
            raise ValueError("too much")
        super().write(volts)


class WritesOneOutputOnly(LoopBack):
    def write(self, volts: Sequence[float]) -> None:
        self.volts[0] = volts[0]


class PassesEverythingOn(LoopBack):
    def admitted(self, volts: float) -> float:
        return volts

    def open(self) -> Pointers:
        pointers = super().open()

        def write(_: int, values: ctypes.Array[ctypes.c_double]) -> int:
            self.volts = [self.admitted(values[0]), self.admitted(values[1])]
            return 0

        self._own = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.POINTER(ctypes.c_double))(write)
        return pointers._replace(write=ctypes.cast(self._own, ctypes.c_void_p).value or 0)


class ClipsWhatIsNotNaN(PassesEverythingOn):
    def admitted(self, volts: float) -> float:
        return 5.0 if volts > 5.0 else 0.0 if volts < 0.0 else volts


class OldAbi(LoopBack):
    def open(self) -> Pointers:
        return super().open()._replace(abi_version=ABI_VERSION + 1)


class NoWritePointer(LoopBack):
    def open(self) -> Pointers:
        return super().open()._replace(write=0)


class OpensWithOutputsAsTheyWere(LoopBack):
    def start(self) -> None:
        """Leaves the outputs alone."""


class DoesNotPark(LoopBack):
    def close(self) -> None:
        self._callbacks = ()


class ParksWithoutBeingOpen(LoopBack):
    def close(self) -> None:
        self.volts = [0.0, 2.0]


class ClosesOnce(LoopBack):
    closed = False

    def close(self) -> None:
        if self.closed:
            raise DriverError("not open")
        super().close()
        self.closed = True


class OpensOnce(LoopBack):
    used = False

    def start(self) -> None:
        if self.used:
            raise DriverError("busy")
        self.used = True
        super().start()


MUTANTS = [*LoopBack.__subclasses__(), ClipsWhatIsNotNaN]
