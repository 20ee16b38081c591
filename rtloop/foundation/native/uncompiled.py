"""Python equivalents of the operations on addresses in kernels, for kernels that run without the compiler.

With NUMBA_DISABLE_JIT=1 every kernel is an ordinary Python function, for a debugger. Memory addresses are then real,
and the address of a function is a number assigned by `register_function`.

Within `allow_uncompiled`, kernels without stored machine code are Python functions: parking never waits for the
compiler.
"""

from __future__ import annotations

import ctypes
import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.foundation.native import word_access as words

_functions: dict[int, Callable[..., object]] = {}
_numbers = itertools.count(1)
OK, RAISED = 0, -1
raised_exceptions: list[Exception] = []
"""Exceptions raised by functions of laws, the newest last."""
_thread = threading.local()


@contextmanager
def allow_uncompiled() -> Iterator[None]:
    """Let this thread run kernels without stored machine code as Python functions: slower, with the same results."""
    previous, _thread.as_written = is_uncompiled_allowed(), True
    try:
        yield
    finally:
        _thread.as_written = previous


def is_uncompiled_allowed() -> bool:
    """Whether this thread is within `allow_uncompiled`."""
    return getattr(_thread, "as_written", False)


def register_function(function: Callable[..., object]) -> int:
    """Assign the next number, from 1, to `function` and return it: `call` and `call_law` find `function` by it."""
    number = next(_numbers)
    _functions[number] = function
    return number


class UncompiledFunction:
    """A registered function that can be called, and has an address for `call`, like a compiled C function."""

    def __init__(self, function: Callable[..., object]) -> None:
        """Register `function`, which a call runs as plain Python; `address` is its number for `call`."""
        self._function, self.address = function, register_function(function)

    def __call__(self, *arguments: int) -> object:
        """Call the function with integers, such as addresses, and return its result."""
        return self._function(*arguments)


def address_pointer(address: int) -> int:
    """Return the address itself, the pointer of uncompiled kernels."""
    return int(address)


def load_word(address: int) -> np.uint64:
    """Return the eight bytes at an address as uint64."""
    return np.uint64(ctypes.c_uint64.from_buffer_copy(ctypes.string_at(int(address), 8)).value)


def add_words(first: int, second: int) -> np.uint64:
    """Return the sum of two uint64 modulo 2⁶⁴."""
    return np.uint64((int(first) + int(second)) & 0xFFFF_FFFF_FFFF_FFFF)


def carray(pointer: int, shape: int | tuple[int, ...], dtype: npt.DTypeLike = np.float64) -> Any:
    """Return an array over the memory at address `pointer`, not a copy; the fields of its records are attributes.

    For a size of 0 it is a new array, and the address is not used.
    """
    record_type = np.dtype(dtype)
    size = int(np.prod(shape)) * record_type.itemsize
    if size == 0:
        return np.zeros(shape, record_type)
    memory: Any = (ctypes.c_char * size).from_address(int(pointer))
    array = np.frombuffer(memory, record_type).reshape(shape)
    return array.view(np.recarray) if record_type.names else array


def call(function: int, context: int, values: int) -> object:
    """Call a registered function with two addresses, like `pointers.call`; return its status."""
    return _functions[int(function)](int(context), int(values))


def call_law(function: int, result: int, raised_address: int, coefficients: int, state: int, law_input: float) -> int:
    """Call a registered function of a law, like `pointers.call_law`; return OK or RAISED.

    A result other than None is written to the float64 at `result`; an exception is appended to `raised_exceptions`, and
    `raised_address` is not used.
    """
    try:
        value = _functions[int(function)](int(coefficients), int(state), law_input)
    except Exception as error:
        raised_exceptions.append(error)
        return RAISED
    if value is not None:
        carray(result, 1, np.float64)[0] = value
    return OK


def load_acquire(array: npt.NDArray[np.uint64], index: int) -> np.uint64:
    """Return word `index` of a uint64 array, ordered as by `atomics.load_acquire`."""
    return np.uint64(words.load_acquire(array.ctypes.data + int(index) * array.itemsize))


def store_release(array: npt.NDArray[np.uint64], index: int, value: int) -> None:
    """Set word `index` of a uint64 array, ordered as by `atomics.store_release`."""
    words.store_release(array.ctypes.data + int(index) * array.itemsize, int(value))
