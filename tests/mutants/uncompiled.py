"""Replacements with which the loop's kernels run without the compiler, so that a mutated loop need not be compiled.

For a law, NUMBA_DISABLE_JIT=1 suffices. The loop also needs Python functions in place of LLVM code: ordered loads and
stores (Python's are ordered), functions of the C library, and C functions that call Python functions.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable
from typing import Any

import numpy as np

_NUMBERS = 1 << 20
"""Addresses below this are numbers that `register_function` has assigned."""
_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p)


def _load_acquire(array: Any, index: int) -> Any:
    return array[index]


def _store_release(array: Any, index: int, value: int) -> None:
    array[index] = value


def _compare_exchange(array: Any, index: int, expected: int, new_value: int) -> bool:
    """Set a word if it has the expected value; return whether it had."""
    if int(array[index]) != int(expected):
        return False
    array[index] = new_value
    return True


_ORDERED = {
    "load_acquire": _load_acquire,
    "store_release": _store_release,
    "compare_exchange": _compare_exchange,
    "fence_acquire": lambda: None,
    "fence_release": lambda: None,
}


class CFunction:
    """A Python function that C code or a loop may call by its address."""

    def __init__(self, callback: Any) -> None:
        self._callback = callback
        self.address = ctypes.cast(callback, ctypes.c_void_p).value or 0

    def __call__(self, *arguments: int) -> Any:
        """Call the function with the arguments as Python integers, like C does."""
        return self._callback(*map(int, arguments))


def install() -> None:
    """Replace the compiled functions; call it before other modules of rtloop are imported, with NUMBA_DISABLE_JIT=1."""
    from rtloop.foundation.native import c_function, compiled, uncompiled

    call_registered, array, types = uncompiled.call, uncompiled.carray, c_function.C_TYPES

    def call(function: int, context: int, values: int) -> Any:
        if function < _NUMBERS:
            return call_registered(function, context, values)
        return _FUNCTION(int(function))(int(context), int(values))

    def ctypes_of_signature(signature: str) -> list[Any]:
        return [types[name] for name in re.findall(r"\w+\(float64\)|\w+", signature)]

    def make_c_function(signature: str) -> Callable[[Callable[..., Any]], CFunction]:
        return lambda function: CFunction(ctypes.PYFUNCTYPE(*ctypes_of_signature(signature))(function))

    def load_c_function(name: str, signature: str, twin: Any = None) -> Any:  # Called by Python itself.
        result_type, *argument_types = ctypes_of_signature(signature)
        function = ctypes.CDLL(None)[name]
        function.restype, function.argtypes = result_type, argument_types
        return lambda *arguments: function(*map(int, arguments))

    np.seterr(over="ignore")  # Compiled integers wrap around without a warning.
    intrinsic = compiled.intrinsic
    uncompiled.carray = lambda pointer, shape, dtype=np.float64: array(pointer, shape, dtype)  # Default: C doubles.
    uncompiled.call, compiled.c_library_function = call, load_c_function
    compiled.cfunc = compiled.python_entry = make_c_function
    compiled.intrinsic = lambda function, twin=None: _ORDERED.get(function.__name__) or intrinsic(function, twin)
