"""What an analysis hands on: quantities beside what the paper says and what its model gives, tables, curves, notes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

Range = tuple[float, float]


class Said(NamedTuple):
    """What the paper says of a quantity: its words, and the values that they allow (None: no number is given)."""

    text: str
    allowed: Range | None = None


NOTHING = Said("–")


@dataclass(frozen=True)
class Row:
    """One quantity. `model` is what the paper's printed model gives, which a run may miss by `tolerance`."""

    quantity: str
    unit: str
    run: float
    said: Said = NOTHING
    model: float | None = None
    tolerance: float = 0.0

    @property
    def as_the_paper(self) -> bool | None:
        """Whether the run bears the paper out; None where it gives no number."""
        if self.said.allowed is None or not math.isfinite(self.run):
            return None
        return self.said.allowed[0] <= self.run <= self.said.allowed[1]

    @property
    def as_the_model(self) -> bool | None:
        """Whether the run is as the paper's model; None where there is no such number."""
        if self.model is None or not math.isfinite(self.run):
            return None
        return abs(self.run - self.model) <= self.tolerance

    @property
    def verdict(self) -> str:
        """Both answers in words; a difference is named."""
        if not math.isfinite(self.run):
            return "not to be had from this run"
        off = "" if self.model is None else f"{self.run - self.model:+.3g} {self.unit}".strip()
        words = {
            (True, True): "as the paper says, and its model",
            (True, False): f"as the paper says; its model is off ({off})",
            (True, None): "as the paper says",
            (False, True): "not as the paper says, but as its own model",
            (False, False): f"not as the paper says, nor as its model ({off})",
            (False, None): "not as the paper says",
            (None, True): "as the paper's model",
            (None, False): f"not as the paper's model ({off})",
            (None, None): "",
        }
        return words[self.as_the_paper, self.as_the_model]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "quantity": self.quantity,
            "unit": self.unit,
            "paper": self.said.text,
            "model": self.model,
            "tolerance": self.tolerance if self.model is not None else None,
            "run": self.run,
            "as_the_paper": self.as_the_paper,
            "as_the_model": self.as_the_model,
            "verdict": self.verdict,
        }


@dataclass(frozen=True)
class Table:
    """A table beside the verdicts; every cell is text."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Analysis:
    """What the recordings of one experiment say."""

    rows: Sequence[Row]
    curves: dict[str, Any]
    """For the picture."""
    tables: Sequence[Table] = ()
    notes: Sequence[str] = field(default_factory=list)


def about(value: float, part: float = 0.05) -> Range:
    """What "about `value`" allows."""
    return value - abs(part * value), value + abs(part * value)
