"""CRC-32 of zlib and MCAP, by carry-less multiplication where the processor has it: a third of the time of zlib.

The bits of the data are the coefficients of a polynomial, and the checksum is its remainder. A part of 16 bytes that
stands d bits before another one may be replaced by its product with the remainder of x^d, added to the other one (V.
Gopal et al., "Fast CRC computation for generic polynomials using PCLMULQDQ instruction", Intel, 2009). The compiled
code folds whole blocks into 16 bytes in this way; zlib computes the checksum of these and of the bytes that follow.
"""

from __future__ import annotations

import ctypes
import platform
import zlib
from functools import cache
from typing import Any

import llvmlite.binding as llvm
import numpy as np

from rtloop.foundation.native import machine_code

BLOCK_BYTES = 64
RESIDUE_BYTES = 16
SHORTEST_BYTES = 1024
"""Least number of bytes that are folded: for fewer, zlib is as fast."""
_ALL_ONES = 0xFFFFFFFF
_FOLD = "<i64 5708721108, i64 7631803798>"  # 0x154442bd4, 0x1c6e41596: by a block
_MERGE = "<i64 6259578832, i64 3433693342>"  # 0x1751997d0, 0x0ccaa009e: by 16 bytes
_LLVM_TEXT = f"""
declare <2 x i64> @llvm.x86.pclmulqdq(<2 x i64>, <2 x i64>, i8)

define internal <2 x i64> @fold(<2 x i64> %part, <2 x i64> %factors, <2 x i64> %next) alwaysinline #0 {{
  %low = call <2 x i64> @llvm.x86.pclmulqdq(<2 x i64> %part, <2 x i64> %factors, i8 0)
  %high = call <2 x i64> @llvm.x86.pclmulqdq(<2 x i64> %part, <2 x i64> %factors, i8 17)
  %product = xor <2 x i64> %low, %high
  %sum = xor <2 x i64> %product, %next
  ret <2 x i64> %sum
}}

define void @fold_blocks(i64 %address, i64 %bytes, i64 %register, i64 %out) #0 {{
start:
  %data = inttoptr i64 %address to ptr
  %a1 = getelementptr i8, ptr %data, i64 16
  %a2 = getelementptr i8, ptr %data, i64 32
  %a3 = getelementptr i8, ptr %data, i64 48
  %f0 = load <2 x i64>, ptr %data, align 1
  %f1 = load <2 x i64>, ptr %a1, align 1
  %f2 = load <2 x i64>, ptr %a2, align 1
  %f3 = load <2 x i64>, ptr %a3, align 1
  %begin = insertelement <2 x i64> zeroinitializer, i64 %register, i32 0
  %g0 = xor <2 x i64> %f0, %begin
  br label %test
test:
  %offset = phi i64 [ 64, %start ], [ %following, %block ]
  %x0 = phi <2 x i64> [ %g0, %start ], [ %y0, %block ]
  %x1 = phi <2 x i64> [ %f1, %start ], [ %y1, %block ]
  %x2 = phi <2 x i64> [ %f2, %start ], [ %y2, %block ]
  %x3 = phi <2 x i64> [ %f3, %start ], [ %y3, %block ]
  %remains = icmp ult i64 %offset, %bytes
  br i1 %remains, label %block, label %end
block:
  %p0 = getelementptr i8, ptr %data, i64 %offset
  %p1 = getelementptr i8, ptr %p0, i64 16
  %p2 = getelementptr i8, ptr %p0, i64 32
  %p3 = getelementptr i8, ptr %p0, i64 48
  %d0 = load <2 x i64>, ptr %p0, align 1
  %d1 = load <2 x i64>, ptr %p1, align 1
  %d2 = load <2 x i64>, ptr %p2, align 1
  %d3 = load <2 x i64>, ptr %p3, align 1
  %y0 = call <2 x i64> @fold(<2 x i64> %x0, <2 x i64> {_FOLD}, <2 x i64> %d0)
  %y1 = call <2 x i64> @fold(<2 x i64> %x1, <2 x i64> {_FOLD}, <2 x i64> %d1)
  %y2 = call <2 x i64> @fold(<2 x i64> %x2, <2 x i64> {_FOLD}, <2 x i64> %d2)
  %y3 = call <2 x i64> @fold(<2 x i64> %x3, <2 x i64> {_FOLD}, <2 x i64> %d3)
  %following = add i64 %offset, 64
  br label %test
end:
  %m1 = call <2 x i64> @fold(<2 x i64> %x0, <2 x i64> {_MERGE}, <2 x i64> %x1)
  %m2 = call <2 x i64> @fold(<2 x i64> %m1, <2 x i64> {_MERGE}, <2 x i64> %x2)
  %m3 = call <2 x i64> @fold(<2 x i64> %m2, <2 x i64> {_MERGE}, <2 x i64> %x3)
  %result = inttoptr i64 %out to ptr
  store <2 x i64> %m3, ptr %result, align 1
  ret void
}}
attributes #0 = {{ "target-features"="+pclmul,+sse4.2" }}
"""


def crc32(data: bytes | bytearray | memoryview, value: int = 0) -> int:
    """Return the CRC-32 of `data`, as `zlib.crc32` does; `value` is the checksum of the bytes before."""
    fold_blocks = _fold_function() if len(data) >= SHORTEST_BYTES else None
    if fold_blocks is None:
        return zlib.crc32(data, value)
    octets = np.frombuffer(data, np.uint8)
    folded_bytes = octets.size - octets.size % BLOCK_BYTES
    residue = ctypes.create_string_buffer(RESIDUE_BYTES)
    fold_blocks(octets.ctypes.data, folded_bytes, value ^ _ALL_ONES, ctypes.addressof(residue))
    value = zlib.crc32(residue.raw, _ALL_ONES)  # The residue holds the beginning already: the register starts at 0.
    return zlib.crc32(memoryview(data)[folded_bytes:], value)


@cache
def _fold_function() -> Any:
    """Return the compiled function `fold_blocks`; None if the processor has no carry-less multiplication."""
    is_x86 = platform.machine().lower() in ("x86_64", "amd64")
    if not is_x86 or not llvm.get_host_cpu_features().get("pclmul"):
        return None
    arguments = [ctypes.c_uint64] * 4
    return ctypes.PYFUNCTYPE(None, *arguments)(machine_code.assemble(_LLVM_TEXT, "fold_blocks"))
