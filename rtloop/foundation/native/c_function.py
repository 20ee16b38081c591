"""Compiled kernels that are called from outside other kernels: by their address, or from Python.

Each is compiled once and stored as machine code, which later processes load without the compiler. A kernel that needs
numba at run time would be compiled in each process; a test checks that there is none.
"""

from __future__ import annotations

import ctypes
import pickle
import re
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from rtloop.foundation.native import machine_code
from rtloop.foundation.native.uncompiled import allow_uncompiled, is_uncompiled_allowed

if TYPE_CHECKING:
    from _ctypes import CFuncPtr

    from numba.core.typing.templates import Signature

C_TYPES = {"int32": ctypes.c_int32, "int64": ctypes.c_int64, "uint64": ctypes.c_uint64, "intp": ctypes.c_ssize_t}
C_TYPES |= {"voidptr": ctypes.c_ssize_t, "CPointer(float64)": ctypes.c_ssize_t}
ENTRY = {"error_model": "numpy"}
FAILED = -1
"""Return value of a C function whose Python code raised; clocks and drivers treat a negative value as a failure."""


class ExportedKernel:
    """A kernel with a signature, such as "int64(intp, uint64)", and the address of its machine code."""

    def __init__(self, function: Callable[..., object], signature: str) -> None:
        """Store the kernel and its signature; it is loaded or compiled when its address is first read."""
        self.__name__, self._function, self._signature = function.__name__, function, signature
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._machine_code: int | None = None

    @property
    def address(self) -> int:
        """Address of the machine code, loaded from the cache or compiled. Raises numba's errors if that fails."""
        if self._machine_code is None:
            self._machine_code = machine_code.load(self._name) or self._compile()
        return self._machine_code

    def _compile(self) -> int:
        """Compile the kernel, store its machine code if it can be loaded without numba, and return its address.

        Each subclass defines it.
        """
        raise NotImplementedError

    @property
    def _c_types(self) -> list[type[ctypes._SimpleCData[int]]]:
        """The ctypes types of the result and of each argument, in this order."""
        return [C_TYPES[type_name] for type_name in re.findall(r"\w+\(float64\)|\w+", self._signature)]


class CFunction(ExportedKernel):
    """A kernel as a C function. An exception inside cannot be caught: numba's C function only reports it on stderr.

    Within `allow_uncompiled`, a kernel without stored machine code is a C callback to its Python function.
    """

    @property
    def address(self) -> int:
        """Address of the C function: machine code, or a callback to the Python function within `allow_uncompiled`."""
        if self._machine_code is None and is_uncompiled_allowed():
            self._machine_code = machine_code.load(self._name)
            return self._machine_code or self._python_callback[1]
        return super().address

    def __call__(self, *arguments: int) -> int:
        """Call the C function with integers and return its result."""
        return self._prototype(self.address)(*arguments)

    @cached_property
    def _prototype(self) -> type[CFuncPtr]:
        """The C function's type; a call through it keeps the interpreter's lock."""
        result, *argument_types = self._c_types
        return ctypes.PYFUNCTYPE(result, *argument_types)

    @cached_property
    def _python_callback(self) -> tuple[CFuncPtr, int]:
        """A C function that calls the Python function, and its address; an exception becomes the result FAILED."""

        def call_python(*arguments: int) -> object:
            """Run the Python function, uncompiled, for a call from C, and return its result.

            An exception is dropped, and FAILED returned.
            """
            try:
                with allow_uncompiled(), np.errstate(all="ignore"):
                    return self._function(*arguments)
            except Exception:  # nothing may propagate into C
                return FAILED

        function = self._prototype(call_python)
        return function, ctypes.cast(function, ctypes.c_void_p).value or 0

    def _compile(self) -> int:
        """Compile the C function by numba, store its machine code unless it needs numba, and return its address."""
        from rtloop.foundation.native.compiler import numba
        from rtloop.foundation.native.standalone import c_function_object_code

        self._cfunc = numba.cfunc(self._signature, error_model="numpy")(self._function)
        if code := c_function_object_code(self._cfunc, self._name):
            machine_code.store(self._name, code)
        address: Any = self._cfunc.address
        return address


class Entry(ExportedKernel):
    """A kernel that Python calls; an exception that it raises reaches the caller."""

    def __call__(self, *arguments: int) -> int:
        """Call the kernel with integers and return its result. Raises the kernel's exception."""
        result, raised = self._c_types[0](), ctypes.c_void_p()
        status = self._callable(ctypes.byref(result), ctypes.byref(raised), *arguments)
        if status:
            raise _unpickle_exception(raised.value or 0)
        return result.value

    @cached_property
    def _callable(self) -> CFuncPtr:
        """The machine code as a C function of two addresses, for result and exception, and the arguments.

        Its result is a status, 0 for success.
        """
        _, *argument_types = self._c_types
        return ctypes.PYFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, *argument_types)(self.address)

    def _compile(self) -> int:
        """Compile the kernel, which reports an exception by its status; store its machine code, return its address."""
        from rtloop.foundation.native.compiler import parse_signature

        return compile_kernel(self._function, parse_signature(self._signature), self._name, ENTRY, raises=True)


def compile_kernel(
    function: Callable[..., object],
    signature: Signature,
    name: str,
    options: dict[str, Any],
    raises: bool = False,
) -> int:
    """Compile a kernel and return its address; store its machine code under `name` unless it needs numba at run time.

    Without `raises`, the machine code of a kernel that may raise is not stored either. With it, the caller must check
    the kernel's status. Raises numba's errors for a function that cannot be compiled.
    """
    from rtloop.foundation.native.compiler import numba
    from rtloop.foundation.native.standalone import kernel_object_code

    dispatcher = numba.njit(**options)(function)
    dispatcher.compile(signature)
    overload = dispatcher.overloads[signature.args]
    if code := kernel_object_code(overload.library, overload.fndesc.llvm_func_name, name, raises):
        machine_code.store(name, code)
    _dispatchers.append(dispatcher)
    return overload.library.get_pointer_to_function(overload.fndesc.llvm_func_name)


_dispatchers: list[object] = []
"""Dispatchers of all compiled kernels: numba frees the code of a deleted dispatcher."""


class _PickledException(ctypes.Structure):
    """The first fields of numba's C record of an exception."""

    _fields_ = (("pickled", ctypes.c_void_p), ("size", ctypes.c_int32))


def _unpickle_exception(address: int) -> Exception:
    """Return the exception that numba's record at `address` describes."""
    record = _PickledException.from_address(address)
    kind, arguments, *_ = pickle.loads(ctypes.string_at(record.pickled, record.size))
    return kind(*(arguments or ()))
