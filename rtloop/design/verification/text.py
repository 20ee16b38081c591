"""A verification in words: the cells that the terminal and the page show alike. No numbers are made here."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import chain

from rtloop.analysis.coupled_loop import TogetherMargins
from rtloop.analysis.perturbation import Range
from rtloop.design.synthesis.specification import QUANTITIES
from rtloop.design.verification.judgement import Limit
from rtloop.design.verification.simulated import JUDGED, KEPT, SimulatedStep
from rtloop.design.verification.verify import Row, Verification

ON_PAPER, RUNS = "continuous C(s)", "as it runs C(z)"
LINEAR = "linear"
SHIFT_NAMES = {"resonance": "resonance, frequency", "damping": "resonance, damping", "gain": "gain, hysteresis weights"}
NOTE = "Gain stands for D(0), the sensor's scale and all hysteresis weights together."


def table(found: Verification) -> list[tuple[str, ...]]:
    """Headings, then a row for each quantity: label, required, achieved and verdict (twice where it is on paper, too),
    claim.
    """
    loops = [loop for loop in (found.continuous, found.running) if loop is not None]
    columns = [ON_PAPER, RUNS][-len(loops) :]
    stable = ["yes" if loop.is_stable else "NO" for loop in loops]
    rows = [(LINEAR, "required", *_twos((column, "") for column in columns), "its source says")]
    rows.append(("stable", "yes", *_twos((stability, verdict(stability == "yes")) for stability in stable), ""))
    for row in found.rows:
        values = [row.continuous, row.running][-len(loops) :]
        cells = _twos((_with_unit(row, value), verdict(row.met(value))) for value in values)
        rows.append((row.label, required(row), *cells, row.claim))
    return rows


def _twos(cells: Iterable[tuple[str, str]]) -> tuple[str, ...]:
    return tuple(chain.from_iterable(cells))


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
    """Headings, then a row for each thing that may move: until unstable (twice where it is on paper), until missed."""
    on_paper = found.continuous is not None
    limit_kinds = ("continuous", "running", "running_missed")[0 if on_paper else 1 :]
    headings = ("continuous, until unstable", "as it runs, until unstable", "until what is met is missed")
    rows = [("may move by", *headings[-len(limit_kinds) :])]
    rows += [
        (SHIFT_NAMES[name], *(span(ranges[kind]) for kind in limit_kinds))
        for name, ranges in found.robustness.ranges.items()
    ]
    loop = found.continuous or found.running
    delays = [f"+{number(found.robustness.delay_us)} µs", f"+{found.robustness.delay_ticks} samples"]
    delays = delays if on_paper else [" or ".join(delays)]
    return [*rows, ("delay", *(delays if loop.is_stable else ["–"] * len(delays)), "")]


def scenarios(found: Verification) -> list[tuple[str, ...]]:
    """Headings, then the worst of each quantity, its verdict and its plant; nothing where no scenario is asked for."""
    if found.scenarios is None:
        return []
    rows = [(f"worst of {found.scenarios.count} scenarios, linear", "required", "as it runs", "", "on the plant with")]
    return rows + [
        (row.label, required(row), _with_unit(row, worst.value), verdict(found.scenarios.met(row, worst)), worst.plant)
        for row, worst in found.scenarios.rows
    ]


def simulated(found: Verification) -> list[tuple[str, ...]]:
    """Headings, then a row for each height of a step; nothing where nothing was simulated."""
    if found.simulated is None:
        return []
    rows = [
        (
            f"{100 * KEPT:g} of 100 simulated steps",
            *(cell for name in JUDGED for cell in (QUANTITIES[name][0], "")),
            "peak |u|",
            "",
        )
    ]
    for step in found.simulated.steps:
        cells = [cell for name in JUDGED for cell in (_kept(step, name), verdict(found.simulated.met(step, name)))]
        notes = ["TRIPS: " + ", ".join(step.trips)] if step.trips else []
        notes += [f"limited: {', '.join(step.limited)}"] if step.limited else []
        rows.append((f"{step.height_um:g} µm", *cells, f"{step.peak_drive_v:.4g} V", "; ".join(notes)))
    return rows


def _kept(step: SimulatedStep, name: str) -> str:
    """What is kept; and what half of the steps do, where noise makes that another figure."""
    quantile, median, unit = getattr(step, name), step.typical[JUDGED.index(name)], QUANTITIES[name][1]
    return f"{quantile:.4g} {unit}" if step.alike(name) else f"{quantile:.3g} (half: {median:.3g}) {unit}"


def simulation_notes(found: Verification) -> list[str]:
    """What was simulated, what was left out, and what the loop does at rest."""
    if found.simulated is None:
        return []
    result = found.simulated
    notes = [
        f"Simulated by the law itself on {result.truth}, with hysteresis, limits, rounding and noise; at rest x moves by "
        f"{result.noise_x_nm:.3g} nm rms, v by {result.noise_v_nm:.3g} nm rms."
    ]
    if result.left_out_um:
        heights = ", ".join(f"{height:g}" for height in result.left_out_um)
        notes.append(f"Left out: steps of {heights} µm; the command's range ends at {result.reach_um:.4g} µm.")
    if result.required and not result.judged:
        notes.append("These verdicts are no part of the answer below; [simulation] judged = true makes them.")
    return notes


def together(margins: TogetherMargins) -> list[tuple[str, str]]:
    """What all axes of a controller bear at once."""
    if math.isnan(margins.max_sensitivity):
        return [("stable", "NO")]
    rows = [
        ("largest σ(S)", f"{margins.max_sensitivity:.3f} at {margins.max_sensitivity_hz:.1f} Hz"),
        ("largest σ(T)", f"{margins.max_tracking:.3f}"),
    ]
    for label, disk, hz in (
        ("disk margin, sensors", margins.disk_margin, margins.disk_margin_hz),
        ("disk margin, commands", margins.command_disk_margin, margins.command_disk_margin_hz),
    ):
        low, high = (1 - disk / 2) / (1 + disk / 2), (1 + disk / 2) / (1 - disk / 2) if disk < 2 else math.inf
        phase_deg = math.degrees(2 * math.atan(disk / 2))
        gains = f"gains × {max(low, 0.0):.2f} … {high:.2f}, phases ± {phase_deg:.1f}°"
        rows.append((label, f"{disk:.3f} at {hz:.1f} Hz: {gains}"))
    return rows


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
    """Downwards … upwards; an end that was not found is left open.

    "unlimited" says that no change in the range searched leads there.
    """
    if found is None:
        return "nothing is met"
    if found == Range(0.0, 0.0):
        return "none"
    if found.down is None and found.up is None:
        return "unlimited in the range searched"
    down, up = ("unlimited" if end is None else f"{end:.2f} %" for end in found)
    return f"{'' if found.down is None else '−'}{down} … {'' if found.up is None else '+'}{up}"


def answer(found: Verification) -> str:
    """The sentence at the end."""
    if not found.running.is_stable:
        return "as it will run, the loop is UNSTABLE"
    if found.host is not None and found.host.is_spent:
        return "the delay of this host takes all that the loop bears"
    violations = [row.label for row in found.missed]
    if found.scenarios is not None:
        violations += [
            f"{row.label} with {worst.plant}" for row, worst in found.scenarios.missed if row not in found.missed
        ]
    violations += [] if found.simulated is None else [f"simulated, {violation}" for violation in found.simulated.missed]
    if violations:
        return f"as it will run, the loop misses {', '.join(violations)}"
    is_specified = any(row.limit is not None for row in found.rows)
    return "as it will run, the loop meets its specification" if is_specified else "stable; nothing is specified"
