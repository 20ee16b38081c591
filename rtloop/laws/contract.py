"""The contract of a law: options, two records, and functions of numbers.

To the loop a law is `output`, called before the drive is written, and `update`, called behind it. Both get the law's
coefficients `c` and state `s` as records with attributes, and what else they may know of this tick:

    controller    output(c, s, told) → command in µm
                  update(c, s, told)
                  told.reference_um, position_um, error_um: as the controller meets them; in `update` also
                  command_um, what went out as its command, and applied_um, what of it was really applied
                  told.inputs, told.outputs: in V, by the places that `self.channels` says; an output that is not set
                  in a tick is at its safe value

    coupled       as a controller, but for several axes at once: what it is told are arrays with an entry an axis, and
                  its output sets told.command_um[i] instead of returning a command

    feedforward   output(c, s, command_um) → drive in V
                  update(c, s, drive_v) → command in µm that this drive was, `drive_v` being what was really applied

They are written in the Python that numba compiles, with numbers alone: no allocation, no clock, no file. Limits, slew,
interlocks, modes and bumpless changes belong to the loop and are the same for every law.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from rtloop.law.layout import cache_line_record
from rtloop.law.memory import LawRecords, Rules
from rtloop.laws.limited.announced import announce
from rtloop.laws.options import ControllerOptions, FeedforwardOptions, LawOptions

ANY_NUMBER = -1
"""Of axes, for a coupled controller whose class does not say how many it is for."""
Fields = Mapping[str, Any]
"""Name of each number of a record: `float` or `int`, or (type, length) for an array, (type, shape) for a matrix."""
_TYPES = {float: np.float64, int: np.int64}


class Law(ABC):
    """One law, with its options, on one axis at one rate."""

    kind: ClassVar[str]
    """Its name; that of its class in lower case unless it says otherwise."""
    options_model: ClassVar[type[LawOptions]] = LawOptions
    axes: ClassVar[int]
    coefficients: ClassVar[Fields | np.dtype[Any]]
    state: ClassVar[Fields | np.dtype[Any]] = MappingProxyType({})
    allowed_coefficients: ClassVar[Rules] = MappingProxyType({})
    """What whole numbers that the functions use as counts or indices may be."""
    allowed_state: ClassVar[Rules] = MappingProxyType({})
    shipped: ClassVar[bool] = False
    """True where the functions are compiled kernels already, whose indices are checked where data enters."""
    inputs: ClassVar[tuple[str, ...]] = ()
    outputs: ClassVar[tuple[str, ...]] = ()
    """Of a controller, the names of channels beside sensor and drive that it reads in told.inputs, and sets in
    told.outputs, both in V; `self.channels` has their places there."""
    libm: ClassVar[bool] = False
    """True where sin, exp and the like are wanted, although a replay on another processor may then differ."""
    enter: Any = None
    """Of a controller, enter(c, s, told): from a state of zeros, that from which `output` gives told.command_um for
    what it is told. Where it is missing, or does not manage, the loop adds an offset to the command, which dies out.
    Of a feedforward, enter(c, s, drive_v): it takes over at this drive; its memory is of the actuator, and stays."""

    def __init_subclass__(cls) -> None:
        if "kind" not in vars(cls):
            cls.kind = cls.__name__.lower()

    def __init__(self, options: Any, period_s: float, model: Any) -> None:
        """`model` is the plant from command to position that the axis was given (`configuration`'s), or None; of a
        coupled controller, a tuple with one for each of its axes."""
        self.options, self.period_s, self.model = options, period_s, model
        self.channels = {name: place for names in (self.inputs, self.outputs) for place, name in enumerate(names)}

    @abstractmethod
    def build(self) -> Mapping[str, Any]:
        """A value for each coefficient; arrays may be shorter than their fields. Raises ValueError."""

    @property
    def count(self) -> int:
        """Of the axes that it has; 0 for a feedforward."""
        return self.axes

    @classmethod
    def records(cls, axes: int = 0) -> LawRecords:
        """What it keeps, as types; `axes` where its class does not say how many."""
        return LawRecords(
            cls.kind, axes or cls.axes, record_type(cls.coefficients), record_type(cls.state), cls.allowed_coefficients,
            cls.allowed_state,
        )  # fmt: skip


class Controller(Law):
    """From what one axis does to the command of its feedforward."""

    options_model = ControllerOptions
    axes = 1

    @staticmethod
    @abstractmethod
    def output(c: Any, s: Any, told: Any) -> float:
        """Command in µm."""

    @staticmethod
    @abstractmethod
    def update(c: Any, s: Any, told: Any) -> None:
        """Advance the state by a tick."""

    def linear(self) -> Any:
        """From error to command, as a `rtloop.linear.sampled.Sampled`, for margins and for entering without a bump.

        None has it found by running the functions about rest (`rtloop.laws.linearise`).
        """
        return None


class CoupledController(Controller):
    """From what several axes do to the commands of their feedforwards."""

    axes = ANY_NUMBER

    @property
    def count(self) -> int:
        """Of its axes, here."""
        return len(self.options.axes) if self.axes == ANY_NUMBER else self.axes

    @staticmethod
    @abstractmethod
    def output(c: Any, s: Any, told: Any) -> None:  # type: ignore[override]
        """Set the commands, told.command_um (axes,) in µm."""


class Feedforward(Law):
    """From a command to a drive, with the model that says what a drive was as a command."""

    options_model = FeedforwardOptions
    axes = 0

    @staticmethod
    @abstractmethod
    def output(c: Any, s: Any, command_um: float) -> float:
        """Drive in V."""

    @staticmethod
    @abstractmethod
    def update(c: Any, s: Any, drive_v: float) -> float:
        """Advance the memory by the drive that was applied; the command in µm that it was."""


def record_type(fields: Fields | np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of a record that fills whole cache lines. Raises TypeError for a type that is not allowed."""
    if isinstance(fields, np.dtype):
        return fields
    if not isinstance(fields, Mapping):
        raise TypeError(f"{fields!r}; a dict of names and types is needed, such as {{'sum_um': float}}")
    found = []
    for name, what in fields.items():
        kind, *shape = what if isinstance(what, tuple) else (what,)
        if kind not in _TYPES:
            raise TypeError(f"{name} is {kind!r}; allowed: float, int, or (float, length) for an array")
        lengths = shape[0] if shape and isinstance(shape[0], tuple) else tuple(shape)
        found.append((name, _TYPES[kind], lengths))
    return cache_line_record(sorted(found, key=lambda field: -int(np.prod(field[2]))))


def _announce(law: Law) -> None:
    """Say that functions of a law are called next, where it is of somebody's own."""
    if not law.shipped:
        reference = getattr(law.options, "law", None)
        announce(law.kind, reference.file if reference is not None else type(law).__module__)


def build_record(law: Law) -> Any:
    """The coefficients that a law builds, shape (1,). Raises ValueError for a name or a shape that does not fit."""
    _announce(law)
    dtype = law.records().coefficients
    record = np.zeros(1, dtype)
    names = [name for name in dtype.names or () if name not in ("reserved", "scratch")]
    built = law.build()
    if not isinstance(built, Mapping):
        raise ValueError(
            f"{_build_location(law)} returns {built!r}; a dict with a value for each coefficient is needed"
        )
    if unknown := [name for name in built if name not in names]:
        raise ValueError(f"{_build_location(law)} gives {', '.join(unknown)}; the coefficients are {', '.join(names)}")
    if not law.shipped and (missing := [name for name in names if name not in built]):
        raise ValueError(
            f"{_build_location(law)} gives no {', '.join(missing)}; the coefficients are {', '.join(names)}"
        )
    for name, value in built.items():
        numbers, target = np.asarray(value), record[name]
        if numbers.dtype.kind not in "biuf":
            raise ValueError(f"{_build_location(law)} gives {name} = {value!r}, which is no number")
        room = target.shape[1:]
        if numbers.ndim != len(room) or any(n > limit for n, limit in zip(numbers.shape, room, strict=True)):
            needed = f"an array of at most {room}" if room else "one number"
            raise ValueError(f"{_build_location(law)} gives {name} as an array of {numbers.shape}; {needed} is needed")
        if np.isnan(numbers).any():
            raise ValueError(f"{_build_location(law)} gives {name} = {value!r}; NaN is not allowed")
        target[(0, *(slice(0, length) for length in numbers.shape))] = numbers
    return record


def _build_location(law: Law) -> str:
    """Return file, line and name of a law's `build`, for a message."""
    code = type(law).build.__code__
    part = "feedforward" if isinstance(law, Feedforward) else "controller"
    return f"{part}: {Path(code.co_filename).name}, line {code.co_firstlineno}: build"
