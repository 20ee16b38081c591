"""CRC-32 of chunks and files. ISA-L's takes a tenth of the time of zlib's, which stands in where ISA-L is missing."""

from __future__ import annotations

try:
    from isal.isal_zlib import crc32
except ImportError:  # There are packages for x86-64 and 64-bit Arm alone.
    from zlib import crc32

__all__ = ["crc32"]
