"""Ordered access to single words of shared memory from Python; `atomics` has the same for compiled code.

The functions are written in LLVM's assembly language because parking needs them: each process assembles them in a
millisecond, without numba and without a cache.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import TYPE_CHECKING

from rtloop.foundation.native import machine_code

if TYPE_CHECKING:
    from _ctypes import CFuncPtr

_LLVM_TEXT = """
define i64 @load_acquire(i64 %address) {
  %word = inttoptr i64 %address to ptr
  %value = load atomic i64, ptr %word acquire, align 8
  ret i64 %value
}
define void @store_release(i64 %address, i64 %value) {
  %word = inttoptr i64 %address to ptr
  store atomic i64 %value, ptr %word release, align 8
  ret void
}
define i32 @exchanged(i64 %address, i64 %expected, i64 %wanted) {
  %word = inttoptr i64 %address to ptr
  %pair = cmpxchg ptr %word, i64 %expected, i64 %wanted seq_cst seq_cst, align 8
  %done = extractvalue { i64, i1 } %pair, 1
  %result = zext i1 %done to i32
  ret i32 %result
}
"""
_WORD = ctypes.c_uint64


@cache
def _assembled_function(name: str, result: type[ctypes._SimpleCData[int]] | None, count: int) -> CFuncPtr:
    """Return a function of `_LLVM_TEXT` with `count` words as arguments; a call keeps the interpreter's lock."""
    return ctypes.PYFUNCTYPE(result, *[_WORD] * count)(machine_code.assemble(_LLVM_TEXT, name))


def load_acquire(address: int) -> int:
    """Return the uint64 at an address, a multiple of 8, loaded before every later load and store."""
    return _assembled_function("load_acquire", _WORD, 1)(address)


def store_release(address: int, value: int) -> None:
    """Set the uint64 at an address, a multiple of 8, after every earlier load and store."""
    _assembled_function("store_release", None, 2)(address, value)


def compare_exchange(address: int, expected: int, replacement: int) -> int:
    """Replace the uint64 at an address, a multiple of 8, if it equals `expected`, as one atomic operation.

    Returns 1 if it did, else 0.
    """
    return _assembled_function("exchanged", ctypes.c_int32, 3)(address, expected, replacement)
