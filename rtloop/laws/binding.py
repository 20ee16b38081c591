"""A law's functions as the loop calls them: compiled for its records, and their addresses.

Shipped laws whose functions are kernels come from the cache; others are compiled where they are used, with checked
indices and divisions, so that a mistake is a status and no broken process.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.hil.native.compiled import UNCOMPILED, checked, kept_address, native_address
from rtloop.hil.native.pointers import carray
from rtloop.law.layout import FUNCTIONS, told_by
from rtloop.law.memory import LawRecords
from rtloop.laws.contract import Law
from rtloop.laws.purity import MEMORY, foreign_calls
from rtloop.laws.registry import LawReference, law_class

MAX_CHARACTERS = 300
RETURNS_NOTHING = "No conversion from none to float64"
"""The compiler's words for a function that ends without a value."""


def functions_of(laws: Sequence[LawReference]) -> npt.NDArray[Any]:
    """FUNCTIONS records of these laws, compiled or loaded. Raises ValueError for one that cannot be compiled."""
    return np.concatenate([np.zeros(0, FUNCTIONS), *map(_bound, laws)])


@cache
def _bound(reference: LawReference) -> npt.NDArray[Any]:
    """One law, shape (1,): compiled and looked through once in a process, however often it is asked for."""
    law, record = law_class(reference), np.zeros(1, FUNCTIONS)
    law_records = law.records(reference.axes)
    for name in functions_in(law):
        record[name] = _address(law, law_records, name)
    return record


def signatures_of(law: type[Law], keeps: LawRecords) -> dict[str, Any]:
    """What each function that a law has takes and returns, for the compiler."""
    from numba import from_dtype, types

    input_type = from_dtype(told_by(keeps.axes)) if keeps.axes else types.float64
    returns = {
        "output": types.void if keeps.axes > 1 else types.float64,
        "update": types.void if keeps.axes else types.float64,
        "enter": types.void,
    }
    return {
        name: result(from_dtype(keeps.coefficients), from_dtype(keeps.state), input_type)
        for name, result in returns.items()
        if name in functions_in(law)
    }


def functions_in(law: type[Law]) -> list[str]:
    """Names of the functions that a law has."""
    return [name for name in ("output", "update", "enter") if getattr(law, name) is not None]


def _address(law: type[Law], keeps: LawRecords, name: str) -> int:
    function = getattr(law, name)
    if UNCOMPILED:
        return native_address(_from_addresses(function, keeps), None)
    if law.shipped:
        axes_suffix = f".{keeps.axes}" if keeps.axes > 1 else ""
        cache_name = f"{law.__module__}.{law.__qualname__}.{name}{axes_suffix}"
        return kept_address(function, cache_name, lambda: signatures_of(law, keeps)[name])
    kernel, signature = _kernel(function), signatures_of(law, keeps)[name]
    try:
        address = native_address(kernel, signature)
    except Exception as error:  # whatever the compiler comes upon
        file = function.__code__.co_filename
        location = f"law {law.kind!r}{_line(error, file)}: {name}"
        if RETURNS_NOTHING in str(error):
            raise ValueError(f"{location} returns nothing on one of its paths; each needs a `return`") from error
        raise ValueError(f"{location} cannot be compiled: {_short(error)}") from error
    for called, reason in foreign_calls(kernel, signature, law.libm).items():
        code = function.__code__
        location = f"law {law.kind!r} ({Path(code.co_filename).name}), line {code.co_firstlineno}: {name}"
        raise ValueError(f"{location} {reason if reason == MEMORY else f'calls {called}, which {reason}'}")
    return address


@cache
def _kernel(function: Callable[..., Any]) -> Any:
    """Compiled code lives as long as its kernel, which is kept for as long as somebody may call its address."""
    return checked(function)


def _short(error: Exception) -> str:
    """What the compiler says, without its advice: the lines that say what is wrong, and where."""
    from numba.core.errors import NumbaError

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
    return (f"no {operation[1]} for {operation[2]}" if operation else text)[:MAX_CHARACTERS]


def _line(error: Exception, file: str) -> str:
    """Where in the law's own file it happened, as the compiler says."""
    locations = re.findall(r'File "([^"]+)", line (\d+)', str(error))
    lines = [number for name, number in locations if Path(name).name == Path(file).name]
    return f" ({Path(file).name}), line {lines[-1]}" if lines else ""


def _from_addresses(function: Callable[..., Any], keeps: LawRecords) -> Callable[..., Any]:
    """An uncompiled function as the loop calls it."""

    def call(coefficients: int, state: int, told: Any) -> Any:
        control = carray(told, 1, told_by(keeps.axes))[0] if keeps.axes else told
        return function(carray(coefficients, 1, keeps.coefficients)[0], carray(state, 1, keeps.state)[0], control)

    return call
