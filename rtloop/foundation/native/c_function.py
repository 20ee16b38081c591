"""Compiled kernels that are reached from outside of other kernels: by their address, or by a call from Python.

They are compiled once, and from then on loaded without the compiler. One that cannot do without numba's own help would
be compiled in each process; there is none here, and a test sees to that.
"""

from __future__ import annotations

import ctypes
import pickle
import re
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from rtloop.foundation.native import machine_code
from rtloop.foundation.native.uncompiled import allow_uncompiled, is_uncompiled_allowed

C_TYPES = {"int32": ctypes.c_int32, "int64": ctypes.c_int64, "uint64": ctypes.c_uint64, "intp": ctypes.c_ssize_t}
C_TYPES |= {"voidptr": ctypes.c_ssize_t, "CPointer(float64)": ctypes.c_ssize_t}
ENTRY = {"error_model": "numpy"}
FAILED = -1
"""What a C function returns that raised in Python: to clocks and drivers a failure."""


class ExportedKernel:
    """A kernel and its signature, such as "int64(intp, uint64)"; addresses are integers to Python."""

    def __init__(self, function: Callable[..., Any], signature: str) -> None:
        self.__name__, self._function, self._signature = function.__name__, function, signature
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._machine_code: int | None = None

    @property
    def address(self) -> int:
        """Where its machine code is, which is compiled if need be."""
        if self._machine_code is None:
            self._machine_code = machine_code.load(self._name) or self._compile()
        return self._machine_code

    def _compile(self) -> int:
        raise NotImplementedError

    @property
    def _c_types(self) -> list[Any]:
        """Of its result, and of what it is given."""
        return [C_TYPES[type_name] for type_name in re.findall(r"\w+\(float64\)|\w+", self._signature)]


class CFunction(ExportedKernel):
    """A kernel as a C function. It raises nothing, or numba's own C function says so where nobody can catch it.

    Within `as_written`, where there is no machine code, it is the kernel as it is written, called back.
    """

    @property
    def address(self) -> int:
        """Where a C function is: machine code, compiled if need be, or the kernel as it is written."""
        if self._machine_code is None and is_uncompiled_allowed():
            self._machine_code = machine_code.load(self._name)
            return self._machine_code or self._python_callback[1]
        return super().address

    def __call__(self, *arguments: int) -> Any:
        """Run it."""
        return self._prototype(self.address)(*arguments)

    @cached_property
    def _prototype(self) -> Any:
        """With the interpreter waiting, as for every kernel."""
        result, *argument_types = self._c_types
        return ctypes.PYFUNCTYPE(result, *argument_types)

    @cached_property
    def _python_callback(self) -> tuple[Any, int]:
        """The kernel as it is written, as a C function, and its address. What it raises is returned as FAILED."""

        def run(*arguments: int) -> Any:
            try:
                with allow_uncompiled(), np.errstate(all="ignore"):
                    return self._function(*arguments)
            except Exception:  # nothing may propagate into C
                return FAILED

        function = self._prototype(run)
        return function, ctypes.cast(function, ctypes.c_void_p).value or 0

    def _compile(self) -> int:
        from rtloop.foundation.native.compiler import numba
        from rtloop.foundation.native.standalone import c_function_object_code

        self._cfunc = numba.cfunc(self._signature, error_model="numpy")(self._function)
        if code := c_function_object_code(self._cfunc, self._name):
            machine_code.store(self._name, code)
        address: Any = self._cfunc.address
        return address


class Entry(ExportedKernel):
    """A kernel that Python calls. What is raised within it is raised."""

    def __call__(self, *arguments: int) -> Any:
        """Run it."""
        result, raised = self._c_types[0](), ctypes.c_void_p()
        status = self._callable(ctypes.byref(result), ctypes.byref(raised), *arguments)
        if status:
            raise _exception_at(raised.value or 0)
        return result.value

    @cached_property
    def _callable(self) -> Any:
        """As compiled functions call each other: places for result and exception, and a status."""
        _, *argument_types = self._c_types
        return ctypes.PYFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, *argument_types)(self.address)

    def _compile(self) -> int:
        from rtloop.foundation.native.compiler import signature_of

        return compile_kernel(self._function, signature_of(self._signature), self._name, ENTRY, raises=True)


def compile_kernel(
    function: Callable[..., Any], signature: Any, name: str, options: dict[str, Any], raises: bool = False
) -> int:
    """Compile a kernel, and keep it under `name` for `machine_code` to load.

    Whoever calls one that `raises` looks at its status.
    """
    from rtloop.foundation.native.compiler import numba
    from rtloop.foundation.native.standalone import kernel_object_code

    dispatcher: Any = numba.njit(**options)(function)
    dispatcher.compile(signature)
    overload = dispatcher.overloads[signature.args]
    if code := kernel_object_code(overload.library, overload.fndesc.llvm_func_name, name, raises):
        machine_code.store(name, code)
    _dispatchers.append(dispatcher)
    return overload.library.get_pointer_to_function(overload.fndesc.llvm_func_name)


_dispatchers: list[Any] = []
"""Compiled code lives as long as its dispatcher."""


class _PickledException(ctypes.Structure):
    """The begin of numba's description of an exception."""

    _fields_ = (("pickled", ctypes.c_void_p), ("size", ctypes.c_int32))


def _exception_at(address: int) -> Exception:
    record = _PickledException.from_address(address)
    kind, arguments, *_ = pickle.loads(ctypes.string_at(record.pickled, record.size))
    return kind(*(arguments or ()))
