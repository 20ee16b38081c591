"""Machine code in the cache, beside numba's own files: loaded in a millisecond by LLVM's linker alone.

numba needs a second to load its own files, most of it to set up its compiler.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from rtloop.foundation.native import cache_files as stored

if TYPE_CHECKING:
    from llvmlite.binding import ExecutionEngine, TargetMachine

_engines: list[ExecutionEngine] = []
"""Engines that own the loaded machine code, one per load; several may hold copies of one kernel."""


def store(name: str, machine_code: bytes) -> None:
    """Store machine code in the cache under the name of its symbol. An error of the file system is ignored."""
    stored.write(_path(name), machine_code)


def load(name: str) -> int | None:
    """Load stored machine code and return the address of its symbol `name`, valid until exit; None without stored code.

    A damaged file counts as missing.
    """
    try:
        machine_code = stored.read(_path(name))
    except OSError:  # there is no folder for a cache
        return None
    if machine_code is None:
        return None
    import llvmlite.binding as llvm  # Most commands call no kernel, and need not load LLVM.

    engine = _create_engine("")
    engine.add_object_file(llvm.ObjectFileRef.from_data(machine_code))
    engine.finalize_object()
    return engine.get_function_address(name)


def assemble(text: str, name: str) -> int:
    """Compile a text in LLVM's assembly language and return the address of its function `name`, valid until exit."""
    engine = _create_engine(text)
    engine.finalize_object()
    return engine.get_function_address(name)


def _create_engine(text: str) -> ExecutionEngine:
    """Return an LLVM engine that contains a text in LLVM's assembly language, and keep it alive."""
    import llvmlite.binding as llvm

    machine = _target_machine()  # first: the text is parsed for this processor
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(text), machine)
    _engines.append(engine)
    return engine


def _path(name: str) -> Path:
    """Return the path of the cache's file with the machine code of symbol `name`."""
    from rtloop.foundation.native.cache import CACHE_FOLDER

    return CACHE_FOLDER / f"{name}{stored.MACHINE_CODE}"


@cache
def _target_machine() -> TargetMachine:
    """Return LLVM's machine for this processor, created by the first call."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(jit=True)
