"""What compiled code does with addresses, in Python: for kernels that run as they are written, without the compiler.

With NUMBA_DISABLE_JIT=1 every kernel is an ordinary function, to be looked into. An address is then still one of
memory, and that of a function a number under which `register_function` has noted it.

Within `as_written` kernels whose machine code is not at hand are ordinary functions: parking waits for no compiler.
"""

from __future__ import annotations

import ctypes
import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from rtloop.foundation.native import word_access as words

_functions: dict[int, Callable[..., Any]] = {}
_numbers = itertools.count(1)
OK, RAISED = 0, -1
raised_exceptions: list[Exception] = []
"""What functions of laws have raised, the newest last."""


_thread = threading.local()


@contextmanager
def allow_uncompiled() -> Iterator[None]:
    """In this thread, run kernels as they are written if their machine code is not at hand: slower, the same bits."""
    previous, _thread.as_written = is_uncompiled_allowed(), True
    try:
        yield
    finally:
        _thread.as_written = previous


def is_uncompiled_allowed() -> bool:
    """Whether this thread is within `as_written`."""
    return getattr(_thread, "as_written", False)


def register_function(function: Callable[..., Any]) -> int:
    """A number under which `function` can be called."""
    number = next(_numbers)
    _functions[number] = function
    return number


def address_pointer(address: int) -> int:
    """An address is its own pointer here."""
    return int(address)


def carray(pointer: int, shape: Any, dtype: Any = np.float64) -> Any:
    """An array over the memory at `pointer`, its records with attributes."""
    record_type = np.dtype(dtype)
    size = int(np.prod(shape)) * record_type.itemsize
    if size == 0:
        return np.zeros(shape, record_type)
    memory: Any = (ctypes.c_char * size).from_address(int(pointer))
    array = np.frombuffer(memory, record_type).reshape(shape)
    return array.view(np.recarray) if record_type.names else array


def call(function: int, context: int, values: int) -> Any:
    """As the compiled one."""
    return _functions[int(function)](int(context), int(values))


def call_law(function: int, result: int, raised_address: int, coefficients: int, state: int, law_input: Any) -> int:
    """As the compiled one; what is raised is kept in `raised`."""
    try:
        value = _functions[int(function)](int(coefficients), int(state), law_input)
    except Exception as error:
        raised_exceptions.append(error)
        return RAISED
    if value is not None:
        carray(result, 1, np.float64)[0] = value
    return OK


def load_acquire(array: Any, index: int) -> Any:
    """As the compiled one."""
    return np.uint64(words.load_acquire(array.ctypes.data + int(index) * array.itemsize))


def store_release(array: Any, index: int, value: int) -> None:
    """As the compiled one."""
    words.store_release(array.ctypes.data + int(index) * array.itemsize, int(value))
