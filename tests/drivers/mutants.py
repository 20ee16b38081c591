"""Drivers that each break one promise of the contract: the conformance suite must fail on every one."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from rtloop.drivers.base import ABI_VERSION, Channel, Facts, Pointers, Wiring
from rtloop.drivers.errors import DriverError
from rtloop.foundation.options import Options
from tests.drivers.bench_driver import LoopBack

FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.POINTER(ctypes.c_double))
Values = ctypes.Array[ctypes.c_double]


class TouchesHardwareForItsFacts(LoopBack):
    """Reading `facts` moves the outputs."""

    @property
    def facts(self) -> Facts:
        self.volts = [0.0, 0.0]
        return super().facts


class ChangesItsFacts(LoopBack):
    """`facts` differ at each access."""

    looks = 0

    @property
    def facts(self) -> Facts:
        self.looks += 1
        return replace(super().facts, max_rate_hz=1000.0 + self.looks)


class RefusesTheEndOfItsRange(LoopBack):
    """`write` fails for the highest voltage of the range."""

    def write(self, volts: Sequence[float]) -> None:
        if volts[0] >= 5.0:
            raise ValueError("too much")
        super().write(volts)


class WritesOneOutputOnly(LoopBack):
    """`write` ignores the second output."""

    def write(self, volts: Sequence[float]) -> None:
        self.volts[0] = volts[0]


class Native(LoopBack):
    """A correct driver with its own C functions, without the checks of PythonDriver."""

    def open(self) -> Pointers:
        pointers = super().open()
        self._functions = FUNCTION(self.native_read), FUNCTION(self.native_write)
        read, write = (ctypes.cast(function, ctypes.c_void_p).value or 0 for function in self._functions)
        return pointers._replace(read=read, write=write)

    def native_read(self, _: int, values: Values) -> int:
        for i, value in enumerate((*self.volts, 0.0, 21.5)):
            values[i] = value
        return 0

    def native_write(self, _: int, values: Values) -> int:
        if any(map(math.isnan, values[0:2])):
            return -1
        self.volts = [self.limited(volts, c) for volts, c in zip(values[0:2], self.facts.outputs, strict=True)]
        return 0

    def limited(self, volts: float, channel: Channel) -> float:
        """Return the voltage limited to the channel's range."""
        return min(max(volts, channel.minimum_v), channel.maximum_v)


class StepsToSafeForNotANumber(Native):
    """A write with NaN moves the outputs to their safe values."""

    def native_write(self, _: int, values: Values) -> int:
        if any(map(math.isnan, values[0:2])):
            self.volts = [channel.safe_v for channel in self.facts.outputs]
            return -1
        return super().native_write(_, values)


class ReadsBeyondTheEnd(Native):
    """A read writes a value behind the end of its array."""

    def native_read(self, _: int, values: Values) -> int:
        values[4] = 1.0
        return super().native_read(_, values)


class LeavesTheAgeOut(Native):
    """A read does not set the sample's age."""

    def native_read(self, _: int, values: Values) -> int:
        values[0], values[1], values[3] = *self.volts, 21.5
        return 0


class ChangesWhatItIsGiven(Native):
    """A write changes the array of the caller."""

    def native_write(self, _: int, values: Values) -> int:
        status = super().native_write(_, values)
        values[0] = 0.0
        return status


class TakesTheHardwareWithoutOpening(LoopBack):
    """`close` before `open` succeeds, but every later `open` fails."""

    spoilt = False

    def close(self) -> None:
        self.spoilt = self.spoilt or not self._callbacks
        super().close()

    def start(self) -> None:
        if self.spoilt:
            raise DriverError("closed already")
        super().start()


class DeafAfterClose(LoopBack):
    """`read` fails after the second `open`."""

    openings = 0

    def start(self) -> None:
        self.openings += 1
        super().start()

    def read(self) -> Sequence[float]:
        if self.openings > 1:
            raise OSError("no answer")
        return super().read()


class MuteAfterClose(DeafAfterClose):
    """`write` fails after the second `open`; `close` still parks."""

    def read(self) -> Sequence[float]:
        return LoopBack.read(self)

    def write(self, volts: Sequence[float]) -> None:
        if self.openings > 1:
            raise OSError("no answer")
        super().write(volts)

    def close(self) -> None:
        if self.openings > 1:
            self._callbacks, self.volts = (), [0.0, 2.0]
        super().close()


class ClosesOnce(LoopBack):
    """A second `close` fails."""

    closed = False

    def close(self) -> None:
        if self.closed:
            raise DriverError("not open")
        super().close()
        self.closed = True


class OpensOnce(LoopBack):
    """`open` fails after the first time."""

    used = False

    def start(self) -> None:
        if self.used:
            raise DriverError("busy")
        self.used = True
        super().start()


def _changed_facts(**changes: Any) -> dict[str, Any]:
    """Return members of a class whose facts differ from LoopBack's."""
    return {"facts": property(lambda driver: replace(LoopBack.facts.fget(driver), **changes))}


def _changed_attributes(**changes: Any) -> dict[str, Any]:
    """Return members of a class whose instances have other attributes than LoopBack's."""

    def initialise(driver: LoopBack) -> None:
        LoopBack.__init__(driver)
        vars(driver).update(changes)

    return {"__init__": initialise}


def _changed_pointers(**changes: Any) -> dict[str, Any]:
    """Return members of a class whose `open` returns other pointers."""
    return {"open": lambda driver: type(driver).__base__.open(driver)._replace(**changes)}


def _assign(**attributes: Any) -> Any:
    """Return a method that sets attributes of its driver."""
    return lambda driver: vars(driver).update(attributes)


_MEMBERS: dict[str, dict[str, Any]] = {
    "CalledOtherwiseThanItsEntryPoint": {"__module__": "rtloop.drivers.sim", "__qualname__": "SimDriver"},
    "WithoutAName": {"kind": None},
    "ForgetsItsOptionsModel": _changed_attributes(options=type("CardOptions", (Options,), {})()),
    "InfiniteRange": _changed_facts(inputs=(Channel("ai0", -math.inf), Channel("ai1"))),
    "EmptyRange": _changed_facts(inputs=(Channel("ai0", 5.0, 5.0), Channel("ai1"))),
    "NoRate": _changed_facts(max_rate_hz=0.0),
    "UnsafeSafeValue": _changed_facts(outputs=(Channel("ao0"), Channel("ao1", 1.0, 5.0, safe_v=0.0))),
    "TwoChannelsOfOneName": _changed_facts(inputs=(Channel("ai0"), Channel("ai0"))),
    "WiredToNothing": _changed_attributes(wiring={"x": Wiring("ai7", "ao0")}),
    "WiredToNoOutput": _changed_attributes(wiring={"x": Wiring("ai0", "ao7")}),
    "ForgetsAnInput": {"read": lambda driver: driver.volts[:1]},
    "ReadsNaN": {"read": lambda driver: [math.nan, 0.0]},
    "ReadsBeyondItsRange": {"read": lambda driver: [0.0, 11.0]},
    "NegativeAge": {"sample_age_us": -1.0},
    "ObservesNaN": {"observe": lambda driver: (math.nan,)},
    "ObservesTooMuch": {"observe": lambda driver: (21.5, 22.5)},
    "OldAbi": _changed_pointers(abi_version=ABI_VERSION + 1),
    "NoWritePointer": _changed_pointers(write=0),
    "OpensWithOutputsAsTheyWere": {"start": _assign()},
    "MovesWhatItKnows": {"start": _assign(volts=[1.0, 1.0]), "outputs_v": lambda driver: driver.volts},
    "MovesWhatItCannotKnow": {"outputs_v": lambda driver: None},
    "TellsOfOneOutputOnly": {"outputs_v": lambda driver: driver.volts[:1]},
    "IsAtNaN": {"outputs_v": lambda driver: [math.nan, math.nan]},
    "DoesNotPark": {"close": _assign(_callbacks=())},
    "ParksWithoutBeingOpen": {"close": _assign(volts=[0.0, 2.0])},
}
"""Members of LoopBack that each mutant replaces, by the mutant's name."""


def _write_unchecked(driver: Native, values: Values) -> int:
    """Write the outputs without the check for NaN."""
    driver.volts = [driver.limited(volts, c) for volts, c in zip(values[0:2], driver.facts.outputs, strict=True)]
    return 0


_NATIVE_MEMBERS: dict[str, dict[str, Any]] = {
    "AddressesThatAreNone": _changed_pointers(context=None),
    "PassesEverythingOn": {"limited": lambda driver, volts, channel: volts},
    "WritesNotANumber": {"native_write": lambda driver, _, values: _write_unchecked(driver, values)},
}
"""Members of Native that each mutant replaces, by the mutant's name."""


def _descendants(kind: type[LoopBack]) -> list[type[LoopBack]]:
    """Return the subclasses of a class that this module defines, with their subclasses."""
    children = [child for child in kind.__subclasses__() if child.__module__ == __name__]
    return [mutant for child in children for mutant in (child, *_descendants(child))]


MUTANTS: dict[str, type[LoopBack]] = {
    **{kind.__name__: kind for kind in _descendants(LoopBack) if kind is not Native},
    **{name: type(name, (LoopBack,), members) for name, members in _MEMBERS.items()},
    **{name: type(name, (Native,), members) for name, members in _NATIVE_MEMBERS.items()},
}
