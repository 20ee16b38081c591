"""Machine code in the cache, beside what numba keeps there: loaded in a millisecond, by LLVM's linker alone.

To have numba load its own takes a second, most of which numba needs to know all that it could compile.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm

from rtloop.foundation.native import cache_files as stored

_engines: list[Any] = []
"""They own the machine code, one each: several may hold copies of one kernel."""


def store(name: str, machine_code: bytes) -> None:
    """Keep it under the name of its symbol, if that can be."""
    stored.write(_path(name), machine_code)


def load(name: str) -> int | None:
    """Address of what was kept; None where nothing was, or not the whole of it."""
    try:
        machine_code = stored.read(_path(name))
    except OSError:  # there is no folder for a cache
        return None
    if machine_code is None:
        return None
    engine = _create_engine("")
    engine.add_object_file(llvm.ObjectFileRef.from_data(machine_code))
    engine.finalize_object()
    return engine.get_function_address(name)


def assemble(text: str, name: str) -> int:
    """Address of a function in a text in LLVM's language, compiled here: a millisecond for a few lines."""
    engine = _create_engine(text)
    engine.finalize_object()
    return engine.get_function_address(name)


def _create_engine(text: str) -> Any:
    """A linker that holds a text in LLVM's language."""
    machine = _target_machine()  # first: the text is parsed for this processor
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(text), machine)
    _engines.append(engine)
    return engine


def _path(name: str) -> Path:
    from rtloop.foundation.native.cache import CACHE_FOLDER

    return CACHE_FOLDER / f"{name}{stored.MACHINE_CODE}"


@cache
def _target_machine() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(jit=True)
