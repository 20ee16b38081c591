"""The response of `/api/panel`: the loop that the page shows."""

from __future__ import annotations

from rtloop.configuration.axis import InterlockOptions, LimitsOptions
from rtloop.panel.feed.tick_history import longest_view_s
from rtloop.panel.service.service import Description


def describe_loop(loop: Description) -> dict[str, object]:
    """Return {name, rate_hz, axes, columns, units, longest_s, defaults: {limits, interlocks}} of a loop.

    `axes` are names, `columns` the signals of a record as {name, unit, meaning}, `units` by signal; the longest screen
    lasts `longest_s`. `defaults` are the default limits and interlocks of an axis.
    """
    return {
        "name": loop.name,
        "rate_hz": loop.rate_hz,
        "axes": list(loop.axes),
        "columns": [column._asdict() for column in loop.columns],
        "units": {column.name: column.unit for column in loop.columns},
        "longest_s": longest_view_s(len(loop.columns), loop.rate_hz),
        "defaults": {"limits": LimitsOptions().model_dump(), "interlocks": InterlockOptions().model_dump()},
    }
