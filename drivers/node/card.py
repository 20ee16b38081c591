"""Memory that compiled exchange and Python share: the state of one open node."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.drivers.node.frames import MAX_FRAME_BYTES, Scale
from rtloop.drivers.node.tags import Seal, key_words

WINDOW = 1024
"""Number of the last frames sent that are still known: their answers count as late or repeated."""
ROOM_BYTES = 2 * MAX_FRAME_BYTES
"""Room for a frame, also in COBS's code."""
RAW_BYTES = 4096
COUNTS = ("lost", "reordered", "duplicated", "invalid", "foreign", "held", "error_level", "exchange_ns")
OBSERVED = (
    "node_lost_samples", "node_reordered_samples", "node_duplicated_samples", "node_invalid_frames",
    "node_foreign_frames", "node_held_ticks", "node_error_level",
    "node_exchange_us",
)  # fmt: skip
"""Names of the observed signals, in the order of COUNTS. The last one is the time from the sending of the newest
answered request until the loop had its answer."""

_ADDRESSES = (
    "sent", "received", "coded", "partial", "raw", "crc_table",
    "in_scales", "out_scales", "codes", "ring_sequence", "ring_request", "ring_ns", "ring_tag", "timespec",
)  # fmt: skip
CARD = np.dtype(
    [
        *((name, np.int64) for name in _ADDRESSES),
        *((name, np.int64) for name in COUNTS),
        ("fd", np.int64),
        ("is_serial", np.int64),
        ("strangers_fd", np.int64),  # a socket that gets what other senders than the node send to the loop's port
        ("inputs", np.int64),
        ("outputs", np.int64),
        ("digital_inputs", np.int64),
        ("digital_outputs", np.int64),
        ("hold_ticks", np.int64),
        ("error_limit", np.int64),
        ("waits", np.int64),  # 1 to ask for a sample in the tick that uses it, 0 to use the answer to the last drive
        ("deadline_ns", np.int64),
        ("running", np.int64),  # 1 from the first tick on
        ("failure", np.int64),  # 0, or why no sample comes any more; see `rtloop.drivers.node.failures`
        ("held_in_a_row", np.int64),
        ("requests", np.int64),  # frames that asked for an answer, since the driver was opened
        ("opening_request", np.int64),  # the last of them before the first tick
        ("newest_request", np.int64),  # which of them the newest sample answers, from 1; 0 before the first
        ("age_ns", np.int64),  # of the newest sample when the node sent it
        ("raw_length", np.int64),
        ("raw_position", np.int64),
        ("reads_until_strangers", np.int64),  # reads before the next one that counts their datagrams
        ("frame_length", np.int64),  # bytes of the frame that a serial line has delivered so far; −1 to skip to its end
        ("is_keyed", np.int64),
        ("key_low", np.uint64),
        ("key_high", np.uint64),
        ("session", np.uint32),
        ("boot", np.uint32),
        ("sequence", np.uint32),  # of the last frame that asked for an answer
        ("last_sequence", np.uint32),  # of the last frame
        ("newest", np.uint32),  # of the newest sample
        ("digital", np.uint32),  # inputs in the newest sample
        ("hold_us", np.uint32),
        ("opening", np.uint32),
        ("turn", np.uint32),  # how often the sequence has begun again at 0
    ]
)
"""State of an exchange; each name in the first group is the address of an array."""
SCALE = np.dtype(
    [("lowest", np.int64), ("highest", np.int64), ("volts_per_code", np.float64), ("offset_v", np.float64)]
)
"""A channel's range of codes and its volts: offset_v + code · volts_per_code."""


def make_card(
    fd: int, strangers_fd: int | None, seal: Seal, **values: Any
) -> tuple[npt.NDArray[np.void], dict[str, npt.NDArray[np.generic]]]:
    """Return a record CARD, shape (1,), and a dict of the arrays whose addresses it holds, by the names of these
    fields.

    The arrays must live as long as the record. `fd` is connected to the node; `strangers_fd` is a socket of the same
    port for all others, None for a serial line. `seal` is that of the session. `values` are further fields; `in_scales`
    and `out_scales` are sequences of Scale.
    """
    inputs, outputs = (_scale_array(values.pop(name)) for name in ("in_scales", "out_scales"))
    arrays: dict[str, npt.NDArray[np.generic]] = {
        **{name: np.zeros(ROOM_BYTES // 8, np.uint64) for name in ("sent", "received", "coded", "partial")},
        "raw": np.zeros(RAW_BYTES, np.uint8),
        "crc_table": crc_table(),
        "in_scales": inputs,
        "out_scales": outputs,
        "codes": np.zeros(len(inputs), np.int32),
        "ring_sequence": np.zeros(WINDOW, np.uint32),
        "ring_request": np.zeros(WINDOW, np.int64),
        "ring_ns": np.zeros(WINDOW, np.int64),
        "ring_tag": np.zeros(WINDOW, np.uint64),
        "timespec": np.zeros(2, np.int64),
    }
    card = np.zeros(1, CARD)
    card["fd"], card["is_serial"], card["strangers_fd"] = fd, strangers_fd is None, strangers_fd or 0
    card["inputs"], card["outputs"] = len(inputs), len(outputs)
    card["boot"], card["opening"], card["is_keyed"] = seal.boot, seal.opening, seal.key is not None
    card["key_low"], card["key_high"] = (0, 0) if seal.key is None else key_words(seal.key)
    for name, value in values.items():
        card[name] = value
    for name, array in arrays.items():
        card[name] = array.ctypes.data
    return card, arrays


def _scale_array(scales: tuple[Scale, ...]) -> npt.NDArray[np.void]:
    """Return the scales as records SCALE (channels,), without their safe codes and largest changes."""
    rows = [(s.lowest, s.highest, s.volts_per_code, s.offset_v) for s in scales]
    return np.array(rows, SCALE)


def crc_table() -> npt.NDArray[np.uint32]:
    """Return the tables (4, 256), uint32, to compute CRC-32 by words of four bytes (polynomial 0xEDB88320, reflected).

    Row k has the CRC of each byte with k bytes 0 behind it.
    """
    tables = np.zeros((4, 256), np.uint32)
    tables[0] = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        tables[0] = np.where(tables[0] & 1, np.uint32(0xEDB88320) ^ (tables[0] >> 1), tables[0] >> 1)
    for k in range(3):
        tables[k + 1] = (tables[k] >> 8) ^ tables[0][tables[k] & 0xFF]
    return tables
