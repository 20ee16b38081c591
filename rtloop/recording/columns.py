"""Unit and meaning of a recorded signal, by its name."""

from __future__ import annotations

from rtloop.signals import AXIS_SIGNALS, COMMON_SIGNALS, Signal

SUFFIX_UNITS = {"um": "µm", "v": "V", "us": "µs", "ns": "ns", "s": "s", "hz": "Hz"}


def signal_unit(name: str) -> str:
    """Unit of a signal by its definition or, if rtloop does not define it, by the end of its name; "" if unknown."""
    return describe_signal(name).unit


def describe_signal(name: str) -> Signal:
    """Return name, unit and meaning of a signal by its name; an axis's meaning begins with the axis's name.

    For a name that rtloop does not define, the meaning is "", and the name's end gives the unit (`_um`: µm), or "".
    """
    for signal in COMMON_SIGNALS:
        if name == signal.name:
            return signal
    for signal in AXIS_SIGNALS:
        if name.endswith(f"_{signal.name}"):
            return Signal(name, signal.unit, f"{name.removesuffix(f'_{signal.name}')}: {signal.meaning}")
    return Signal(name, SUFFIX_UNITS.get(name.rpartition("_")[2], ""), "")
