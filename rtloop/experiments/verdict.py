"""What an analysis hands on: quantities beside what is asked, claimed and modelled, tables, curves, notes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from rtloop.design.synthesis.specification import ClaimOptions
from rtloop.design.verification.judgement import Limit


@dataclass(frozen=True)
class Row:
    """One quantity as a run gave it.

    `limit` and `claim` are of the specification that the axis names. `model` is what the configuration's own models
    give, which a run may miss by `tolerance`.
    """

    quantity: str
    unit: str
    run: float
    model: float | None = None
    tolerance: float = 0.0
    limit: Limit | None = None
    claim: ClaimOptions | None = None

    @property
    def is_met(self) -> bool | None:
        """Whether what is asked is met; None where nothing is asked, or the run did not show the quantity (NaN)."""
        return None if self.limit is None or math.isnan(self.run) else bool(self.limit.accepts(self.run))

    @property
    def is_as_claimed(self) -> bool | None:
        """Whether the claim is borne out; None where there is none, or none with a number."""
        if self.claim is None or not self.claim.is_number or not math.isfinite(self.run):
            return None
        return bool(self.claim.is_borne_out(self.run))

    @property
    def is_as_modelled(self) -> bool | None:
        """Whether the run is as the model; None where that says nothing."""
        if self.model is None or not math.isfinite(self.run) or not math.isfinite(self.model):
            return None
        return bool(abs(self.run - self.model) <= self.tolerance)

    @property
    def limit_text(self) -> str:
        """The limit in words."""
        if self.limit is None:
            return ""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{'≤' if self.limit.at_most else '≥'} {self.limit.value:.5g}{unit}"

    @property
    def verdict(self) -> str:
        """The answers in words; a difference is named."""
        if not math.isfinite(self.run):
            return "not to be had from this run"
        difference = "" if self.model is None else f"{self.run - self.model:+.3g} {self.unit.removeprefix('1')}".strip()
        answers = (
            (self.is_met, "meets what is asked", "MISSES what is asked"),
            (self.is_as_claimed, "as claimed", "not as claimed"),
            (self.is_as_modelled, "as the model", f"off the model by {difference}"),
        )
        return ", ".join(yes_text if answer else no_text for answer, yes_text, no_text in answers if answer is not None)

    @property
    def mark(self) -> str:
        """good: every answer is yes; bad: what is asked is missed; mixed: another is no; empty where none is given."""
        answers = [answer for answer in (self.is_met, self.is_as_claimed, self.is_as_modelled) if answer is not None]
        if not answers:
            return ""
        return "bad" if self.is_met is False else "good" if all(answers) else "mixed"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "quantity": self.quantity,
            "unit": self.unit,
            "asked": self.limit_text or None,
            "claimed": self.claim.says if self.claim else None,
            "model": self.model,
            "tolerance": self.tolerance if self.model is not None else None,
            "run": self.run,
            "met": self.is_met,
            "as_claimed": self.is_as_claimed,
            "as_the_model": self.is_as_modelled,
            "verdict": self.verdict,
            "mark": self.mark,
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
