"""The small driver with one promise of the contract broken, in every way that the suite must see."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import replace

from rtloop.drivers.base import ABI_VERSION, Channel, Facts, Pointers, Wiring
from rtloop.drivers.errors import DriverError
from rtloop.foundation.options import Options
from tests.drivers.bench_driver import LoopBack


class TouchesHardwareForItsFacts(LoopBack):
    @property
    def facts(self) -> Facts:
        self.volts = [0.0, 0.0]
        return super().facts


class ChangesItsFacts(LoopBack):
    looks = 0

    @property
    def facts(self) -> Facts:
        self.looks += 1
        return replace(super().facts, max_rate_hz=1000.0 + self.looks)


class CalledOtherwiseThanItsEntryPoint(LoopBack):
    """What is registered there is called `sim`."""

    __module__, __qualname__ = "rtloop.drivers.sim", "SimDriver"


class WithoutAName(LoopBack):
    kind = None  # type: ignore[assignment]


class ForgetsItsOptionsModel(LoopBack):
    """Its options are of a model of its own, and `options_model` is the base class's."""

    def __init__(self) -> None:
        super().__init__()
        self.options = type("CardOptions", (Options,), {})()


class InfiniteRange(LoopBack):
    @property
    def facts(self) -> Facts:
        return replace(super().facts, inputs=(Channel("ai0", -math.inf), Channel("ai1")))


class EmptyRange(LoopBack):
    @property
    def facts(self) -> Facts:
        return replace(super().facts, inputs=(Channel("ai0", 5.0, 5.0), Channel("ai1")))


class NoRate(LoopBack):
    @property
    def facts(self) -> Facts:
        return replace(super().facts, max_rate_hz=0.0)


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


class WiredToNoOutput(LoopBack):
    def __init__(self) -> None:
        super().__init__()
        self.wiring = {"x": Wiring("ai0", "ao7")}


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


class ObservesNaN(LoopBack):
    def observe(self) -> Sequence[float]:
        return (math.nan,)


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


FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.POINTER(ctypes.c_double))
Values = ctypes.Array[ctypes.c_double]


class Native(LoopBack):
    """Not broken: functions of its own, as C code would have them, without the base class's care."""

    def open(self) -> Pointers:
        pointers = super().open()
        self._own = FUNCTION(self.native_read), FUNCTION(self.native_write)
        read, write = (ctypes.cast(function, ctypes.c_void_p).value or 0 for function in self._own)
        return pointers._replace(read=read, write=write)

    def native_read(self, _: int, values: Values) -> int:
        for i, value in enumerate((*self.volts, 0.0, 21.5)):
            values[i] = value
        return 0

    def native_write(self, _: int, values: Values) -> int:
        self.volts = [self.admitted(volts, c) for volts, c in zip(values[0:2], self.facts.outputs, strict=True)]
        return 0

    def admitted(self, volts: float, channel: Channel) -> float:
        if math.isnan(volts):
            return channel.safe_v
        return min(max(volts, channel.minimum_v), channel.maximum_v)


class ReadsBeyondTheEnd(Native):
    def native_read(self, _: int, values: Values) -> int:
        values[4] = 1.0
        return super().native_read(_, values)


class LeavesTheAgeOut(Native):
    def native_read(self, _: int, values: Values) -> int:
        values[0], values[1], values[3] = *self.volts, 21.5
        return 0


class ChangesWhatItIsGiven(Native):
    def native_write(self, _: int, values: Values) -> int:
        status = super().native_write(_, values)
        values[0] = 0.0
        return status


class AddressesThatAreNone(Native):
    def open(self) -> Pointers:
        return super().open()._replace(context=None)  # type: ignore[arg-type]


class PassesEverythingOn(Native):
    def admitted(self, volts: float, channel: Channel) -> float:
        return volts


class ClipsWhatIsNotNaN(Native):
    def admitted(self, volts: float, channel: Channel) -> float:
        return volts if math.isnan(volts) else super().admitted(volts, channel)


class OldAbi(LoopBack):
    def open(self) -> Pointers:
        return super().open()._replace(abi_version=ABI_VERSION + 1)


class NoWritePointer(LoopBack):
    def open(self) -> Pointers:
        return super().open()._replace(write=0)


class OpensWithOutputsAsTheyWere(LoopBack):
    def start(self) -> None:
        """Leaves the outputs alone."""


class MovesWhatItKnows(LoopBack):
    def start(self) -> None:
        self.volts = [1.0, 1.0]

    def outputs_v(self) -> Sequence[float]:
        return self.volts


class MovesWhatItCannotKnow(LoopBack):
    def outputs_v(self) -> None:
        return None


class TellsOfOneOutputOnly(LoopBack):
    def outputs_v(self) -> Sequence[float]:
        return self.volts[:1]


class IsAtNaN(LoopBack):
    def outputs_v(self) -> Sequence[float]:
        return [math.nan, math.nan]


class DoesNotPark(LoopBack):
    def close(self) -> None:
        self._callbacks = ()


class ParksWithoutBeingOpen(LoopBack):
    def close(self) -> None:
        self.volts = [0.0, 2.0]


class TakesTheHardwareWithoutOpening(LoopBack):
    """`close` before `open` does no harm, and yet nothing can be opened afterwards."""

    spoilt = False

    def close(self) -> None:
        self.spoilt = self.spoilt or not self._callbacks
        super().close()

    def start(self) -> None:
        if self.spoilt:
            raise DriverError("closed already")
        super().start()


class DeafAfterClose(LoopBack):
    """Its second life reads nothing."""

    lives = 0

    def start(self) -> None:
        self.lives += 1
        super().start()

    def read(self) -> Sequence[float]:
        if self.lives > 1:
            raise OSError("no answer")
        return super().read()


class MuteAfterClose(DeafAfterClose):
    """Its second life writes nothing, but parks."""

    def read(self) -> Sequence[float]:
        return LoopBack.read(self)

    def write(self, volts: Sequence[float]) -> None:
        if self.lives > 1:
            raise OSError("no answer")
        super().write(volts)

    def close(self) -> None:
        if self.lives > 1:
            self._callbacks, self.volts = (), [0.0, 2.0]
        super().close()


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


def _descendants(kind: type[LoopBack]) -> list[type[LoopBack]]:
    return [found for child in kind.__subclasses__() for found in (child, *_descendants(child))]


MUTANTS = [kind for kind in _descendants(LoopBack) if kind is not Native]
