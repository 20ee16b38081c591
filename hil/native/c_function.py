"""C functions made of kernels: compiled once, and from then on loaded without the compiler.

Their machine code lies in the cache beside what numba keeps there. To load it takes a millisecond and LLVM's linker; to
have numba load its own takes a second, most of which numba needs to know all that it could compile.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import re
import tempfile
from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm

OURS = "rtloop."
"""Modules whose sources name the cache; what others compile is compiled in each process that uses it."""
C_TYPES = {
    "int32": ctypes.c_int32, "int64": ctypes.c_int64, "uint64": ctypes.c_uint64, "intp": ctypes.c_ssize_t
}  # fmt: skip
_DIGEST_BYTES = hashlib.sha256().digest_size


class CFunction:
    """A kernel with the shape of a C function, such as "int64(intp, uint64)": to be called by its address, or here."""

    def __init__(self, function: Callable[..., Any], signature: str) -> None:
        self.__name__, self._function, self._signature = function.__name__, function, signature
        self._name = f"{function.__module__}.{function.__qualname__}"
        if not function.__module__.startswith(OURS):
            assert self.address  # a mistake in it is said where it stands

    @cached_property
    def address(self) -> int:
        """Where its machine code is."""
        ours = self._function.__module__.startswith(OURS)
        return (_loaded(self._name) if ours else None) or self._compiled(ours)

    def __call__(self, *arguments: int) -> Any:
        """Run it."""
        return self._callable(*arguments)

    @cached_property
    def _callable(self) -> Any:
        """By the interpreter, which waits for it as it does for any kernel: whoever needs memory in order gets it."""
        result, *given = re.findall(r"\w+", self._signature)
        return ctypes.PYFUNCTYPE(C_TYPES[result], *(C_TYPES[one] for one in given))(self.address)

    def _compiled(self, kept: bool) -> int:
        from rtloop.hil.native.compiler import numba
        from rtloop.hil.native.standalone import standalone

        made = numba.cfunc(self._signature, error_model="numpy")(self._function)
        self._made = made  # its machine code lives as long
        if kept and (machine_code := standalone(made, self._name)):
            _keep(self._name, machine_code)
        address: Any = made.address
        return address


def _path(name: str) -> Path:
    from rtloop.hil.native.cache import CACHE_FOLDER

    return CACHE_FOLDER / f"{name}.o"


def _keep(name: str, machine_code: bytes) -> None:
    path = _path(name)
    with contextlib.suppress(OSError):  # it is compiled again
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(hashlib.sha256(machine_code).digest() + machine_code)
        os.replace(file.name, path)


def _loaded(name: str) -> int | None:
    """Address of what was kept; None where nothing was, or not the whole of it."""
    try:
        data = _path(name).read_bytes()
    except OSError:
        return None
    machine_code = data[_DIGEST_BYTES:]
    if hashlib.sha256(machine_code).digest() != data[:_DIGEST_BYTES]:
        return None
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(machine_code))
    engine.finalize_object()
    _engines.append(engine)
    return engine.get_function_address(name)


_engines: list[Any] = []
"""They own the machine code, one each: several may hold copies of one kernel."""


@cache
def _machine() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(jit=True)
