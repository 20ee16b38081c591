"""Find the first field in which two snapshots of the law differ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rtloop.kernel.layout import LOOP_STATE, Records
from rtloop.kernel.memory import LawMemory, RecordKind, field_tables


def first_difference(
    recorded: bytes, replayed: bytes, axes: Sequence[str], law: LawMemory
) -> tuple[str, object, object]:
    """Return (field, recorded value, replayed value) of the first difference; (text, None, None) outside all fields.

    The field is law.AXIS.NAME or law.loop.NAME, with [index] for an element of an array; the values are numbers.
    `recorded` and `replayed` are the bytes of two different snapshots without their tick.
    """
    for name, dtype, start in _snapshot_fields(axes, law):
        parts = [data[start : start + dtype.itemsize] for data in (recorded, replayed)]
        if parts[0] != parts[1]:
            values = [np.frombuffer(part, dtype.base) for part in parts]
            pairs = list(zip(*values, strict=True))
            index = next(
                i
                for i, (recorded_value, replayed_value) in enumerate(pairs)
                if recorded_value.tobytes() != replayed_value.tobytes()
            )
            place = name if len(pairs) == 1 else f"{name}[{index}]"
            return place, pairs[index][0].item(), pairs[index][1].item()
    return "bytes of the law that belong to no field", None, None


def _snapshot_fields(axes: Sequence[str], law: LawMemory) -> Iterator[tuple[str, np.dtype[np.generic], int]]:
    """Yield name, type and offset in bytes of every field, in the order of a snapshot without its tick."""
    offset = 0
    tables: tuple[tuple[RecordKind, Records], ...] = (("coefficients", law.coefficients), ("state", law.axes))
    for record_kind, records in tables:
        for axis, axis_fields in zip(axes, field_tables(law.layout, law.coefficients, record_kind), strict=True):
            for name, dtype, start in axis_fields:
                yield f"law.{axis}.{name}", dtype, offset + start
            offset += records.itemsize
    for name, (dtype, start, *_) in (LOOP_STATE.fields or {}).items():
        yield f"law.loop.{name}", dtype, offset + start
