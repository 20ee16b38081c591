"""Kernels: functions of numbers that numba compiles, with one set of options per decorator.

The compiler is imported when the first kernel is compiled or loaded from numba's cache. A module with kernels is thus
as quick to import as any other: most processes call no kernel.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import cached_property, update_wrapper, wraps
from types import ModuleType
from typing import TYPE_CHECKING, Any

from rtloop.foundation.native import machine_code
from rtloop.foundation.native.c_function import CFunction, Entry, compile_kernel
from rtloop.foundation.native.uncompiled import UncompiledFunction, is_uncompiled_allowed, register_function

if TYPE_CHECKING:
    from numba.core.ccallback import CFunc
    from numba.core.dispatcher import Dispatcher
    from numba.core.types.abstract import Type
    from numba.core.typing.templates import Signature

PACKAGE_PREFIX = "rtloop."
"""Prefix of the modules in the cache folder's digest; numba caches the kernels of other modules itself."""
UNCOMPILED = os.environ.get("NUMBA_DISABLE_JIT", "").strip("0 ").isdecimal()
"""Whether kernels run uncompiled, as Python functions, because of NUMBA_DISABLE_JIT=1 in the environment.

Any number but 0 has this effect; numba ignores other texts."""


class Kernel:
    """A function that is compiled on first use; other attributes come from numba's dispatcher."""

    def __init__(self, function: Callable[..., object], options: dict[str, Any]) -> None:
        """Store the function, uncompiled. `options` are numba's; with `cache`, numba stores the compiled code."""
        update_wrapper(self, function)
        self.py_func = function
        self.options = {name: value for name, value in options.items() if name != "cache"}
        self._cached = options.get("cache", False)

    @cached_property
    def _dispatcher(self) -> Dispatcher:
        """numba's dispatcher of the function; the first access imports numba."""
        from rtloop.foundation.native.compiler import numba

        return numba.njit(cache=self._cached, **self.options)(self.py_func)

    def __call__(self, *arguments: object) -> Any:
        """Call the kernel and return its result; within `allow_uncompiled`, run its Python function."""
        return (self.py_func if is_uncompiled_allowed() else self._dispatcher)(*arguments)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of numba's dispatcher, which imports numba.

        Raises AttributeError for a name that begins with "__".
        """
        if name.startswith("__"):  # Python looks for such names on any object; the compiler need not be imported.
            raise AttributeError(name)
        return getattr(self._dispatcher, name)


class KernelSymbol:
    """A name in kernels that refers to a function other than a kernel; `resolve_type` returns its numba type.

    In uncompiled kernels, the function `uncompiled` takes its place; None if there is none.
    """

    def __init__(
        self, name: str, resolve_type: Callable[[ModuleType], Type], uncompiled: Callable[..., object] | None = None
    ) -> None:
        """Store the parts; `resolve_type` receives the module `native.compiler` when numba first needs the type."""
        self.__name__, self._resolve_type, self._uncompiled = name, resolve_type, uncompiled

    def __call__(self, *arguments: object) -> Any:
        """Call the Python equivalent and return its result. Raises NotImplementedError if there is none."""
        if self._uncompiled is None:
            raise NotImplementedError(f"{self.__name__} has no Python version; call it in compiled functions only")
        return self._uncompiled(*arguments)

    @cached_property
    def _numba_type_(self) -> Type:
        """numba's type of this name in kernels; numba looks for this attribute."""
        from rtloop.foundation.native import compiler

        return self._resolve_type(compiler)


def _make_kernel(function: Callable[..., object], **options: object) -> Kernel | Callable[..., object]:
    """Return a Kernel with numba's options, or the function itself if UNCOMPILED."""
    return function if UNCOMPILED else Kernel(function, options)


def jit(function: Callable[..., Any]) -> Any:
    """Compile a kernel on first use, inlined into its compiled callers; `.py_func` is the uncompiled function.

    Returns a Kernel, or the function itself if UNCOMPILED. Indices are not checked, which would cost a tenth of the
    law's time; the caller checks counts once.
    """
    return _make_kernel(function, cache=True, error_model="numpy", forceinline=True)


def jit_checked(function: Callable[..., Any]) -> Any:
    """Compile a kernel like `jit` does, with checked indices: an index outside its array raises IndexError."""
    return _make_kernel(function, cache=True, error_model="numpy", forceinline=True, boundscheck=True)


def jit_strict(function: Callable[..., Any]) -> Any:
    """Compile a user's kernel on first use, without a cache; return it as `jit` does.

    An index outside its array raises IndexError, a division by zero ZeroDivisionError.
    """
    return _make_kernel(function, error_model="python", boundscheck=True)


def jit_rare(function: Callable[..., Any]) -> Any:
    """Compile a kernel for rare work on first use; return it as `jit` does. It is called, not inlined, to keep its
    callers small.
    """
    return _make_kernel(function, cache=True, error_model="numpy")


def jit_rare_checked(function: Callable[..., Any]) -> Any:
    """Compile a kernel like `jit_rare` does, with checked indices.

    It is not for kernels that the law calls: the passing of exceptions would slow them down.
    """
    return _make_kernel(function, cache=True, error_model="numpy", boundscheck=True)


def jit_inline(function: Callable[..., Any]) -> Any:
    """Return a kernel whose source is copied into its calling kernels before compilation: they are optimised together.

    The function itself is returned if UNCOMPILED.
    """
    return _make_kernel(function, inline="always", error_model="numpy")


def intrinsic(function: Callable[..., object], uncompiled: Callable[..., object] | None = None) -> KernelSymbol:
    """Make a name for kernels from a function that generates its LLVM code.

    The function's first parameter is the module `native.compiler`; kernels leave it out. It returns signature and code
    generator, or None for argument types that it does not take. `uncompiled` is its Python equivalent for kernels that
    run without compilation; without one they cannot call the name.
    """

    def resolve_type(compiler: ModuleType) -> Type:
        """Return numba's type of the name; `compiler` is the module `native.compiler`."""

        @wraps(function)
        def typing_function(_: object, *arguments: Type) -> object:
            """Call `function` with the module `native.compiler` in place of numba's typing context."""
            return function(compiler, *arguments)

        return compiler.types.Function(compiler.make_intrinsic_template(symbol, typing_function, function.__name__))

    symbol = KernelSymbol(function.__name__, resolve_type, uncompiled)
    return symbol


def intrinsic_like(uncompiled: Callable[..., object]) -> Callable[[Callable[..., object]], KernelSymbol]:
    """Decorate an `intrinsic` whose Python equivalent, for uncompiled kernels, is the function `uncompiled`."""
    return lambda function: intrinsic(function, uncompiled)


def numba_function(name: str, uncompiled: Callable[..., object] | None = None) -> KernelSymbol:
    """Return a function of numba's own, by name, for use in kernels; `uncompiled` is its Python equivalent, if any."""
    return KernelSymbol(name, lambda compiler: compiler.kernel_type(getattr(compiler.numba, name)), uncompiled)


def c_library_function(name: str, signature: str, uncompiled: Callable[..., object] | None = None) -> KernelSymbol:
    """Return a function of the C library for use in kernels; `uncompiled` is its Python equivalent, if any.

    `signature` is numba's, as a text such as "int32(int32, intp)".
    """

    def resolve_type(compiler: ModuleType) -> Type:
        """Return numba's type of the function; `compiler` is the module `native.compiler`."""
        return compiler.types.ExternalFunction(name, compiler.parse_signature(signature))

    return KernelSymbol(name, resolve_type, uncompiled)


def unlocked_call(function: CFunction | UncompiledFunction) -> Callable[..., object]:
    """Return a function that calls a C function with addresses, and lets other threads of Python run meanwhile."""
    if isinstance(function, UncompiledFunction):
        return function
    return ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_ssize_t, ctypes.c_ssize_t)(function.address)


def cfunc(signature: str) -> Callable[[Callable[..., object]], Any]:
    """Decorate a kernel: make it a C function whose `.address` other compiled code may call.

    `signature` is numba's, as a text. The result is a CFunction; numba's own C function outside of rtloop, and an
    UncompiledFunction if UNCOMPILED.
    """

    def compile_function(function: Callable[..., object]) -> CFunction | UncompiledFunction | CFunc:
        """Return the C function of a kernel, of the kind that fits its module and UNCOMPILED."""
        if UNCOMPILED:
            return UncompiledFunction(function)
        if function.__module__.startswith(PACKAGE_PREFIX):
            return CFunction(function, signature)
        from rtloop.foundation.native.compiler import numba

        return numba.cfunc(signature, cache=True, error_model="numpy")(function)

    return compile_function


def python_entry(signature: str) -> Callable[[Callable[..., object]], Entry]:
    """Decorate a kernel that Python calls with integers and addresses: the result is an Entry.

    `signature` is a text such as "int64(intp, uint64)".
    """
    return lambda function: Entry(function, signature)


def native_address(kernel: Any, signature: Any) -> int:
    """Compile a kernel, of `jit_strict` or another decorator, for one signature; return its address for `call_law`.

    If UNCOMPILED, `kernel` is a Python function, and the number by which it is registered is returned. Raises numba's
    TypingError, or another error of numba's, for a function that cannot be compiled.
    """
    if UNCOMPILED:
        return register_function(kernel)
    kernel.compile(signature)
    overload = kernel.overloads[signature.args]
    return overload.library.get_pointer_to_function(overload.fndesc.llvm_func_name)


def cached_address(kernel: Kernel, name: str, signature: Callable[[], Signature]) -> int:
    """Return the address of a kernel, loaded from the cache by `name`, or compiled and stored under that name.

    `signature()` is called only for a compilation; it returns numba's signature. Raises numba's errors for a function
    that cannot be compiled.
    """
    return machine_code.load(name) or compile_kernel(kernel.py_func, signature(), name, kernel.options)
