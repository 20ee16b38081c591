"""C function pointers and raw addresses, for use in compiled code.

Drivers and clocks share one signature, `int32 function(void *context, double *values)`, and the functions of laws
another. The loop calls them by their address and needs no branch for each kind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING

from rtloop.foundation.native import uncompiled
from rtloop.foundation.native.compiled import c_library_function, intrinsic_like, numba_function

if TYPE_CHECKING:
    from llvmlite.ir import IRBuilder, Value
    from numba.core.base import BaseContext
    from numba.core.types.abstract import Type
    from numba.core.typing.templates import Signature

carray = numba_function("carray", uncompiled.carray)
"""numba's array view of a pointer."""
SIGNATURE = "int32(voidptr, CPointer(float64))"
"""numba's signature of `int32 function(void *context, double *values)`."""

copy_bytes = c_library_function("memcpy", "intp(intp, intp, intp)")
"""`memcpy(target, source, bytes)`, with addresses as integers."""


@intrinsic_like(uncompiled.call)
def call(compiler: ModuleType, function: Type, context: Type, values: Type) -> tuple[Signature, Callable[..., Value]]:
    """Call `int32 function(void *context, double *values)` and return its result; all arguments are addresses."""
    types, ir = compiler.types, compiler.ir

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]) -> Value:
        """Emit the LLVM code of a call and return its value; numba defines the parameters."""
        void_pointer, double_pointer = ir.IntType(8).as_pointer(), ir.DoubleType().as_pointer()
        function_type = ir.FunctionType(ir.IntType(32), [void_pointer, double_pointer]).as_pointer()
        pointers = [
            builder.inttoptr(argument, pointer_type)
            for argument, pointer_type in zip(arguments, (function_type, void_pointer, double_pointer), strict=True)
        ]
        return builder.call(pointers[0], pointers[1:])

    return types.int32(types.intp, types.intp, types.intp), codegen


@intrinsic_like(uncompiled.call_law)
def call_law(
    compiler: ModuleType, function: Type, result: Type, raised: Type, coefficients: Type, state: Type, law_input: Type
) -> tuple[Signature, Callable[..., Value]]:
    """Call a function of a law and return its status, 0 unless it raised.

    `function`, `result`, `raised`, `coefficients` and `state` are addresses; `law_input` is an address or a float64. It
    is numba's own calling convention: the function writes its result and its exception to `result` and `raised`.
    """
    types, ir = compiler.types, compiler.ir

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]) -> Value:
        """Emit the LLVM code of a call and return its value; numba defines the parameters."""
        pointer = ir.IntType(8).as_pointer()
        last = ir.DoubleType() if number else pointer
        target = builder.inttoptr(arguments[0], ir.FunctionType(ir.IntType(32), [pointer] * 4 + [last]).as_pointer())
        record_pointers = [builder.inttoptr(argument, pointer) for argument in arguments[1:5]]
        return builder.call(
            target, [*record_pointers, arguments[5] if number else builder.inttoptr(arguments[5], pointer)]
        )

    number = isinstance(law_input, types.Float)
    return types.int32(*[types.intp] * 5, types.float64 if number else types.intp), codegen


@intrinsic_like(uncompiled.address_pointer)
def address_pointer(compiler: ModuleType, address: Type) -> tuple[Signature, Callable[..., object]]:
    """Convert an integer address to `void *`, for numba.carray."""
    types = compiler.types

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]) -> object:
        """Emit the LLVM code of the conversion and return its value; numba defines the parameters."""
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.intp), codegen


@intrinsic_like(uncompiled.load_word)
def load_word(compiler: ModuleType, address: Type) -> tuple[Signature, Callable[..., Value]]:
    """Load the eight bytes at an address as uint64, in the processor's byte order, and not as one atomic operation.

    The address need not be aligned.
    """
    types, ir = compiler.types, compiler.ir

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]) -> Value:
        """Emit the LLVM code of a load and return its value; numba defines the parameters."""
        return builder.load(builder.inttoptr(arguments[0], ir.IntType(64).as_pointer()), align=1)

    return types.uint64(types.intp), codegen


@intrinsic_like(uncompiled.add_words)
def add_words(compiler: ModuleType, first: Type, second: Type) -> tuple[Signature, Callable[..., object]]:
    """Add two uint64 modulo 2⁶⁴. The operator + would warn of an overflow where kernels run uncompiled."""
    types = compiler.types

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]) -> object:
        """Emit the LLVM code of the sum and return its value; numba defines the parameters."""
        return builder.add(arguments[0], arguments[1])

    return types.uint64(types.uint64, types.uint64), codegen
