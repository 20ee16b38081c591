"""What a page is told of the loop that it shows."""

from __future__ import annotations

from typing import Any

from rtloop.configuration.axis import InterlockOptions, LimitsOptions
from rtloop.panel.views.link import Description
from rtloop.panel.views.past import longest_s


def loop_for_pages(loop: Description) -> dict[str, Any]:
    """Name, rate, signals with units, the longest screen, and the limits of each axis as they are configured."""
    return {
        "name": loop.name,
        "rate_hz": loop.rate_hz,
        "axes": list(loop.axes),
        "columns": [column._asdict() for column in loop.columns],
        "units": {column.name: column.unit for column in loop.columns},
        "longest_s": longest_s(len(loop.columns), loop.rate_hz),
        "limits": {name: _limits(axis) for name, axis in loop.axes.items()},
    }


def _limits(axis: dict[str, Any]) -> dict[str, float]:
    """As configured, or by default."""
    limits = LimitsOptions.model_validate(axis.get("limits") or {})
    interlocks = InterlockOptions.model_validate(axis.get("interlocks") or {})
    return {
        "drive_v": limits.drive_v,
        "lowest_v": limits.lowest_v,
        "command_um": limits.command_um,
        "position_um": interlocks.position_um,
    }
