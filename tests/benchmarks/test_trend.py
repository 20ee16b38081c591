"""The trend stores the ratios of the benchmarks, names a ratio that became worse, and draws them."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import pytest

from tests.benchmarks.trend import TrendRow, append, draw, ratios, read, setbacks


def row(figure: str, median: float, spread: float = 0.0, revision: str = "abc") -> TrendRow:
    """Return a row of the trend with a spread around its median."""
    return TrendRow("2026-11-21T02:00:00Z", revision, "a CPU", figure, median, median - spread / 2, median + spread / 2)


def test_ratios_are_kept_and_times_are_not():
    median = {"median": 1.5, "minimum": 1.4, "maximum": 1.7}
    entry = {
        "benchmark": "law", "date": "2026-11-26T02:00:00Z", "revision": "abc", "host": {"cpu": "a CPU", "cpus": 2},
        "results": {
            "ns": median, "ratio": median, "csv": {"times_real_time": median, "bytes_per_tick": 68.0},
            "scaling": 1.8, "p99_ratio": "not measured: no card",
        },
    }  # fmt: skip
    assert ratios(entry) == [
        TrendRow(entry["date"], "abc", "a CPU, 2 processors", "law ratio", 1.5, 1.4, 1.7),
        TrendRow(entry["date"], "abc", "a CPU, 2 processors", "law csv times_real_time", 1.5, 1.4, 1.7),
        TrendRow(entry["date"], "abc", "a CPU, 2 processors", "law scaling", 1.8, 1.8, 1.8),
    ]


@pytest.mark.parametrize(
    ("figure", "median", "spread", "is_named"),
    [
        ("law ratio", 1.11, 0.0, True),  # A ratio of costs rose.
        ("law ratio", 1.09, 0.0, False),
        ("law ratio", 0.5, 0.0, False),
        ("law ratio", 1.3, 0.4, False),  # The change is within the spread.
        ("law ratio", 1.5, 0.4, True),
        ("replay times_real_time", 0.89, 0.0, True),  # A speed fell.
        ("replay times_real_time", 0.91, 0.0, False),
        ("replay times_real_time", 2.0, 0.0, False),
    ],
)
def test_a_ratio_that_is_worse_than_last_time_is_named(figure: str, median: float, spread: float, is_named: bool):
    before = [row(figure, 9.0), row(figure, 1.0, revision="last"), row("other ratio", 0.1)]
    sentences = setbacks(before, [row(figure, median, spread), row("new ratio", 5.0)])
    assert [sentence.split(":")[0] for sentence in sentences] == ([figure] if is_named else [])
    assert all("1 at revision last" in sentence for sentence in sentences)


def test_the_table_grows_and_is_drawn(tmp_path):
    table, picture = tmp_path / "docs" / "history.csv", tmp_path / "docs" / "history.svg"
    assert read(table) == []
    first, second = [row("law ratio", 1.25), row("loop ratio", 1.5)], [row("law ratio", 1.125, 0.25)]
    append(first, table)
    append(second, table)
    assert read(table) == [*first, *second]
    draw(read(table), picture)
    texts = {element.text for element in ET.parse(picture).iter() if element.text}
    assert ET.parse(picture).getroot().tag.endswith("svg")
    assert len(picture.read_bytes()) > 5_000
    assert texts
