"""C function pointers and raw addresses, as compiled code calls and reads them.

Everything that the loop calls has one shape, `int32 function(void *context, double *values)`: drivers and clocks are
interchangeable objects and not branches in the loop.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import carray as _carray  # pyright: ignore[reportPrivateImportUsage]
from numba import types

from rtloop.hil.native.compiled import intrinsic

carray: Any = _carray
"""numba's array view of a pointer."""
SIGNATURE = types.int32(types.voidptr, types.CPointer(types.float64))
"""numba's signature of `int32 function(void *context, double *values)`."""


@intrinsic
def call(typingctx: Any, function: Any, context: Any, values: Any) -> Any:
    """Call `int32 function(void *context, double *values)`, all three given as integers."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        void_pointer, double_pointer = ir.IntType(8).as_pointer(), ir.DoubleType().as_pointer()
        function_type = ir.FunctionType(ir.IntType(32), [void_pointer, double_pointer]).as_pointer()
        pointers = [
            builder.inttoptr(argument, pointer_type)
            for argument, pointer_type in zip(arguments, (function_type, void_pointer, double_pointer), strict=True)
        ]
        return builder.call(pointers[0], pointers[1:])

    return types.int32(types.intp, types.intp, types.intp), codegen


@intrinsic
def address_pointer(typingctx: Any, address: Any) -> Any:
    """An integer address as `void *`, for numba.carray."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.intp), codegen
