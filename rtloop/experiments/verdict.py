"""Result of an analysis: quantities with limit, claim and model, tables, curves, notes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from rtloop.design.synthesis.specification import ClaimOptions
from rtloop.design.verification.judgement import Limit

Curves = TypeVar("Curves", bound=Mapping[str, object])


@dataclass(frozen=True)
class Row:
    """Quantity of a run, with its verdict.

    `limit` and `claim` are from the axis's specification. `model` is the value by the configuration's own models, which
    a run may miss by `tolerance`.
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
        """Whether the limit is met; None without a limit, and for a quantity that the run did not show (NaN)."""
        return None if self.limit is None or math.isnan(self.run) else bool(self.limit.accepts(self.run))

    @property
    def is_as_claimed(self) -> bool | None:
        """Whether the claim holds; None without a claim in numbers, and for a value that is not finite."""
        if self.claim is None or not self.claim.is_number or not math.isfinite(self.run):
            return None
        return bool(self.claim.is_borne_out(self.run))

    @property
    def is_as_modelled(self) -> bool | None:
        """Whether the run agrees with the model; None without a finite value of both."""
        if self.model is None or not math.isfinite(self.run) or not math.isfinite(self.model):
            return None
        return bool(abs(self.run - self.model) <= self.tolerance)

    @property
    def limit_text(self) -> str:
        """The limit as text, such as "≤ 5 ms"; "" without a limit."""
        if self.limit is None:
            return ""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{'≤' if self.limit.at_most else '≥'} {self.limit.value:.5g}{unit}"

    @property
    def verdict(self) -> str:
        """Whether the requirement, the claim and the model are met, as text; a difference to the model is named.

        "" without any of these; "no value in this run" for a value that is not finite.
        """
        if not math.isfinite(self.run):
            return "no value in this run"
        difference = "" if self.model is None else f"{self.run - self.model:+.3g} {self.unit.removeprefix('1')}".strip()
        answers = (
            (self.is_met, "meets the requirement", "MISSES the requirement"),
            (self.is_as_claimed, "as claimed", "not as claimed"),
            (self.is_as_modelled, "as the model", f"off the model by {difference}"),
        )
        return ", ".join(yes_text if answer else no_text for answer, yes_text, no_text in answers if answer is not None)

    @property
    def mark(self) -> str:
        """Return "good" if limit, claim and model agree with the run, "bad" if the limit is missed, else "mixed".

        A limit, claim or model counts only where the row can judge it; "" without any.
        """
        answers = [answer for answer in (self.is_met, self.is_as_claimed, self.is_as_modelled) if answer is not None]
        if not answers:
            return ""
        return "bad" if self.is_met is False else "good" if all(answers) else "mixed"

    def as_dict(self) -> dict[str, object]:
        """Return the row and its judgements by key; `run` and `model` may be NaN or infinite.

        Keys: quantity, unit, asked (the limit as text), claimed (the claim's words), model, tolerance, run, met,
        as_claimed, as_the_model, verdict, mark. A value that does not exist is None.
        """
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
class Analysis(Generic[Curves]):
    """Results of one experiment's recordings."""

    rows: Sequence[Row]
    curves: Curves
    """Curves of the picture, by name."""
    tables: Sequence[Table] = ()
    notes: Sequence[str] = field(default_factory=list)
