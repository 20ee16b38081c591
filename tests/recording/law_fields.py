"""The fields of a snapshot of the law, and whole numbers to put into them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rtloop.kernel.layout import COEFFICIENTS, LOOP_STATE, STATE
from rtloop.laws.shipped import prandtl_ishlinskii, transfer

INTEGERS = (-(2**63), -(2**31), -129, -2, -1, 0, 1, 2, 3, 4, 5, 25, 65, 129, 255, 4_000, 2**31, 2**62, 2**63 - 1)


class Field(NamedTuple):
    """A field of a snapshot: name `OWNER.FIELD`, type, offset in bytes."""

    name: str
    dtype: np.dtype[Any]
    start: int


def snapshot_fields(axes: Sequence[str]) -> list[Field]:
    """Return all fields of a snapshot: the tick, then the fields of the law's records and of the loop's record."""
    offset, fields = 8, [Field("tick", np.dtype("<u8"), 0)]
    laws = prandtl_ishlinskii, transfer
    coefficients, state = (COEFFICIENTS, *(law.COEFFICIENTS for law in laws)), (STATE, *(law.STATE for law in laws))
    tables = [(axis, table) for part in (coefficients, state) for axis in axes for table in part]
    for owner, table in [*tables, ("loop", LOOP_STATE)]:
        for name, (dtype, start, *_) in (table.fields or {}).items():
            fields.append(Field(f"{owner}.{name}", dtype, offset + start))
        offset += table.itemsize
    return fields
