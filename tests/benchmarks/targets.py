"""Targets of the figures, by the benchmark and the names in its results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple


class Target(NamedTuple):
    """A limit of a figure: a maximum, or a minimum if `is_maximum` is False."""

    value: float
    is_maximum: bool = True

    def is_met(self, figure: float) -> bool:
        """Return whether a figure keeps the limit."""
        return figure <= self.value if self.is_maximum else figure >= self.value

    def __str__(self) -> str:
        return f"{'≤' if self.is_maximum else '≥'} {self.value:g}"


TARGETS = {
    "law ratio": Target(1.1),
    "loop ratio": Target(1.2),
    "loop times_real_time": Target(700.0, is_maximum=False),
    "recorded times_real_time": Target(200.0, is_maximum=False),
    "axes ns_per_further_axis": Target(70.0),
    "start to_first_tick_s": Target(0.9),
    "lateness sleeping p50_ratio": Target(1.05),
    "lateness sleeping p99_ratio": Target(1.1),
    "lateness spinning p50_ratio": Target(0.05),
    "latency sleeping read_to_write_us": Target(0.3),
    "latency spinning read_to_write_us": Target(0.3),
    "node next_tick ratio": Target(1.2),
    "node same_tick ratio": Target(1.2),
    "node same_tick apart_from_wait_us": Target(2.0),
    "overhead engine_ns": Target(40.0),
    "linear times_faster_than_forced_response": Target(20.0, is_maximum=False),
    "linear times_faster_than_dlsim": Target(20.0, is_maximum=False),
    "recorder cpu_percent": Target(1.0),
    "recorder bytes_per_tick": Target(68.0),
    "writers foxglove cpu_ratio": Target(1.0),
    "writers mcap cpu_ratio": Target(1.0),
    "writers h5py_lzf cpu_ratio": Target(1.0),
    "replay one_process times_real_time": Target(120.0, is_maximum=False),
    "replay two_processes times_real_time": Target(220.0, is_maximum=False),
    "replay scaling": Target(1.7, is_maximum=False),
    "export csv times_real_time": Target(60.0, is_maximum=False),
    "rates sim spinning overrun_hz": Target(100_000.0, is_maximum=False),
}


class Figure(NamedTuple):
    """Row of a table: name, value (or the reason for a missing value), range over the repetitions, target."""

    name: str
    value: float | str
    low: float | None
    high: float | None
    target: Target | None

    @property
    def verdict(self) -> str:
        """The target, and "met" or "MISSED"; an empty text without a target."""
        if self.target is None or isinstance(self.value, str):
            return ""
        return f"{self.target} {'met' if self.target.is_met(self.value) else 'MISSED'}"


def figures(benchmark: str, results: Mapping[str, Any]) -> list[Figure]:
    """Return the figures of a benchmark's results, in their order."""
    return [Figure(name, *value, TARGETS.get(f"{benchmark} {name}")) for name, value in _leaves(results)]


def _leaves(results: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, tuple[Any, Any, Any]]]:
    """Yield (name, (median, minimum, maximum)) of each spread in nested results, and (name, (value, None, None))."""
    for name, value in results.items():
        if isinstance(value, Mapping) and "median" in value:
            yield prefix + name, (value["median"], value["minimum"], value["maximum"])
        elif isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name} ")
        else:
            yield prefix + name, (value, None, None)


def number(value: float) -> str:
    """Return a number as text with four digits, without an exponent."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
