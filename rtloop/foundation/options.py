"""The base of all models of options: unknown keys, infinities and numbers of extreme magnitude are refused.

The limits of magnitude leave products and quotients of options finite and above 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator

Numbers = Annotated[tuple[float, ...], Field(strict=False)]
Root = Annotated[tuple[float, float], Field(strict=False)]
"""[real part, imaginary part] in rad/s."""
Factor = Annotated[tuple[float, ...], Field(strict=False, min_length=1, max_length=3)]
"""Coefficients of 1, s or s², the highest power first."""
AnyKind = BeforeValidator(lambda table: {"kind": "", **table} if isinstance(table, Mapping) else table)
"""Validator before a union by `kind`: a table without a kind gets the kind "", whose error lists the allowed ones."""


LARGEST, SMALLEST = 1e100, 1e-100
"""Largest and smallest allowed magnitude of a number other than 0."""
LARGEST_INTEGER = 2**63 - 1


def _nested_numbers(value: object) -> Iterator[int | float]:
    """Yield the numbers of a value, True and False included: itself, or those in its nested lists and tuples.

    All else is ignored.
    """
    if isinstance(value, int | float):
        yield value
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _nested_numbers(part)


class Options(BaseModel):
    """Base of all models of options; immutable, without unknown keys, with numbers of bounded magnitude."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    @field_validator("*")
    @classmethod
    def _check_magnitudes(cls, value: Any) -> Any:
        """Return `value` unchanged.

        Raises ValueError for a number, alone or in lists, with a magnitude above LARGEST or, other than 0, below
        SMALLEST, and for an integer beyond ±LARGEST_INTEGER.
        """
        for number in _nested_numbers(value):
            if isinstance(number, int):
                if abs(number) > LARGEST_INTEGER:
                    raise ValueError(f"an integer is out of range; allowed: integers within ±{LARGEST_INTEGER}")
            elif abs(number) > LARGEST or 0 < abs(number) < SMALLEST:
                element = "" if number is value else f"{number:g} in the list: "
                raise ValueError(f"{element}must be 0 or of a magnitude from {SMALLEST:g} to {LARGEST:g}")
        return value

    @classmethod
    def of_absent_table(cls) -> Self:
        """Return the options of a table that a file lacks: the defaults, without building the model's validator.

        Use it for the default of a field whose type is a model. Every option of the model must have a default: one
        without would be missing in the result, with no error here.
        """
        return cls.model_construct()

    def model_copy(self, *, update: Mapping[str, object] | None = None, deep: bool = False) -> Self:
        """Return a copy as pydantic does, without the cached properties of the original; `update` is not validated."""
        copy = super().model_copy(update=update, deep=deep)
        attributes = vars(copy)
        for name in attributes.keys() - type(self).model_fields.keys():
            del attributes[name]
        return copy

    def _require_unset(self, name: str, value: str, *fields: str) -> None:
        """Raise ValueError for the first of `fields` that is neither () nor None, and so set without effect.

        The message asks for `value` in field `name`, which would use it; the present value of `name` is not checked.
        """
        for field in fields:
            if getattr(self, field) not in ((), None):
                current = getattr(self, name)
                raise ValueError(
                    f"{field} is set, but {name} is {current!r}; remove {field}, or set {name} = {value!r}"
                )
