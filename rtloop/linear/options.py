"""Options of a transfer function in the configuration."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from rtloop.foundation.options import Factor, Numbers, Options, Root
from rtloop.linear.transfer import Transfer

Matrix = Annotated[tuple[Numbers, ...], Field(strict=False)]


class TransferOptions(Options):
    """A transfer function in s (rad/s): factors, zeros and poles, two polynomials, or a state space.

    `numerator` and `denominator` are coefficients, highest power first, for "factors" a list of such lists; `zeros` and
    `poles` are pairs [real, imaginary], `a` is a list of rows.
    """

    form: Literal["factors", "zpk", "transfer_function", "state_space"] = "factors"
    """Notation of the transfer function; each form takes its own keys alone."""
    gain: float | None = None
    """Factor on the whole function, with the forms "factors" and "zpk", where it is required; it is not the gain at 0
    Hz."""
    numerator: Annotated[tuple[Factor | float, ...], Field(strict=False)] = ()
    """Factors of the numerator such as [1, 2, 500] for s² + 2 s + 500; with the form "transfer_function", its
    coefficients."""
    denominator: Annotated[tuple[Factor | float, ...], Field(strict=False)] = ()
    """Factors of the denominator, as for `numerator`."""
    zeros: Annotated[tuple[Root, ...], Field(strict=False)] = ()
    """Zeros in rad/s, each as [real, imaginary], with the form "zpk"."""
    poles: Annotated[tuple[Root, ...], Field(strict=False)] = ()
    """Poles in rad/s, each as [real, imaginary], with the form "zpk"."""
    a: Matrix = ()
    """Matrix A of the state space x' = A x + b u, y = c x + d u, a list of rows, with the form "state_space"."""
    b: Numbers = ()
    """Column b of the state space, a number for each state."""
    c: Numbers = ()
    """Row c of the state space, a number for each state."""
    d: float | None = None
    """Direct feedthrough of the state space, 0 for none; required with the form "state_space"."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Return the options unchanged.

        Raises ValueError for a key that `form` does not take, for a missing `gain` or `d`, and for values that make no
        proper transfer function.
        """
        allowed = {
            "factors": {"gain", "numerator", "denominator"},
            "zpk": {"gain", "zeros", "poles"},
            "transfer_function": {"numerator", "denominator"},
            "state_space": {"a", "b", "c", "d"},
        }
        parts = set().union(*allowed.values())
        foreign = sorted((self.model_fields_set & parts) - allowed[self.form])
        if foreign:
            raise ValueError(
                f"{', '.join(foreign)}: not part of form {self.form!r}; allowed: "
                f"{', '.join(sorted(allowed[self.form]))}"
            )
        self.transfer()
        return self

    def transfer(self) -> Transfer:
        """Return the transfer function of the options, computed once."""
        return self._transfer

    @cached_property
    def _transfer(self) -> Transfer:
        """The transfer function, computed when the options are validated.

        Raises ValueError for a missing `gain` or `d`, for lists of another depth than `form` takes, and in the cases of
        `Transfer`.
        """
        if self.form == "zpk":
            zeros, poles = ([complex(*root) for root in group] for group in (self.zeros, self.poles))
            return Transfer.from_zpk(zeros, poles, self._gain())
        if self.form == "state_space":
            if self.d is None:
                raise ValueError("d: missing; form 'state_space' needs d (0.0 if there is no direct feedthrough)")
            return Transfer.from_state_space(np.array(self.a), self.b, self.c, self.d)
        nested = [isinstance(part, tuple) for part in (*self.numerator, *self.denominator)]
        if self.form == "transfer_function":
            if any(nested):
                raise ValueError(
                    "numerator, denominator: nested lists; allowed in form 'transfer_function': "
                    "one list of numbers for each"
                )
            return Transfer.from_transfer_function(self.numerator, self.denominator)
        if not all(nested):
            raise ValueError(
                "numerator, denominator: a list of numbers; allowed in form 'factors': lists of factors, such as "
                "[[1, 30], [1, 2, 500]] for (s + 30)(s² + 2 s + 500)"
            )
        return Transfer.from_factors(self._gain(), self.numerator, self.denominator)

    def _gain(self) -> float:
        """Return `gain`. Raises ValueError if it is not set."""
        if self.gain is None:
            raise ValueError(f"gain: missing; form {self.form!r} needs a gain")
        return self.gain
