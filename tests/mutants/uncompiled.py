"""What kernels need besides NUMBA_DISABLE_JIT=1 to run without the compiler, so that no mutated loop is compiled first.

The law needs nothing more. The loop needs what is LLVM code otherwise: ordered loads and stores, which Python's are,
functions of the C library, and C functions of Python ones.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable
from typing import Any

import numpy as np

_NUMBERS = 1 << 20
"""Addresses below are numbers that `register_function` has given."""
_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p)


def _load_acquire(array: Any, index: int) -> Any:
    return array[index]


def _store_release(array: Any, index: int, value: int) -> None:
    array[index] = value


def _exchanged(array: Any, index: int, expected: int, wanted: int) -> bool:
    if int(array[index]) != int(expected):
        return False
    array[index] = wanted
    return True


_ORDERED = {
    "load_acquire": _load_acquire,
    "store_release": _store_release,
    "exchanged": _exchanged,
    "fence_acquire": lambda: None,
    "fence_release": lambda: None,
}


class CFunction:
    """A Python function that C, and a loop, may call by its address."""

    def __init__(self, callback: Any) -> None:
        self._callback = callback
        self.address = ctypes.cast(callback, ctypes.c_void_p).value or 0

    def __call__(self, *arguments: int) -> Any:
        """Run it; numbers of any integer type become what C passes."""
        return self._callback(*map(int, arguments))


def install() -> None:
    """Before anything else of rtloop is imported, in a process with NUMBA_DISABLE_JIT=1."""
    from rtloop.foundation.native import c_function, compiled, uncompiled

    numbered, array, types = uncompiled.call, uncompiled.carray, c_function.C_TYPES

    def call(function: int, context: int, values: int) -> Any:
        if function < _NUMBERS:
            return numbered(function, context, values)
        return _FUNCTION(int(function))(int(context), int(values))

    def typed(signature: str) -> list[Any]:
        return [types[name] for name in re.findall(r"\w+\(float64\)|\w+", signature)]

    def c_function_of(signature: str) -> Callable[[Callable[..., Any]], CFunction]:
        return lambda function: CFunction(ctypes.PYFUNCTYPE(*typed(signature))(function))

    def external(name: str, signature: str, written: Any = None) -> Any:  # the C library itself is at hand here
        result, *given = typed(signature)
        function = ctypes.CDLL(None)[name]
        function.restype, function.argtypes = result, given
        return lambda *arguments: function(*map(int, arguments))

    np.seterr(over="ignore")  # compiled integers wrap around without a warning
    intrinsic = compiled.intrinsic
    uncompiled.carray = lambda pointer, shape, dtype=np.float64: array(pointer, shape, dtype)  # of C doubles, if unsaid
    uncompiled.call, compiled.c_library_function = call, external
    compiled.cfunc = compiled.python_entry = c_function_of
    compiled.intrinsic = lambda function, written=None: _ORDERED.get(function.__name__) or intrinsic(function, written)
