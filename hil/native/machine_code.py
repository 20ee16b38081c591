"""Machine code in the cache, beside what numba keeps there: loaded in a millisecond, by LLVM's linker alone.

To have numba load its own takes a second, most of which numba needs to know all that it could compile.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm

from rtloop.hil.trusted import open_own

_DIGEST_BYTES = hashlib.sha256().digest_size
_engines: list[Any] = []
"""They own the machine code, one each: several may hold copies of one kernel."""


def keep(name: str, machine_code: bytes) -> None:
    """Keep it under the name of its symbol, if that can be."""
    path = _path(name)
    with contextlib.suppress(OSError):  # it is compiled again
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(hashlib.sha256(machine_code).digest() + machine_code)
        os.replace(file.name, path)


def loaded(name: str) -> int | None:
    """Address of what was kept; None where nothing was, or not the whole of it."""
    try:
        with os.fdopen(open_own(_path(name)), "rb") as file:
            data = file.read()
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


def _path(name: str) -> Path:
    from rtloop.hil.native.cache import CACHE_FOLDER

    return CACHE_FOLDER / f"{name}.o"


@cache
def _machine() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(jit=True)
