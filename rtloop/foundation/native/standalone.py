"""Object code of compiled kernels that runs without numba, with the C library alone.

numba's own C functions contain calls into the interpreter that report an exception. For a kernel that raises none,
this module emits the same instructions with a plain C function around them.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import llvmlite.binding as llvm

if TYPE_CHECKING:
    from numba.core.codegen import CPUCodeLibrary

EXCEPTION_PREFIX = ".const.pickle"
"""Prefix of the names of numba's constants that describe an exception."""
WRAPPER_TEMPLATE = """
target datalayout = "{layout}"
target triple = "{triple}"
declare i32 @"{kernel}"({all_types})
define {result} @"{name}"({arguments}) {{
  %result = alloca {result}
  %raised = alloca ptr
  %status = call i32 @"{kernel}"(ptr %result, ptr %raised, {arguments})
  %value = load {result}, ptr %result
  ret {result} %value
}}
"""
"""C function that calls a kernel, whose first arguments are addresses for result and exception and which returns a
status."""


def kernel_object_code(library: CPUCodeLibrary, symbol: str, name: str, raises: bool) -> bytes | None:
    """Return the object code of a compiled kernel, with `name` for its symbol; None if it needs numba at run time.

    With `raises`, the code may contain descriptions of exceptions; without it, None for a kernel that may raise.
    """
    module = llvm.parse_bitcode(library._final_module.as_bitcode())
    module.get_function(symbol).name = name
    return _emit_object_code(module, name, library._codegen._tm, raises)


def c_function_object_code(cfunc: Any, name: str) -> bytes | None:
    """Return the object code of a C function for a compiled numba.cfunc; None if it needs numba or may raise."""
    library = cfunc._library
    module = llvm.parse_bitcode(library._final_module.as_bitcode())
    module.link_in(llvm.parse_assembly(_wrapper_text(module, cfunc.native_name, name)))
    return _emit_object_code(module, name, library._codegen._tm, raises=False)


def _emit_object_code(module: llvm.ModuleRef, name: str, machine: llvm.TargetMachine, raises: bool) -> bytes | None:
    """Return object code that exports `name` alone.

    None if the code needs a symbol that neither LLVM nor this process has, or if it may raise although `raises` is
    False. `module` is changed.
    """
    for symbol in (*module.functions, *module.global_variables):
        if symbol.name != name and not symbol.is_declaration:
            symbol.linkage = "internal"
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    process = ctypes.CDLL(None)
    undefined_names = [symbol.name for symbol in (*module.functions, *module.global_variables) if symbol.is_declaration]
    if not all(symbol.startswith("llvm.") or hasattr(process, symbol) for symbol in undefined_names):
        return None
    if not raises and any(symbol.name.startswith(EXCEPTION_PREFIX) for symbol in module.global_variables):
        return None
    return machine.emit_object(module)


def _wrapper_text(module: llvm.ModuleRef, numba_name: str, name: str) -> str:
    """Return LLVM's text (IR) of a C function `name` with the signature of `numba_name`, a C function of numba's.

    It calls the same kernel and ignores the kernel's status. `module` is the parsed LLVM module that defines both.
    """
    kernel, function = module.get_function(numba_name.removeprefix("cfunc.")), module.get_function(numba_name)
    return WRAPPER_TEMPLATE.format(
        layout=module.data_layout,
        triple=module.triple,
        kernel=kernel.name,
        all_types=", ".join(str(argument.type) for argument in kernel.arguments),
        result=str(function.global_value_type).partition(" ")[0],
        name=name,
        arguments=", ".join(f"{argument.type} %argument.{i}" for i, argument in enumerate(function.arguments)),
    )
