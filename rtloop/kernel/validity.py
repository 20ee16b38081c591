"""What the whole numbers of a record may be: the kernels use them as counts and indices and check none of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

LARGEST = np.iinfo(np.int64).max


class Allowed(NamedTuple):
    """Whole numbers from `low` to `high`, in steps of `step` from 0."""

    low: int
    high: int
    step: int = 1

    def __str__(self) -> str:
        steps = f"a multiple of {self.step} from " if self.step > 1 else ""
        return f"{steps}{self.low} to {self.high}"

    def faults(self, values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Where `values` are something else."""
        return (values < self.low) | (values > self.high) | (values % self.step != 0)


class Bits(NamedTuple):
    """Sums of the bits of `mask`."""

    mask: int

    def __str__(self) -> str:
        return f"bits of {self.mask:#x}"

    def faults(self, values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Where `values` have others."""
        return (values & ~self.mask) != 0


SWITCH = Allowed(0, 1)
COUNT = Allowed(0, LARGEST)


def require_allowed(owner: str, record: Any, allowed: Mapping[str, Allowed | Bits]) -> None:
    """Raise ValueError for the first field of one record whose value, or one of them, is not allowed."""
    for name, rule in allowed.items():
        values = np.atleast_1d(record[name])
        faults = rule.faults(values)
        if faults.any():
            raise ValueError(f"{name} of {owner}: {int(values[faults][0])}; {rule} is allowed")
