"""A verification in words: the cells that the terminal and the page show alike. No numbers are made here."""

from __future__ import annotations

import math

from rtloop.analysis.perturbation import Range
from rtloop.design.verification.judgement import Limit
from rtloop.design.verification.verify import Row, Verification

HEADINGS = ("", "required", "continuous C(s)", "", "as it runs C(z)", "", "its source says")
ROBUSTNESS_HEADINGS = (
    "may move by", "continuous, until unstable", "as it runs, until unstable", "until what is met is missed",
)  # fmt: skip
SHIFT_NAMES = {"resonance": "resonance, frequency", "damping": "resonance, damping", "gain": "gain, hysteresis weights"}
NOTE = "Gain stands for D(0), the sensor's scale and all hysteresis weights together."


def table(found: Verification) -> list[tuple[str, ...]]:
    """A row for each quantity: label, required, achieved and verdict twice, claim."""
    stable = tuple("yes" if loop.is_stable else "NO" for loop in (found.continuous, found.running))
    first = ("stable", "yes", stable[0], verdict(stable[0] == "yes"), stable[1], verdict(stable[1] == "yes"), "")
    return [first, *(_cells(row) for row in found.rows)]


def _cells(row: Row) -> tuple[str, ...]:
    return (
        row.label, required(row), _with_unit(row, row.continuous), verdict(row.met(row.continuous)),
        _with_unit(row, row.running), verdict(row.met(row.running)), row.claim,
    )  # fmt: skip


def required(row: Row) -> str:
    """ "≤ 0.1 %", "everywhere", or nothing."""
    limit: Limit | None = row.limit
    if limit is None:
        return ""
    if math.isinf(limit.value):
        return "everywhere"
    return f"{'≤' if limit.at_most else '≥'} {number(limit.value)} {row.unit}".rstrip()


def verdict(met: bool | None) -> str:
    """One word."""
    return "" if met is None else "met" if met else "MISSED"


def number(value: float | None) -> str:
    """Six digits at most."""
    if value is None:
        return ""
    if math.isnan(value):
        return "–"
    return "no limit" if math.isinf(value) else f"{value:.6g}"


def _with_unit(row: Row, value: float | None) -> str:
    text = number(value)
    return f"{text} {row.unit}".rstrip() if text not in ("", "–", "no limit") else text


def robustness(found: Verification) -> list[tuple[str, ...]]:
    """A row for each thing that may move: until unstable twice, until missed."""
    rows = [
        (SHIFT_NAMES[name], *(span(ranges[which]) for which in ("continuous", "running", "running_missed")))
        for name, ranges in found.robustness.ranges.items()
    ]
    delay = f"+{number(found.robustness.delay_us)} µs", f"+{found.robustness.delay_ticks} samples"
    return [*rows, ("delay", *(delay if found.continuous.is_stable else ("–", "–")), "")]


def shifts(found: Verification) -> list[tuple[str, str]]:
    """The shift of the resonance that is tolerated: in continuous time, and as it runs with more and more delay."""
    rate = 1 / found.running.period_s if found.running.period_s else 0.0
    names = {"continuous": "continuous time"} | {
        key: f"at {rate:g} Hz, {key} sample{'' if key == '1' else 's'} of delay"
        for key in found.robustness.shifts
        if key != "continuous"
    }
    return [(names[key], span(value)) for key, value in found.robustness.shifts.items()]


def span(found: Range | None) -> str:
    """Downwards … upwards; an end that was not found is left open."""
    if found is None:
        return "nothing is met"
    if found == Range(0.0, 0.0):
        return "none"
    down, up = ("no limit found" if end is None else f"{end:.2f} %" for end in found)
    return f"{'' if found.down is None else '−'}{down} … {'' if found.up is None else '+'}{up}"


def answer(found: Verification) -> str:
    """The sentence at the end."""
    if not found.running.is_stable:
        return "as it will run, the loop is UNSTABLE"
    if found.missed:
        return f"as it will run, the loop misses {', '.join(row.label for row in found.missed)}"
    asked = any(row.limit is not None for row in found.rows)
    return "as it will run, the loop meets its specification" if asked else "stable; nothing is specified"
