"""Distributions of uncertain parameters: a number in (0, 1) becomes a value."""

from __future__ import annotations

import math
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from rtloop.foundation.options import Options

Interval = Annotated[tuple[float, float], Field(strict=False)]
KINDS = ("uniform", "log_uniform", "normal", "choice")


class UncertainOptions(Options):
    """Distribution of one key: exactly one of `uniform`, `log_uniform`, `normal` and `choice`."""

    uniform: Interval | None = None
    """Least and largest value, equally likely between them."""
    log_uniform: Interval | None = None
    """Least and largest value, both above 0; the logarithm is equally likely between them."""
    normal: Interval | None = None
    """Mean and standard deviation."""
    limits: Interval | None = None
    """Least and largest value of `normal`, which is cut off beyond them; by default it is not."""
    choice: Annotated[tuple[bool | int | float | str, ...], Field(strict=False, min_length=2)] | None = None
    """Values that are equally likely."""
    relative: bool = False
    """Whether a drawn number multiplies the key's value in the configuration, in place of replacing it."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Return the options; ValueError unless exactly one distribution is set, with numbers that it allows."""
        present = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(present) != 1:
            raise ValueError(f"{', '.join(present) or 'no distribution'}; allowed: exactly one of {', '.join(KINDS)}")
        for name in ("uniform", "log_uniform", "limits"):
            ends = getattr(self, name)
            if ends is not None and not ends[0] < ends[1]:
                raise ValueError(f"{name}: {list(ends)}; allowed: the first number less than the second")
        if self.log_uniform is not None and self.log_uniform[0] <= 0:
            raise ValueError(f"log_uniform: {list(self.log_uniform)}; allowed: numbers above 0")
        if self.normal is not None and self.normal[1] <= 0:
            raise ValueError(f"normal: {list(self.normal)}; allowed: a standard deviation above 0")
        if self.limits is not None and self.normal is None:
            raise ValueError("limits is set without normal; remove limits, or set normal = [mean, deviation]")
        if self.relative and any(isinstance(value, bool | str) for value in self.choice or ()):
            raise ValueError(f"choice: {list(self.choice or ())} with relative = true; allowed: numbers")
        return self

    @property
    def is_numeric(self) -> bool:
        """Whether every value is a number, so that the parameter has a scale on which it can be varied."""
        return not any(isinstance(value, bool | str) for value in self.choice or ())

    def quantile(self, share: float) -> Any:
        """Return the value below which `share`, in (0, 1), of all draws lie; for `choice`, the entry at that share.

        With `relative`, the value is the factor alone. Raises ValueError if `normal` has practically no values between
        `limits`.
        """
        if self.uniform is not None:
            low, high = self.uniform
            return low + share * (high - low)
        if self.log_uniform is not None:
            low, high = map(math.log, self.log_uniform)
            return math.exp(low + share * (high - low))
        if self.normal is not None:
            return self._normal_quantile(*self.normal, share)
        values = self.choice or ()
        return values[min(int(share * len(values)), len(values) - 1)]

    def _normal_quantile(self, mean: float, deviation: float, share: float) -> float:
        """Return the quantile of a normal distribution, cut off beyond `limits` unless these are None.

        Raises ValueError if the distribution has practically no values between them.
        """
        from statistics import NormalDist

        distribution = NormalDist(mean, deviation)
        if self.limits is None:
            return distribution.inv_cdf(share)
        low, high = map(distribution.cdf, self.limits)
        if not high > low:
            raise ValueError(
                f"limits: {list(self.limits)}; normal = {[mean, deviation]} has practically no values between these "
                "limits; use limits nearer to the mean"
            )
        inside = min(max(low + share * (high - low), 1e-300), 1 - 1e-16)
        return min(max(distribution.inv_cdf(inside), self.limits[0]), self.limits[1])
