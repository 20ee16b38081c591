"""Every byte of the law's records belongs to a field: copies, comparisons and recordings are of bytes."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.engine.messages import MESSAGE
from rtloop.kernel.layout import COEFFICIENTS, CONTROL, LOOP_STATE, STATE
from rtloop.kernel.memory import new_records
from rtloop.kernel.reference import GENERATOR, Generator
from rtloop.laws.shipped import prandtl_ishlinskii, transfer

RECORDS = [
    *(COEFFICIENTS, STATE, LOOP_STATE, CONTROL, GENERATOR, MESSAGE),
    *(record for law in (prandtl_ishlinskii, transfer) for record in (law.COEFFICIENTS, law.STATE)),
]


@pytest.mark.parametrize("record", RECORDS)
def test_every_byte_belongs_to_one_field(record):
    owners = np.zeros(record.itemsize, int)
    for field in record.names:
        kind, offset = record.fields[field][:2]
        owners[offset : offset + kind.itemsize] += 1
    assert np.all(owners == 1), np.flatnonzero(owners != 1)


def test_kinds_of_generators_are_numbered_as_they_are_recorded():
    assert {kind.name: int(kind) for kind in Generator} == {
        "HOLD": 0, "TABLE": 1, "SINE": 2, "TRIANGLE": 3, "CHIRP": 4, "INPUT": 5
    }  # fmt: skip


def test_records_begin_at_a_cache_line():
    """Records begin at multiples of 64 bytes, wherever numpy allocates them: loads touch the fewest cache lines."""
    arrays = [new_records(CONTROL, count) for count in range(1, 40)]
    assert {array.ctypes.data % 64 for array in arrays} == {0}
    assert [array.size for array in arrays] == list(range(1, 40))
