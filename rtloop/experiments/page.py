"""The report as one self-contained HTML page: verdicts, pictures, tables, links to the recordings. No script."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from rtloop.values import render_page

HEADINGS = {"asked": "required", "claimed": "claimed", "model": "the model gives"}


def render_report(content: Mapping[str, Any], pictures: Mapping[str, Mapping[str, bytes]], links: Mapping[str, str],
         skipped: Mapping[str, str]) -> str:  # fmt: skip
    """Return the `content` of a Report as one HTML page.

    `pictures` are PNG bytes by experiment and theme, "light" or "dark": dark screens show the dark one, other screens
    and paper the light one. `links` are the recordings' paths relative to the page, by file name; `skipped` are the
    reasons why experiments were not done, by the experiment's name.
    """
    return render_page(
        __package__,
        title=f"{content['name']}: experiments",
        when=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(content["created_unix_ns"] / 1e9)),
        content=content, pictures=pictures, links=links, skipped=skipped, headings=HEADINGS,
        compared=comparison_keys, compared_cell=comparison_cell, beside_cell=second_value_cell, number=format_number,
    )  # fmt: skip


def comparison_keys(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Return the keys of HEADINGS, in the order of HEADINGS, for which any row has a value other than None."""
    return [key for key in HEADINGS if any(row[key] is not None for row in rows)]


def comparison_cell(row: Mapping[str, Any], key: str) -> str:
    """Return the text of a row's cell in column `key` of HEADINGS, for "model" with the tolerance; "–" for None."""
    value = row[key]
    return "–" if value is None else f"{format_number(value)} ± {row['tolerance']:.2g}" if key == "model" else value


def second_value_cell(row: Mapping[str, Any]) -> str:
    """Return as text, with its unit, the row's value for the second configuration (`--beside`); "–" without a value."""
    value, unit = row["beside"], "" if row["unit"] == "1" else f" {row['unit']}"
    return "–" if value is None else format_number(value) + unit


def format_number(value: float) -> str:
    """Return a number as text with at most five significant digits."""
    return f"{value:.5g}"
