"""Binary messages to a page: a JSON header behind its length, then arrays of 32-bit numbers, little-endian."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy.typing as npt

ALIGNMENT = 8


def pack_frame(kind: str, header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]] | None = None) -> bytes:
    """A message of `kind`; `header` is finite JSON, the arrays (n,) go as Float32, NaN for what is not there."""
    arrays = arrays or {}
    message_header = {"kind": kind, **header, "arrays": [[name, len(values)] for name, values in arrays.items()]}
    text = json.dumps(message_header, allow_nan=False, ensure_ascii=False).encode()
    text += b" " * (-(4 + len(text)) % ALIGNMENT)
    numbers = (values.astype("<f4").tobytes() for values in arrays.values())
    return b"".join([struct.pack("<I", len(text)), text, *numbers])
