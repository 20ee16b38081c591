"""Messages in the format of ROS 2: CDR data and ros2msg schemas, which viewers read without knowledge of rtloop.

The CDR data is little-endian with a header of four bytes, after which alignment is counted.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from rtloop.foundation.arrays import Real

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
TIME = "builtin_interfaces/Time"
EXTREMES = "rtloop/Extremes"
LIVE, EVENT = "rtloop/msg/Live", "rtloop/msg/Event"
DEFINITIONS = {TIME: "int32 sec\nuint32 nanosec\n", EXTREMES: "float64 min\nfloat64 max\nfloat64 last\n"}
EVENT_TEXTS = ("kind", "who", "axis", "what")
LIVE_HEAD = struct.Struct("<iIQQQ")
NS_PER_S = 1_000_000_000


def live_schema(names: Sequence[str]) -> str:
    """Return the schema of `live_message`: extremes and last value of each signal."""
    fields = "".join(f"{EXTREMES} {name}\n" for name in names)
    return _schema(f"{TIME} stamp\nuint64 tick\nuint64 ticks\nuint64 lost\n{fields}", TIME, EXTREMES)


def live_message(stamp_ns: int, tick: int, ticks: int, lost: int, extremes: Real) -> bytes:
    """Return the CDR message of a digest: newest tick, count of ticks, count of lost ticks, `extremes` (signals, 3) as
    min, max, last. `stamp_ns` is a UNIX time.
    """
    head = LIVE_HEAD.pack(*divmod(stamp_ns, NS_PER_S), tick, ticks, lost)
    return LITTLE_ENDIAN + head + np.ascontiguousarray(extremes, "<f8").tobytes()


def event_schema() -> str:
    """Return the schema of `event_message`; its field `what` is JSON."""
    return _schema(f"{TIME} stamp\nuint64 tick\n" + "".join(f"string {name}\n" for name in EVENT_TEXTS), TIME)


def event_message(stamp_ns: int, tick: int, *texts: str) -> bytes:
    """Return the CDR message of an event; `stamp_ns` is a UNIX time.

    `texts` are the values of the fields EVENT_TEXTS, in this order; characters NUL in them are left out.
    """
    message = struct.pack("<iIQ", *divmod(stamp_ns, NS_PER_S), tick)
    for text in texts:
        data = text.replace("\0", "").encode() + b"\0"
        message += b"\0" * (-len(message) % 4) + struct.pack("<I", len(data)) + data
    return LITTLE_ENDIAN + message


def _schema(fields: str, *types: str) -> str:
    """Return a ros2msg schema: the fields of the message, then the definitions of the types in them."""
    return fields + "".join(f"{'=' * 80}\nMSG: {name}\n{DEFINITIONS[name]}" for name in types)
