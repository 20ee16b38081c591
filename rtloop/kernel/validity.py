"""Allowed values of the whole numbers of a record, which kernels use as counts and indices without a check."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

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

    def faults(self, values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Return which of `values` are not allowed, as booleans of their shape."""
        return (values < self.low) | (values > self.high) | (values % self.step != 0)


class Bits(NamedTuple):
    """Sums of the bits of `mask`."""

    mask: int

    def __str__(self) -> str:
        """Return the rule in words, such as "bits of 0x1f"."""
        return f"bits of {self.mask:#x}"

    def faults(self, values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Return which of `values` have bits outside the mask, as booleans of their shape."""
        return (values & ~self.mask) != 0


SWITCH = Allowed(0, 1)
COUNT = Allowed(0, LARGEST)


def require_allowed(owner: str, record: Any, allowed: Mapping[str, Allowed | Bits]) -> None:
    """Raise ValueError, with field and value, for the first field of a record that breaks its rule in `allowed`.

    `owner` names the record in the message.
    """
    for name, rule in allowed.items():
        values = np.atleast_1d(record[name])
        faults = rule.faults(values)
        if faults.any():
            raise ValueError(f"{name} of {owner}: {int(values[faults][0])}; allowed: {rule}")
