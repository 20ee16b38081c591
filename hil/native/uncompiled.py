"""What compiled code does with addresses, in Python: for kernels that run without the compiler, to be looked into.

With NUMBA_DISABLE_JIT=1 every kernel is an ordinary function. An address is then still one of memory, and that of a
function a number under which `address_of` has noted it.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

_functions: dict[int, Callable[..., Any]] = {}
_numbers = itertools.count(1)
OK, RAISED = 0, -1
raised: list[Exception] = []
"""What functions of laws have raised, the newest last."""


def address_of(function: Callable[..., Any]) -> int:
    """A number under which `function` can be called."""
    number = next(_numbers)
    _functions[number] = function
    return number


def address_pointer(address: int) -> int:
    """An address is its own pointer here."""
    return int(address)


def carray(pointer: int, shape: Any, dtype: Any) -> Any:
    """An array over the memory at `pointer`, its records with attributes."""
    kind = np.dtype(dtype)
    size = int(np.prod(shape)) * kind.itemsize
    if size == 0:
        return np.zeros(shape, kind)
    memory: Any = (ctypes.c_char * size).from_address(int(pointer))
    array = np.frombuffer(memory, kind).reshape(shape)
    return array.view(np.recarray) if kind.names else array


def call(function: int, context: int, values: int) -> Any:
    """As the compiled one."""
    return _functions[int(function)](int(context), int(values))


def call_law(function: int, result: int, place: int, coefficients: int, state: int, told: Any) -> int:
    """As the compiled one; what is raised is kept in `raised`."""
    try:
        value = _functions[int(function)](int(coefficients), int(state), told)
    except Exception as error:
        raised.append(error)
        return RAISED
    if value is not None:
        carray(result, 1, np.float64)[0] = value
    return OK
