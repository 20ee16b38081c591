"""The uncompiled law on forged snapshots: numpy raises if compiled kernels would write outside an array.

Run it as a module with NUMBA_DISABLE_JIT=1 and a good snapshot of one axis on stdin. It prints the numbers of accepted
and refused snapshots, and how many of each reach beyond an array without the validation.
"""

from __future__ import annotations

import json
import sys
from unittest.mock import DEFAULT, patch

import numpy as np

from rtloop.configuration.laws import DEFAULT_LAWS
from rtloop.foundation.native import uncompiled
from rtloop.kernel import memory
from rtloop.kernel.layout import CONDITIONS
from rtloop.kernel.memory import LawMemory, new_records
from rtloop.kernel.step import evaluate, update
from rtloop.laws.binding import bind_functions
from rtloop.laws.registry import law_layout
from rtloop.signals import Mode
from tests.recording.law_fields import INTEGERS, snapshot_fields

TICKS, SEED, TRIES = 2, 3, 400
LAYOUT, FUNCTIONS = law_layout(DEFAULT_LAWS), bind_functions(DEFAULT_LAWS)


def reaches_beyond(data: bytes, axes: int) -> bool:
    """Return whether the law, run from an unvalidated snapshot, reaches beyond its arrays."""
    unchecked = {"require_owners": DEFAULT, "require_allowed": DEFAULT}
    with patch.object(memory.Layout, "require_allowed_axis"), patch.multiple(memory, **unchecked):
        _, *arrays = LAYOUT.split_snapshot(data, axes)
    numbers = arrays[0][["feedforward_law", "controller_law", "controller_axes"]].tolist()
    if numbers != [(0, 1, 1)] * axes:
        return True  # A missing function, or one of the other kind.
    law = LawMemory(LAYOUT, FUNCTIONS, *arrays)
    uncompiled.raised_exceptions.clear()
    law.state.mode = Mode.CLOSED_LOOP
    conditions = new_records(CONDITIONS, 1)[0]
    try:
        with np.errstate(all="ignore"):
            for _ in range(TICKS):
                evaluate(law.law, np.zeros(axes), np.ones(axes), np.zeros(axes), conditions)
                update(law.law)
    except IndexError:
        return True
    return any(isinstance(error, IndexError) for error in uncompiled.raised_exceptions)


def is_accepted(data: bytes, axes: int) -> bool:
    """Return whether a snapshot passes the validation."""
    try:
        LAYOUT.split_snapshot(data, axes)
    except ValueError:
        return False
    return True


def main() -> None:
    """Replace whole numbers of the snapshot on stdin, one at a time, and print the counts of outcomes."""
    random, counts = np.random.default_rng(SEED), {"accepted": 0, "refused": 0}
    beyond = {"accepted": 0, "refused": 0}
    snapshot = sys.stdin.buffer.read()
    fields = [field for field in snapshot_fields(["x"]) if field.dtype.base.kind in "iu"]
    for number in range(TRIES):
        data = bytearray(snapshot)
        _, dtype, start = fields[number % len(fields)]
        start += int(random.integers(max(int(np.prod(dtype.shape)), 1))) * dtype.base.itemsize
        value = np.array(INTEGERS[int(random.integers(len(INTEGERS)))]) if number % 3 else np.array(random.integers(5))
        data[start : start + dtype.base.itemsize] = value.astype(dtype.base).tobytes()
        kind = "accepted" if is_accepted(bytes(data), 1) else "refused"
        counts[kind] += 1
        beyond[kind] += reaches_beyond(bytes(data), 1)
    print(json.dumps({**counts, **{f"{kind}, out of range": count for kind, count in beyond.items()}}))


if __name__ == "__main__":
    main()
