"""Allowed values of the whole numbers of a record, which kernels use as counts and indices without a check."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

LARGEST = np.iinfo(np.int64).max


class Allowed(NamedTuple):
    """Multiples of `step` from `low` to `high`, both included."""

    low: int
    high: int
    step: int = 1

    def __str__(self) -> str:
        """Return the rule in words, such as "a multiple of 4 from 0 to 128"."""
        steps = f"a multiple of {self.step} from " if self.step > 1 else ""
        return f"{steps}{self.low} to {self.high}"

    def allows(self, value: int) -> bool:
        """Return whether a number is allowed."""
        return self.low <= value <= self.high and value % self.step == 0


class Bits(NamedTuple):
    """Sums of the bits of `mask`."""

    mask: int

    def __str__(self) -> str:
        """Return the rule in words, such as "bits of 0x1f"."""
        return f"bits of {self.mask:#x}"

    def allows(self, value: int) -> bool:
        """Return whether a number has no bits outside the mask."""
        return value & ~self.mask == 0


SWITCH = Allowed(0, 1)
COUNT = Allowed(0, LARGEST)


def require_allowed(owner: str, record: np.void, allowed: Mapping[str, Allowed | Bits]) -> None:
    """Raise ValueError, with field and value, for the first field of a record that breaks its rule in `allowed`.

    `owner` names the record in the message.
    """
    for name, rule in allowed.items():
        for value in np.ravel(record[name]).tolist():  # Most fields hold one number, for which arrays are slow.
            if not rule.allows(value):
                raise ValueError(f"{name} of {owner}: {value}; allowed: {rule}")
