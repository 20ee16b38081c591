"""Kind `comedi`: analogue channels of any board under Linux' comedi; the compiled loop calls libcomedi's functions.

Channels are `ai<n>` and `ao<n>`. Codes and volts are converted linearly by the board's own range table; a software
calibration is not applied. libcomedi's addresses are in the context: the library need not be installed to check a
configuration, and no pointer is compiled into the cached code.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from rtloop.drivers.base import Channel, Driver, Facts, Pointers, Wiring
from rtloop.drivers.comedi_board import Board, Kind
from rtloop.drivers.errors import DriverError
from rtloop.drivers.volt_ranges import Volts, require_ranges
from rtloop.foundation.native.compiled import cfunc, intrinsic_like
from rtloop.foundation.native.pointers import SIGNATURE, address_pointer, carray
from rtloop.foundation.options import Options

if TYPE_CHECKING:
    from llvmlite.ir import IRBuilder, Value
    from numba.core.base import BaseContext
    from numba.core.types.abstract import Type
    from numba.core.typing.templates import Signature

LINE = np.dtype(
    [(name, np.uint32) for name in ("subdevice", "channel", "range", "aref")]
    + [(name, np.float64) for name in ("lowest_v", "lsb_v", "highest_code")]
)
"""A channel's address for libcomedi and its scale: volts = lowest_v + code · lsb_v."""
CONTEXT = np.dtype(
    [(name, np.int64) for name in ("board", "data_read", "data_write", "code", "inputs", "outputs")]
    + [(name, np.int64) for name in ("input_count", "output_count", "failed_input", "failed_output")]
)
"""Context of the C functions; `failed_…` is the index of the channel that failed last, −1 for none."""
FAILED = -1


class ComediOptions(Options):
    """Options of a comedi board and its channels."""

    device: str = "/dev/comedi0"
    """Path of the board's device file."""
    library: str = "libcomedi.so.0"
    """Name or path of libcomedi, which is loaded when the board is opened."""
    input_subdevice: int | None = Field(default=None, ge=0)
    """Number of a subdevice with analogue inputs; by default the first."""
    output_subdevice: int | None = Field(default=None, ge=0)
    """Number of a subdevice with analogue outputs; by default the first."""
    input_range_v: Volts = (-10.0, 10.0)
    """Range of the inputs, one of the board's own ranges, which are known when the board is opened."""
    output_range_v: Volts = (-10.0, 10.0)
    """Range of the outputs, one of the board's own ranges; the limits of the drive must lie within it."""
    aref: Literal["ground", "common", "diff", "other"] = "ground"
    """Analogue reference of the inputs."""
    more_inputs: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Inputs that belong to no axis, such as an enable switch."""
    safe_v: float = 0.0
    """Voltage at which every output is parked."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Raise ValueError for an empty or reversed range, and for `safe_v` outside `output_range_v`."""
        require_ranges(self.input_range_v, self.output_range_v, self.safe_v)
        return self


def _call_in_python(function: int, device: int, line: tuple[int, ...], final_argument: int | np.uint32) -> int:
    """Call the function at address `function` of libcomedi like `_call`, without the compiler; return its int.

    `line` is (subdevice, channel, range, aref). `final_argument` is a code to write if its type is uint32, else an
    address.
    """
    last_type = ctypes.c_uint32 if getattr(final_argument, "dtype", None) == np.uint32 else ctypes.c_ssize_t
    prototype = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_ssize_t, *[ctypes.c_uint32] * len(line), last_type)
    return prototype(int(function))(int(device), *map(int, line), int(final_argument))


@intrinsic_like(_call_in_python)
def _call(
    compiler: ModuleType, function: Type, device: Type, line: Type, final_argument: Type
) -> tuple[Signature, Callable[..., Value]]:
    """Compile a call of the C function `int function(comedi_t *, subdevice, channel, range, aref, final_argument)`.

    Kernels write _call(function, device, line, final_argument), with addresses as integers and `line` = (subdevice,
    channel, range, aref), and get the int. `final_argument` is a code (uint32) to write, or the address for a code that
    is read. Returned here are Numba's signature and the generator of the LLVM code.
    """
    types, ir = compiler.types, compiler.ir
    last_type = ir.IntType(32) if final_argument == types.uint32 else ir.IntType(64)

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]) -> Value:
        """Emit the LLVM call of the function at the address `arguments[0]`; return its int32.

        The function receives the device `arguments[1]`, the four numbers of the line `arguments[2]` and the final
        argument `arguments[3]`.
        """
        word, int32 = ir.IntType(64), ir.IntType(32)
        function_type = ir.FunctionType(int32, [word, *[int32] * 4, last_type]).as_pointer()
        numbers = [builder.extract_value(arguments[2], i) for i in range(4)]
        pointer = builder.inttoptr(arguments[0], function_type)
        return builder.call(pointer, [arguments[1], *numbers, arguments[3]])

    return types.int32(types.intp, types.intp, types.UniTuple(types.uint32, 4), final_argument), codegen


@cfunc(SIGNATURE)
def comedi_read(context, values):
    """Fill `values` with the volts of every input, converted now, and the age 0.

    Returns 0; FAILED, with the channel's index in `failed_input`, if a conversion fails.
    """
    card = carray(context, 1, CONTEXT)[0]
    lines = carray(address_pointer(card.inputs), card.input_count, LINE)
    code = carray(address_pointer(card.code), 1, np.uint32)
    out = carray(values, card.input_count + 1)
    out[card.input_count] = 0.0
    for i in range(card.input_count):
        line = lines[i]
        address = line.subdevice, line.channel, line.range, line.aref
        if _call(card.data_read, card.board, address, card.code) < 0:
            card.failed_input = i
            return FAILED
        out[i] = line.lowest_v + code[0] * line.lsb_v
    return 0


@cfunc(SIGNATURE)
def comedi_write(context, values):
    """Write the code nearest to each output's volts, clipped to the codes of the converter.

    Returns 0; FAILED before an output moves if any value is NaN; FAILED, with the channel's index in `failed_output`,
    if a write fails: the outputs before it have moved.
    """
    card = carray(context, 1, CONTEXT)[0]
    lines = carray(address_pointer(card.outputs), card.output_count, LINE)
    volts = carray(values, card.output_count)
    for i in range(card.output_count):
        if np.isnan(volts[i]):
            return FAILED
    for i in range(card.output_count):
        line = lines[i]
        code = np.rint((volts[i] - line.lowest_v) / line.lsb_v)
        code = 0.0 if code < 0.0 else (line.highest_code if code > line.highest_code else code)
        address = line.subdevice, line.channel, line.range, line.aref
        if _call(card.data_write, card.board, address, np.uint32(code)) < 0:
            card.failed_output = i
            return FAILED
    return 0


class ComediDriver(Driver):
    """The driver of a board's wired channels; its other outputs are not touched."""

    kind = "comedi"
    options_model = ComediOptions
    example: ClassVar[Wiring] = Wiring("ai0", "ao0")

    def __init__(self, options: ComediOptions, wiring: Mapping[str, Wiring], rate_hz: float) -> None:
        """Check the names of the channels of the axes and of `more_inputs`; the board is not opened.

        Raises ValueError for an input other than ai<n>, an output other than ao<n>, and an output that two axes use.
        """
        super().__init__(options, wiring, rate_hz)
        self._options = options
        self._board: Board | None = None
        self._context = np.zeros(1, CONTEXT)
        self._arrays: tuple[npt.NDArray[np.generic], ...] = ()
        self._outputs_v: list[float] | None = None
        for axis, wire in wiring.items():
            _require_name(f"channels.{axis}.input", wire.input, Kind.INPUT)
            _require_name(f"channels.{axis}.output", wire.output, Kind.OUTPUT)
            owner = next(name for name, candidate in wiring.items() if candidate.output == wire.output)
            if owner != axis:
                raise ValueError(
                    f"channels.{axis}.output: axis {owner} uses {wire.output!r} already; choose another output"
                )
        for name in options.more_inputs:
            _require_name("more_inputs", name, Kind.INPUT)
        self._inputs = tuple(dict.fromkeys([*(wire.input for wire in wiring.values()), *options.more_inputs]))
        self._outputs = tuple(wire.output for wire in wiring.values())

    @property
    def facts(self) -> Facts:
        """Facts: the channels of the axes and `more_inputs`, with the configured ranges and `safe_v`."""
        options = self._options
        return Facts(
            inputs=tuple(Channel(name, *options.input_range_v) for name in self._inputs),
            outputs=tuple(Channel(name, *options.output_range_v, options.safe_v) for name in self._outputs),
        )

    @property
    def error(self) -> Exception | None:
        """DriverError with libcomedi's message and the channels of the last failed read and the last failed write.

        None without a failure, and while the board is not open.
        """
        card = self._context[0]
        if self._board is None or max(card["failed_input"], card["failed_output"]) < 0:
            return None
        names = self._inputs, card["failed_input"], self._outputs, card["failed_output"]
        channels = ", ".join(group[i] for group, i in (names[:2], names[2:]) if i >= 0)
        return DriverError(f"{self._options.device}: {channels}: {self._board.error_text()}")

    def open(self) -> Pointers:
        """Open the board, reserve its subdevices and return the pointers; set the outputs to `safe_v` unless all can be
        read back.

        Raises DriverError, with the board released, for a missing library, board, channel or range, a subdevice in use,
        and outputs that cannot be set.
        """
        options = self._options
        board = self._board = Board(options.library, options.device)
        try:
            inputs = self._lines(board, Kind.INPUT, options.input_subdevice, self._inputs)
            outputs = self._lines(board, Kind.OUTPUT, options.output_subdevice, self._outputs)
            self._fill_context(board, inputs, outputs)
            self._outputs_v = _read_back(board, outputs)
            if self._outputs_v is None:
                self._park()
                self._outputs_v = [options.safe_v] * len(self._outputs)
        except DriverError:
            self._close_board()
            raise
        return Pointers(self._context.ctypes.data, comedi_read.address, comedi_write.address)

    def outputs_v(self) -> list[float] | None:
        """Return the volts of the outputs at the end of `open`, read back or `safe_v`; None before the first `open`."""
        return self._outputs_v

    def close(self) -> None:
        """Set all outputs to `safe_v` and release the board; without an open board do nothing.

        Raises DriverError, with the board released, if the outputs cannot be set.
        """
        if self._board is not None:
            try:
                self._park()
            finally:
                self._close_board()

    def _lines(self, board: Board, kind: Kind, subdevice: int | None, names: Iterable[str]) -> npt.NDArray[np.void]:
        """Reserve a subdevice (None: the first of its kind) and return records of LINE, one per name.

        Raises DriverError if the subdevice is in use, or the board lacks it, a channel or the range.
        """
        reserved, options = board.reserve_subdevice(kind, subdevice), self._options
        range_v, aref = (
            (options.input_range_v, options.aref) if kind is Kind.INPUT else (options.output_range_v, "ground")
        )
        return np.array([board.channel_line(kind, reserved, int(name[2:]), range_v, aref) for name in names], LINE)

    def _fill_context(self, board: Board, inputs: np.ndarray, outputs: np.ndarray) -> None:
        """Store the addresses of the board's functions and of `inputs` and `outputs`, records of LINE, in the context.

        The driver keeps the records alive for the compiled functions. The marks of failed channels are cleared.
        """
        self._arrays = inputs, outputs, np.zeros(1, np.uint32)
        context = self._context
        context["board"], context["data_read"], context["data_write"] = board.addresses
        context["inputs"], context["outputs"], context["code"] = (array.ctypes.data for array in self._arrays)
        context["input_count"], context["output_count"] = inputs.size, outputs.size
        context["failed_input"] = context["failed_output"] = -1

    def _park(self) -> None:
        """Set all outputs to `safe_v`. Raises DriverError if a write fails; the outputs before this one are set."""
        safe = np.full(len(self._outputs), self._options.safe_v)
        if comedi_write(self._context.ctypes.data, safe.ctypes.data) < 0:
            raise DriverError(
                f"driver 'comedi': the outputs could not be made safe ({self.error}) and may still carry voltage; "
                "check the amplifier"
            )

    def _close_board(self) -> None:
        """Release the board if it is open; its outputs keep their voltages."""
        if self._board is not None:
            self._board.close()
            self._board = None


def _read_back(board: Board, outputs: npt.NDArray[np.void]) -> list[float] | None:
    """Return the volts at the outputs, given as records of LINE; None if one of them cannot be read back."""
    codes = [board.output_code(tuple(line.tolist())) for line in outputs]
    if None in codes:
        return None
    return (outputs["lowest_v"] + np.array(codes, float) * outputs["lsb_v"]).tolist()


def _require_name(key: str, name: str, kind: Kind) -> None:
    """Raise ValueError, naming the option `key`, unless `name` is ai<n> (`kind` input) or ao<n> (output), n < 10000."""
    if not re.fullmatch(f"{kind.prefix}(0|[1-9][0-9]{{0,3}})", name):
        raise ValueError(f"{key}: {name!r}; allowed: {kind.prefix}0, {kind.prefix}1, …")
