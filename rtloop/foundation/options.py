"""The base of every model of options, and the types of numbers in them: nothing unknown, nothing infinite.

Limits of magnitude are such that products and quotients of options are numbers still.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator

Numbers = Annotated[tuple[float, ...], Field(strict=False)]
Root = Annotated[tuple[float, float], Field(strict=False)]
"""[real part, imaginary part] in rad/s."""
Factor = Annotated[tuple[float, ...], Field(strict=False, min_length=1, max_length=3)]
"""Coefficients of 1, s or s², the highest power first."""


LARGEST, SMALLEST = 1e100, 1e-100
"""Magnitudes of numbers: their products and quotients are numbers still."""
LARGEST_INTEGER = 2**63 - 1


def _nested_numbers(value: Any) -> Iterator[int | float]:
    """All numbers in lists within lists."""
    if isinstance(value, int | float):
        yield value
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _nested_numbers(part)


class Options(BaseModel):
    """Base of all models: every number is one that can be computed with."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _check_magnitudes(cls, value: Any) -> Any:
        """`value`. Raises ValueError for a number that nothing can be computed with."""
        for number in _nested_numbers(value):
            if isinstance(number, int):
                if abs(number) > LARGEST_INTEGER:
                    raise ValueError(f"an integer beyond ±{LARGEST_INTEGER}; smaller ones are allowed")
            elif abs(number) > LARGEST or 0 < abs(number) < SMALLEST:
                raise ValueError(f"{number:g}: 0, and magnitudes from {SMALLEST:g} to {LARGEST:g}, are allowed")
        return value

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """As pydantic's, but without what was computed from the fields as they were."""
        copy = super().model_copy(update=update, deep=deep)
        attributes = vars(copy)
        for name in attributes.keys() - type(self).model_fields.keys():
            del attributes[name]
        return copy

    def _require_unset(self, name: str, value: str, *fields: str) -> None:
        """Raise ValueError for a field that is set although it would be ignored."""
        for field in fields:
            if getattr(self, field) not in ((), None):
                raise ValueError(f"{field} is set, but {name} is {getattr(self, name)!r}: allowed with {value!r} only")
