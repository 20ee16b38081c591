"""A law's functions as the loop calls them: compiled for its records, with their addresses.

Shipped laws whose functions are kernels come from the cache. Others are compiled where they are used, with checked
indices and divisions, so that a mistake becomes a status and does not crash the process."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rtloop.foundation.native.compiled import UNCOMPILED, Kernel, cached_address, jit_strict, native_address
from rtloop.foundation.native.pointers import carray
from rtloop.kernel.layout import FUNCTIONS, control_dtype
from rtloop.kernel.memory import LawRecords
from rtloop.laws.contract import Law
from rtloop.laws.purity import MEMORY, foreign_calls
from rtloop.laws.registry import LawReference, law_class, plain_functions

if TYPE_CHECKING:
    from numba.core.typing.templates import Signature

MAX_CHARACTERS = 300
RETURNS_NOTHING = "No conversion from none to float64"
"""Numba's message for a function with a path without return value."""


def bind_functions(laws: Sequence[LawReference]) -> npt.NDArray[np.void]:
    """Return the FUNCTIONS records of these laws, in their order, compiled or loaded from the cache.

    The fields `output`, `update` and `enter` are addresses, 0 for an `enter` that the law lacks; the others are 0.
    Raises ValueError for a law that cannot be compiled or calls a forbidden function, and the errors of `law_class`.
    """
    return np.concatenate([np.zeros(0, FUNCTIONS), *map(_bind_law, laws)])


@cache
def _bind_law(reference: LawReference) -> npt.NDArray[np.void]:
    """Return the FUNCTIONS record of one law, shape (1,). The law is compiled and checked once in a process.

    Raises ValueError as `bind_functions` does.
    """
    law, record = law_class(reference), np.zeros(1, FUNCTIONS)
    if not (law.shipped or UNCOMPILED):
        _let_ticks_call(plain_functions(reference))
    law_records = law.records(reference.axes)
    for name in function_names(law):
        record[name] = _function_address(law, law_records, name)
    return record


def _let_ticks_call(functions: Sequence[Callable[..., object]]) -> None:
    """Let compiled functions call these Python functions, which are compiled with the checks of `jit_strict`."""
    from rtloop.foundation.native.compiler import register_jitable

    for function in functions:
        register_jitable(error_model="python", boundscheck=True)(function)


def function_signatures(law: type[Law], law_records: LawRecords) -> dict[str, Signature]:
    """Return the numba signature of each function that a law defines, by the function's name."""
    from rtloop.foundation.native.compiler import numba

    from_dtype, types = numba.from_dtype, numba.types
    input_type = from_dtype(control_dtype(law_records.axes)) if law_records.axes else types.float64
    returns = {
        "output": types.void if law_records.axes > 1 else types.float64,
        "update": types.void if law_records.axes else types.float64,
        "enter": types.void,
    }
    return {
        name: result(from_dtype(law_records.coefficients), from_dtype(law_records.state), input_type)
        for name, result in returns.items()
        if name in function_names(law)
    }


def function_names(law: type[Law]) -> list[str]:
    """Return "output", "update" and, if the law defines it, "enter"."""
    return [name for name in ("output", "update", "enter") if getattr(law, name) is not None]


def _function_address(law: type[Law], law_records: LawRecords, name: str) -> int:
    """Return the address of a law's function `name`: loaded from the cache if the law's functions are kernels, else
    compiled. With NUMBA_DISABLE_JIT it is the address of an uncompiled function, which is not checked.

    Raises ValueError if a function that is no kernel cannot be compiled or makes a forbidden call.
    """
    function = getattr(law, name)
    if UNCOMPILED:
        return native_address(_wrap_addresses(function, law_records), None)
    if law.shipped:
        axes_suffix = f".{law_records.axes}" if law_records.axes > 1 else ""
        cache_name = f"{law.__module__}.{law.__qualname__}.{name}{axes_suffix}"
        return cached_address(function, cache_name, lambda: function_signatures(law, law_records)[name])
    kernel, signature = _checked_kernel(function), function_signatures(law, law_records)[name]
    try:
        address = native_address(kernel, signature)
    except Exception as error:  # whatever the compiler comes upon
        file = function.__code__.co_filename
        location = f"law {law.kind!r}{_line_text(error, file)}: {name}"
        if RETURNS_NOTHING in str(error):
            raise ValueError(f"{location} has a path without `return`; add a `return` to each path") from error
        raise ValueError(f"{location} cannot be compiled: {_compiler_message(error)}") from error
    for called, reason in foreign_calls(kernel, signature, law.libm).items():
        code = function.__code__
        location = f"law {law.kind!r} ({Path(code.co_filename).name}), line {code.co_firstlineno}: {name}"
        raise ValueError(f"{location} {reason if reason == MEMORY else f'calls {called}, which {reason}'}")
    return address


@cache
def _checked_kernel(function: Callable[..., object]) -> Kernel:
    """Return a kernel of a law's Python function, with checked indices and divisions; it compiles at its first use.

    The cache keeps the kernel alive, because the loop calls its address.
    """
    return jit_strict(function)


def _compiler_message(error: Exception) -> str:
    """Return the lines of numba's message that name the mistake, without place and advice, at most MAX_CHARACTERS.

    A missing operation reads "no operation NAME for (TYPES)". Any other exception than numba's is returned as its type
    and text, of any length.
    """
    from rtloop.foundation.native.compiler import NumbaError

    if not isinstance(error, NumbaError):
        return f"{type(error).__name__}: {error}"
    lines = [line.strip() for line in str(error).splitlines()]
    message_lines = [
        line for line in lines if line and not line.startswith(("During:", "- Resolution", "Failed in", "[", "<<"))
    ]
    end = next(
        (i for i, line in enumerate(message_lines) if line.startswith(("File ", "There are", "def "))),
        len(message_lines),
    )
    text = " ".join(message_lines[: max(end, 1)])
    operation = re.search(r"Function\(<built-in function (\w+)>\) found for signature: >>> \w+(\(.*\))", text)
    return (f"no operation {operation[1]} for {operation[2]}" if operation else text)[:MAX_CHARACTERS]


def _line_text(error: Exception, file: str) -> str:
    """Return " (FILE), line N" for the last line of the law's own file that the compiler names; "" if it names none."""
    locations = re.findall(r'File "([^"]+)", line (\d+)', str(error))
    lines = [number for name, number in locations if Path(name).name == Path(file).name]
    return f" ({Path(file).name}), line {lines[-1]}" if lines else ""


def _wrap_addresses(function: Callable[..., float | None], law_records: LawRecords) -> Callable[..., float | None]:
    """Return an uncompiled function that takes addresses of records, as the loop passes them.

    The last argument is the address of the signals for a controller, a number for a feedforward.
    """

    def call(coefficients: int, state: int, law_input: float) -> float | None:
        """Call the law's function with the records at these addresses; return its result."""
        control = carray(law_input, 1, control_dtype(law_records.axes))[0] if law_records.axes else law_input
        return function(
            carray(coefficients, 1, law_records.coefficients)[0], carray(state, 1, law_records.state)[0], control
        )

    return call
