"""Ranges in V that options of drivers state for channels of one kind."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

Volts = Annotated[tuple[float, float], Field(strict=False)]
"""Lower and upper end of a range in V."""


def require_ranges(input_range_v: Volts, output_range_v: Volts, safe_v: float) -> None:
    """Raise ValueError, which names the option, for an empty or reversed range or `safe_v` outside the output range."""
    for name, (lowest, highest) in (("input_range_v", input_range_v), ("output_range_v", output_range_v)):
        if lowest >= highest:
            raise ValueError(f"{name}: [{lowest:g}, {highest:g}] V; allowed: the lower end before the higher")
    lowest, highest = output_range_v
    if not lowest <= safe_v <= highest:
        raise ValueError(f"safe_v: {safe_v:g} V; allowed by output_range_v: {lowest:g} … {highest:g} V")
