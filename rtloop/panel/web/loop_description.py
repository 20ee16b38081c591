"""What a page is told of the loop that it shows."""

from __future__ import annotations

from typing import Any

from rtloop.configuration.axis import InterlockOptions, LimitsOptions
from rtloop.panel.views.service import Description
from rtloop.panel.views.tick_history import longest_view_s


def describe_loop(loop: Description) -> dict[str, Any]:
    """Name, rate, signals with units, the longest screen, and what limits and interlocks are where nothing is said."""
    return {
        "name": loop.name,
        "rate_hz": loop.rate_hz,
        "axes": list(loop.axes),
        "columns": [column._asdict() for column in loop.columns],
        "units": {column.name: column.unit for column in loop.columns},
        "longest_s": longest_view_s(len(loop.columns), loop.rate_hz),
        "defaults": {"limits": LimitsOptions().model_dump(), "interlocks": InterlockOptions().model_dump()},
    }
