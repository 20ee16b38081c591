"""Messages as ROS 2 writes them: CDR, and schemas of the kind ros2msg. Viewers that know nothing of rtloop read these.

CDR here is little-endian with an encapsulation of four bytes, from behind which alignment is counted.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
TIME = "builtin_interfaces/Time"
EXTREMES = "rtloop/Extremes"
LIVE, EVENT = "rtloop/msg/Live", "rtloop/msg/Event"
DEFINITIONS = {TIME: "int32 sec\nuint32 nanosec\n", EXTREMES: "float64 min\nfloat64 max\nfloat64 last\n"}
EVENT_TEXTS = ("kind", "who", "axis", "what")
LIVE_HEAD = struct.Struct("<iIQQQ")
NS_PER_S = 1_000_000_000


def live_schema(names: Sequence[str]) -> str:
    """Of `live_message`: each signal is its extremes, and its last value."""
    fields = "".join(f"{EXTREMES} {name}\n" for name in names)
    return _schema(f"{TIME} stamp\nuint64 tick\nuint64 ticks\nuint64 lost\n{fields}", TIME, EXTREMES)


def live_message(stamp_ns: int, tick: int, ticks: int, lost: int, extremes: np.ndarray[Any, Any]) -> bytes:
    """The newest tick, how many it is about, how many were lost, and `extremes` (signals, 3): min, max, last."""
    head = LIVE_HEAD.pack(*divmod(stamp_ns, NS_PER_S), tick, ticks, lost)
    return LITTLE_ENDIAN + head + np.ascontiguousarray(extremes, "<f8").tobytes()


def event_schema() -> str:
    """Of `event_message`; `what` is JSON."""
    return _schema(f"{TIME} stamp\nuint64 tick\n" + "".join(f"string {name}\n" for name in EVENT_TEXTS), TIME)


def event_message(stamp_ns: int, tick: int, *texts: str) -> bytes:
    """`texts` are those of EVENT_TEXTS."""
    message = struct.pack("<iIQ", *divmod(stamp_ns, NS_PER_S), tick)
    for text in texts:
        data = text.replace("\0", "").encode() + b"\0"
        message += b"\0" * (-len(message) % 4) + struct.pack("<I", len(data)) + data
    return LITTLE_ENDIAN + message


def _schema(fields: str, *types: str) -> str:
    return fields + "".join(f"{'=' * 80}\nMSG: {name}\n{DEFINITIONS[name]}" for name in types)
