"""Ordered loads and stores on shared memory, for compiled code.

They follow the C11 memory model as LLVM implements it: a release store publishes all earlier writes, and an acquire
load of the stored value makes those writes visible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

from rtloop.foundation.native import uncompiled
from rtloop.foundation.native.compiled import intrinsic, intrinsic_like

if TYPE_CHECKING:
    from llvmlite.ir import IRBuilder, Value
    from numba.core.base import BaseContext
    from numba.core.types.abstract import Type
    from numba.core.typing.templates import Signature

ALIGNMENT = 8


def _element_pointer(
    compiler: ModuleType, context: BaseContext, builder: IRBuilder, array_type: Type, array: Value, index: Value
) -> Value:
    """Return the LLVM pointer to element `index` of `array`, without bounds check.

    `compiler` is the module `native.compiler`, the other parameters are as in numba's code generators.
    """
    fields = context.make_array(array_type)(context, builder, array)
    return compiler.cgutils.get_item_pointer(context, builder, array_type, fields, [index], wraparound=False)


def _is_word_array(types: ModuleType, array: Any) -> bool:
    """Whether the numba type `array` is a one-dimensional array of uint64."""
    return isinstance(array, types.Array) and array.dtype == types.uint64 and array.ndim == 1


@intrinsic_like(uncompiled.load_acquire)
def load_acquire(compiler: ModuleType, array: Type, index: Type) -> tuple[Signature, Callable[..., Value]] | None:
    """Return word `index` of a uint64 array, loaded before every later load and store; the index is not checked."""
    types = compiler.types
    if not _is_word_array(types, array):
        return None

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]) -> Value:
        """Emit the LLVM code of the load and return its value; numba defines the parameters."""
        pointer = _element_pointer(compiler, context, builder, signature.args[0], arguments[0], arguments[1])
        return builder.load_atomic(pointer, "acquire", ALIGNMENT)

    return types.uint64(array, types.intp), codegen


@intrinsic_like(uncompiled.store_release)
def store_release(
    compiler: ModuleType, array: Type, index: Type, value: Type
) -> tuple[Signature, Callable[..., Value]] | None:
    """Set word `index` of a uint64 array, ordered after every earlier load and store; the index is not checked."""
    types = compiler.types
    if not _is_word_array(types, array):
        return None

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]) -> Value:
        """Emit the LLVM code of the store and return numba's None; numba defines the parameters."""
        pointer = _element_pointer(compiler, context, builder, signature.args[0], arguments[0], arguments[1])
        builder.store_atomic(arguments[2], pointer, "release", ALIGNMENT)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.uint64), codegen


@intrinsic
def compare_exchange(
    compiler: ModuleType, array: Type, index: Type, expected: Type, replacement: Type
) -> tuple[Signature, Callable[..., Value]] | None:
    """Replace word `index` of a uint64 array if it equals `expected`; return whether it did, as one atomic operation.

    Among concurrent calls with one `expected` and other replacements, in any processes, at most one returns True. The
    index is not checked. Compiled kernels only.
    """
    types = compiler.types
    if not _is_word_array(types, array):
        return None

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]) -> Value:
        """Emit the LLVM code of the exchange and return whether it succeeded; numba defines the parameters."""
        pointer = _element_pointer(compiler, context, builder, signature.args[0], arguments[0], arguments[1])
        return builder.extract_value(builder.cmpxchg(pointer, arguments[2], arguments[3], "seq_cst"), 1)

    return types.boolean(array, types.intp, types.uint64, types.uint64), codegen


@intrinsic
def fence_acquire(compiler: ModuleType) -> tuple[Signature, Callable[..., Value]]:
    """Keep every later load and store behind all earlier loads. Compiled kernels only."""

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]) -> Value:
        """Emit the LLVM code of the fence and return numba's None; numba defines the parameters."""
        builder.fence("acquire")
        return context.get_dummy_value()

    return compiler.types.void(), codegen


@intrinsic
def fence_release(compiler: ModuleType) -> tuple[Signature, Callable[..., Value]]:
    """Keep every earlier load and store in front of all later stores. Compiled kernels only."""

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]) -> Value:
        """Emit the LLVM code of the fence and return numba's None; numba defines the parameters."""
        builder.fence("release")
        return context.get_dummy_value()

    return compiler.types.void(), codegen
