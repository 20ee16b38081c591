"""Binary messages to a page: a JSON header behind its length, then arrays of 32-bit numbers, little-endian."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real

ALIGNMENT = 8
SEND_TIMEOUT_S = 10.0
"""A client that takes no message for this time is dropped."""


def pack_frame(
    kind: str, header: Mapping[str, object], arrays: Mapping[str, npt.NDArray[np.generic]] | None = None
) -> bytes:
    """Return a binary message with `kind`, the JSON values of `header`, and the arrays (n,) as Float32, by their names.

    NaN in an array marks a missing value. Raises ValueError for NaN or infinity in `header`.
    """
    arrays = arrays or {}
    message_header = {"kind": kind, **header, "arrays": [[name, len(values)] for name, values in arrays.items()]}
    text = json.dumps(message_header, allow_nan=False, ensure_ascii=False).encode()
    text += b" " * (-(4 + len(text)) % ALIGNMENT)
    numbers = (values.astype("<f4").tobytes() for values in arrays.values())
    return b"".join([struct.pack("<I", len(text)), text, *numbers])


def pack_envelopes(signals: tuple[str, ...], lows: Real, highs: Real) -> dict[str, Real]:
    """Return the arrays NAME:low and NAME:high of a frame from envelopes (signals, points)."""
    rows = zip(signals, lows, highs, strict=True)
    return {f"{name}:{bound}": row for name, low, high in rows for bound, row in (("low", low), ("high", high))}
