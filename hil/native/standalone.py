"""What numba compiled, without what only numba can run: machine code that needs the C library, and no more.

numba's own C functions hold the interpreter's calls that report an exception. A kernel that raises none does not need
them, and what is left is that kernel, instruction by instruction, with a C function of the same shape around it.
"""

from __future__ import annotations

import ctypes
from typing import Any

import llvmlite.binding as llvm

RAISES = "picklebuf"
"""In the names of constants that describe an exception to be raised."""
C_FUNCTION = """
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
"""A kernel wants places for its result and for what it raises, and returns a status."""


def standalone(made: Any, name: str) -> bytes | None:
    """Object code of a compiled numba.cfunc, with the symbol `name`; None for one that needs numba where it runs."""
    library = made._library
    module = llvm.parse_bitcode(library._final_module.as_bitcode())
    module.link_in(llvm.parse_assembly(_c_function(module, made.native_name, name)))
    for one in (*module.functions, *module.global_variables):
        if one.name != name and not one.is_declaration:
            one.linkage = "internal"
    machine = library._codegen._tm
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    process = ctypes.CDLL(None)
    needed = [one.name for one in (*module.functions, *module.global_variables) if one.is_declaration]
    if not all(one.startswith("llvm.") or hasattr(process, one) for one in needed):
        return None
    return None if any(RAISES in one.name for one in module.global_variables) else machine.emit_object(module)


def _c_function(module: Any, theirs: str, name: str) -> str:
    """The text of a C function `name`, of the shape of `theirs`, which is numba's for the same kernel."""
    kernel, function = module.get_function(theirs.removeprefix("cfunc.")), module.get_function(theirs)
    return C_FUNCTION.format(
        layout=module.data_layout,
        triple=module.triple,
        kernel=kernel.name,
        all_types=", ".join(str(one.type) for one in kernel.arguments),
        result=str(function.global_value_type).partition(" ")[0],
        name=name,
        arguments=", ".join(f"{one.type} %given.{i}" for i, one in enumerate(function.arguments)),
    )
