"""Contract of a law: options, two records, and functions of numbers.

The loop calls `output` before the drive is written, and `update` after it. Both receive the law's coefficients `c` and
state `s` as records with attributes, and the signals of the tick:

    controller    output(c, s, told) → command in µm
                  update(c, s, told)
                  told.reference_um, position_um, error_um: signals of the axis, with the offset of a bumpless entry;
                  in `update` also command_um, the command with its offset, and applied_um, the part that was applied
                  told.inputs, told.outputs: in V, by the indices in `self.channels`; an output that is not set in a
                  tick has its safe value

    coupled       a controller of several axes: the signals are arrays with an entry for each axis, and `output` sets
                  told.command_um[i] instead of returning a command

    feedforward   output(c, s, command_um) → drive in V
                  update(c, s, drive_v) → command in µm that corresponds to `drive_v`, the applied drive

The functions are written in the Python that numba compiles, with numbers alone: no allocation, no clock, no file.
Limits, slew, interlocks, modes and bumpless changes belong to the loop and are the same for every law.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from rtloop.kernel.layout import cache_line_record
from rtloop.kernel.memory import LawRecords, Rules
from rtloop.laws.limited.announcement import announce
from rtloop.laws.options import ControllerOptions, FeedforwardOptions, LawOptions

ANY_NUMBER = -1
"""Number of axes of a coupled controller whose class leaves it open."""
Fields = Mapping[str, type[float] | tuple[type[float], int | tuple[int, ...]]]
"""Name of each number of a record: `float` or `int`, or (type, length) for an array, (type, shape) for a matrix."""
_TYPES = {float: np.float64, int: np.int64}


class Law(ABC):
    """Law with its options, for one axis (a coupled controller: several) at one rate."""

    kind: ClassVar[str]
    """Name of the law; by default the name of its class in lower case."""
    options_model: ClassVar[type[LawOptions]] = LawOptions
    axes: ClassVar[int]
    """Number of axes: 0 for a feedforward, 1 for a controller, ANY_NUMBER if the option `axes` lists them."""
    coefficients: ClassVar[Fields | np.dtype[np.void]]
    """Names and types of the coefficients, whose values `build` returns."""
    state: ClassVar[Fields | np.dtype[np.void]] = MappingProxyType({})
    """Names and types of the state, whose values are 0 before the first tick."""
    allowed_coefficients: ClassVar[Rules] = MappingProxyType({})
    """Allowed values of the whole-number coefficients that the functions use as counts or indices."""
    allowed_state: ClassVar[Rules] = MappingProxyType({})
    shipped: ClassVar[bool] = False
    """True if the functions are already compiled kernels, whose indices are checked where data enters."""
    inputs: ClassVar[tuple[str, ...]] = ()
    outputs: ClassVar[tuple[str, ...]] = ()
    """Controllers only: names of further channels that it reads in `told.inputs` and sets in `told.outputs`, both in V;
    `self.channels` maps each name to its index there."""
    libm: ClassVar[bool] = False
    """True to allow sin, exp and similar functions, although a replay on another processor may then differ."""
    enter: Any = None
    """Optional function for a bumpless start.

    Controller: enter(c, s, told) sets a state of zeros so that `output` returns told.command_um for the same `told`. If
    the function is missing or does not achieve this, the loop adds an offset to the command, which decays.
    Feedforward: enter(c, s, drive_v) takes over at this drive; its memory describes the actuator and is retained."""

    def __init_subclass__(cls) -> None:
        """Set `kind` to the name of the class in lower case, unless the class sets it."""
        if "kind" not in vars(cls):
            cls.kind = cls.__name__.lower()

    def __init__(self, options: Any, period_s: float, model: Any) -> None:
        """Store options, period and model; number the names in `inputs` and in `outputs`, each from 0, in `channels`.

        `model` is the axis's configured plant from command to position, or None; its `delay_ticks` is the delay of the
        loop, the driver's where the model states none. For a coupled controller, a tuple with one entry for each axis.
        """
        self.options, self.period_s, self.model = options, period_s, model
        self.channels = {name: place for names in (self.inputs, self.outputs) for place, name in enumerate(names)}

    @abstractmethod
    def build(self) -> Mapping[str, object]:
        """Return a value for each coefficient, by name; arrays may be shorter than their fields, whose rest is 0.

        Raises ValueError for options without a solution.
        """

    @property
    def count(self) -> int:
        """Number of axes: 0 for a feedforward, 1 for a controller that is not coupled."""
        return self.axes

    @classmethod
    def records(cls, axes: int = 0) -> LawRecords:
        """Return the types of the law's coefficients and state, with their allowed values, for a law of `axes` axes.

        With `axes` 0 the class's own number of axes counts. Raises TypeError as `record_type` does.
        """
        return LawRecords(
            cls.kind, axes or cls.axes, record_type(cls.coefficients), record_type(cls.state), cls.allowed_coefficients,
            cls.allowed_state,
        )  # fmt: skip


class Controller(Law):
    """Law from the signals of one axis to the command of its feedforward."""

    options_model = ControllerOptions
    axes = 1

    @staticmethod
    @abstractmethod
    def output(c: Any, s: Any, told: Any) -> float:
        """Return the command in µm for this tick, from coefficients `c`, state `s` and the tick's signals `told`.

        `told.outputs` may be set, in V; `told.command_um` and `told.applied_um` have no value yet. `update` is called
        after the drive was written, and advances `s`.
        """

    @staticmethod
    @abstractmethod
    def update(c: Any, s: Any, told: Any) -> None:
        """Advance the state by one tick; `told.applied_um` is the command that corresponds to the applied drive."""

    def linear(self) -> Any:
        """Return the transfer from error to command, for margins and bumpless entry.

        It is a `rtloop.linear.sampled.SampledController`, of a coupled controller a SampledCoupledSystem. None, the
        default, makes `rtloop.laws.linearise` compute it by running the functions around rest.
        """
        return None


class CoupledController(Controller):
    """Law from the signals of several axes to the commands of their feedforwards."""

    axes = ANY_NUMBER

    @property
    def count(self) -> int:
        """Number of axes of this instance: the length of the option `axes`, unless the class states a number."""
        return len(self.options.axes) if self.axes == ANY_NUMBER else self.axes

    @staticmethod
    @abstractmethod
    def output(c: Any, s: Any, told: Any) -> None:  # type: ignore[override]
        """Set the commands told.command_um (axes,) in µm, from coefficients `c`, state `s` and the signals `told`."""


class Feedforward(Law):
    """Law from a command to a drive, with the model that converts a drive back to its command."""

    options_model = FeedforwardOptions
    axes = 0

    @staticmethod
    @abstractmethod
    def output(c: Any, s: Any, command_um: float) -> float:
        """Return the drive in V for a command in µm, from coefficients `c` and state `s`, which it may change too."""

    @staticmethod
    @abstractmethod
    def update(c: Any, s: Any, drive_v: float) -> float:
        """Advance the memory by the applied drive; return the command in µm that corresponds to it."""


def record_type(fields: Fields | np.dtype[np.void]) -> np.dtype[np.void]:
    """Return a dtype unchanged; for a dict of names and types, a record padded to whole cache lines.

    The record's fields are in the order of their number of elements, largest first.

    Raises TypeError for other arguments, and for a type other than float, int, or (type, length) or (type, shape).
    """
    if isinstance(fields, np.dtype):
        return fields
    if not isinstance(fields, Mapping):
        raise TypeError(f"{fields!r}; allowed: a dict of names and types, such as {{'sum_um': float}}")
    columns = []
    for name, description in fields.items():
        kind, *shape = description if isinstance(description, tuple) else (description,)
        if kind not in _TYPES:
            raise TypeError(f"{name} is {kind!r}; allowed: float, int, or (float, length) for an array")
        lengths = shape[0] if shape and isinstance(shape[0], tuple) else tuple(shape)
        columns.append((name, _TYPES[kind], lengths))
    return cache_line_record(sorted(columns, key=lambda field: -int(np.prod(field[2]))))


def _announce(law: Law) -> None:
    """Announce that functions of this law run next, unless they are kernels; no effect outside a limited process."""
    if not law.shipped:
        reference = getattr(law.options, "law", None)
        announce(law.kind, reference.file if reference is not None else type(law).__module__)


def build_record(law: Law) -> npt.NDArray[np.void]:
    """Return the coefficients that a law builds, shape (1,).

    A law whose functions are kernels (`shipped`) may leave names out: their values, and those behind a shorter array,
    are 0. Raises ValueError for a result that is no dict, unknown names, missing names of any other law, values that
    are not numbers, NaN (infinity is allowed), and shapes that do not fit, and the errors of `build`."""
    _announce(law)
    dtype = law.records().coefficients
    record = np.zeros(1, dtype)
    names = [name for name in dtype.names or () if name not in ("reserved", "scratch")]
    built = law.build()
    if not isinstance(built, Mapping):
        raise ValueError(f"{_build_location(law)} returns {built!r}; allowed: a dict with a value for each coefficient")
    if unknown := [name for name in built if name not in names]:
        raise ValueError(
            f"{_build_location(law)} returns the unknown coefficient {', '.join(unknown)}; allowed: {', '.join(names)}"
        )
    if not law.shipped and (missing := [name for name in names if name not in built]):
        raise ValueError(
            f"{_build_location(law)} returns no value for {', '.join(missing)}; the coefficients are {', '.join(names)}"
        )
    for name, value in built.items():
        numbers, target = np.asarray(value), record[name]
        if numbers.dtype.kind not in "biuf":
            raise ValueError(f"{_build_location(law)} returns {name} = {value!r}; allowed: numbers")
        room = target.shape[1:]
        if numbers.ndim != len(room) or any(n > limit for n, limit in zip(numbers.shape, room, strict=True)):
            needed = f"an array of up to {' × '.join(map(str, room))} numbers" if room else "one number"
            raise ValueError(
                f"{_build_location(law)} returns {name} as an array of shape {numbers.shape}; allowed: {needed}"
            )
        if np.isnan(numbers).any():
            raise ValueError(f"{_build_location(law)} returns {name} = {value!r}; allowed: numbers other than NaN")
        target[(0, *(slice(0, length) for length in numbers.shape))] = numbers
    return record


def _build_location(law: Law) -> str:
    """Return the beginning of a message about a law's `build`: "KIND: FILE, line N: build", KIND being "controller" or
    "feedforward".
    """
    code = type(law).build.__code__
    part = "feedforward" if isinstance(law, Feedforward) else "controller"
    return f"{part}: {Path(code.co_filename).name}, line {code.co_firstlineno}: build"
