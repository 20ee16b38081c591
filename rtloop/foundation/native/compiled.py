"""Kernels: functions of numbers that are compiled, all with one set of options.

The compiler is imported when the first kernel is compiled, or loaded from the compiler's cache: to import a module with
kernels costs no more than any other, for most processes that do call none.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cached_property, update_wrapper, wraps
from types import SimpleNamespace
from typing import Any

from rtloop.foundation.native import machine_code
from rtloop.foundation.native.c_function import CFunction, Entry, compile_kernel
from rtloop.foundation.native.uncompiled import is_uncompiled_allowed, register_function

PACKAGE_PREFIX = "rtloop."
"""Modules whose sources name the cache; what stands in others is numba's to cache."""
UNCOMPILED = bool(int(os.environ.get("NUMBA_DISABLE_JIT") or 0))
"""Whether kernels are to run as they are written, which NUMBA_DISABLE_JIT=1 asks for."""


class Kernel:
    """A function that is compiled on first use; to the compiler, and to who looks into it, numba's own dispatcher."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self.py_func = function
        self.options = {name: value for name, value in options.items() if name != "cache"}
        self._cached = options.get("cache", False)

    @cached_property
    def _dispatcher(self) -> Any:
        from rtloop.foundation.native.compiler import numba

        return numba.njit(cache=self._cached, **self.options)(self.py_func)

    def __call__(self, *arguments: Any) -> Any:
        """Run it."""
        return (self.py_func if is_uncompiled_allowed() else self._dispatcher)(*arguments)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # what Python asks of any object is no reason to import the compiler
            raise AttributeError(name)
        return getattr(self._dispatcher, name)


class KernelSymbol:
    """A name in kernels that stands for no kernel; `meaning` gives its type, once there is a compiler to ask for it.

    `uncompiled` is what it does in a kernel that runs as it is written; without one it cannot be called there.
    """

    def __init__(
        self, name: str, resolve_type: Callable[[Any], Any], uncompiled: Callable[..., Any] | None = None
    ) -> None:
        self.__name__, self._resolve_type, self._uncompiled = name, resolve_type, uncompiled

    def __call__(self, *arguments: Any) -> Any:
        """Do what it stands for, in Python."""
        if self._uncompiled is None:
            raise NotImplementedError(f"{self.__name__} runs in compiled kernels only")
        return self._uncompiled(*arguments)

    @cached_property
    def _numba_type_(self) -> Any:
        from rtloop.foundation.native import compiler

        return self._resolve_type(compiler)


def _make_kernel(function: Callable[..., Any], **options: Any) -> Any:
    return function if UNCOMPILED else Kernel(function, options)


def jit(function: Callable[..., Any]) -> Any:
    """Compile a kernel on first use, part of its compiled callers; `.py_func` is the same kernel uncompiled.

    Its indices run up to counts that are checked where they are let in: checks of each cost a tenth of the law's time.
    """
    return _make_kernel(function, cache=True, error_model="numpy", forceinline=True)


def jit_checked(function: Callable[..., Any]) -> Any:
    """As `jit`, for what is told its indices: one beyond its array is an IndexError, and no write to somewhere."""
    return _make_kernel(function, cache=True, error_model="numpy", forceinline=True, boundscheck=True)


def jit_strict(function: Callable[..., Any]) -> Any:
    """Compile somebody else's kernel: an index beyond its array, or a division by zero, is an exception."""
    return _make_kernel(function, error_model="python", boundscheck=True)


def jit_rare(function: Callable[..., Any]) -> Any:
    """A kernel for what most ticks do not do: called, so that it does not crowd its callers."""
    return _make_kernel(function, cache=True, error_model="numpy")


def jit_rare_checked(function: Callable[..., Any]) -> Any:
    """As `jit_rare`, with checked indices; not for kernels that the law calls: passing an error on would slow them."""
    return _make_kernel(function, cache=True, error_model="numpy", boundscheck=True)


def jit_inline(function: Callable[..., Any]) -> Any:
    """A piece of a kernel, put into its callers before anything is compiled, so that they are optimised as one."""
    return _make_kernel(function, inline="always", error_model="numpy")


def intrinsic(function: Callable[..., Any], uncompiled: Callable[..., Any] | None = None) -> Any:
    """A function that writes its own LLVM code; its first parameter is the module `compiler`, with what that takes."""

    def resolve_type(compiler: Any) -> Any:
        @wraps(function)
        def typing_function(_: Any, *arguments: Any) -> Any:
            return function(compiler, *arguments)

        return compiler.types.Function(compiler.make_intrinsic_template(symbol, typing_function, function.__name__))

    symbol: Any = KernelSymbol(
        function.__name__, resolve_type, uncompiled
    )  # as Any, for its callers leave out that parameter
    return symbol


def intrinsic_like(uncompiled: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """An `intrinsic` that does the same as a function in Python, which stands for it where kernels run as written."""
    return lambda function: intrinsic(function, uncompiled)


def numba_function(name: str, uncompiled: Callable[..., Any] | None = None) -> Any:
    """A function of numba's own, for kernels."""
    return KernelSymbol(name, lambda compiler: compiler.type_of(getattr(compiler.numba, name)), uncompiled)


def c_library_function(name: str, signature: str, uncompiled: Callable[..., Any] | None = None) -> Any:
    """A function of the C library, for kernels; `uncompiled` does the same where they run as they are written."""

    def resolve_type(compiler: Any) -> Any:
        return compiler.types.ExternalFunction(name, compiler.signature_of(signature))

    return KernelSymbol(name, resolve_type, uncompiled)


def cfunc(signature: str) -> Callable[[Callable[..., Any]], Any]:
    """Compile a kernel to a C function whose `.address` other compiled code may call."""

    def compile_function(function: Callable[..., Any]) -> Any:
        if UNCOMPILED:
            return SimpleNamespace(address=register_function(function))
        if function.__module__.startswith(PACKAGE_PREFIX):
            return CFunction(function, signature)
        from rtloop.foundation.native.compiler import numba

        return numba.cfunc(signature, cache=True, error_model="numpy")(function)

    return compile_function


def python_entry(signature: str) -> Callable[[Callable[..., Any]], Entry]:
    """Compile a kernel that Python calls with numbers and addresses."""
    return lambda function: Entry(function, signature)


def native_address(kernel: Any, signature: Any) -> int:
    """Address of a kernel, as `jit` or `checked` gives it, for `call_law`; compiled, or loaded, for one signature.

    Raises numba's TypingError and what it raises otherwise for what it cannot compile.
    """
    if UNCOMPILED:
        return register_function(kernel)
    kernel.compile(signature)
    overload = kernel.overloads[signature.args]
    return overload.library.get_pointer_to_function(overload.fndesc.llvm_func_name)


def cached_address(kernel: Any, name: str, signature: Callable[[], Any]) -> int:
    """As `native_address`, for a kernel that the cache keeps as machine code under a name of its own."""
    return machine_code.load(name) or compile_kernel(kernel.py_func, signature(), name, kernel.options)
