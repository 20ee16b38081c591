"""Text of a verification: the table cells shown on the terminal and on the page. Computes no figures."""

from __future__ import annotations

import math

from rtloop.analysis.coupled_loop import SimultaneousMargins
from rtloop.analysis.perturbation import PercentRange
from rtloop.design.synthesis.specification import QUANTITIES
from rtloop.design.verification.robustness import MOST_TRIED_TICKS
from rtloop.design.verification.simulated_steps import JUDGED_QUANTITIES, STEP_QUANTILE, SimulatedStep
from rtloop.design.verification.verify import Row, Verification

CONTINUOUS_HEADING, RUNNING_HEADING = "C(s), not judged", "as it runs C(z)"
LINEAR_HEADING = "linear"
SHIFT_NAMES = {"resonance": "resonance, frequency", "damping": "resonance, damping", "gain": "gain, hysteresis weights"}
CONTINUOUS_NOTE = (
    "C(s) is the controller in continuous time, without taps, hold and delay. C(s) is shown for comparison and never "
    "runs."
)
NOTE = "The row of the gain stands for D(0), the sensor's scale and all hysteresis weights together."


def table(verification: Verification) -> list[tuple[str, ...]]:
    """Return headings, then a row for the loop's stability and one for each quantity.

    Cells of a row: label, required; the value of C(s), if it exists; value and verdict of C(z); the claim. The column
    of claims is left out if the specification has none. C(s) does not run, and has no verdict.
    """
    continuous, running = verification.continuous, verification.running
    rows: list[tuple[str, ...]] = [
        (LINEAR_HEADING, "required", CONTINUOUS_HEADING, RUNNING_HEADING, "", "claimed by the source")
    ]
    stable = ["yes" if loop is not None and loop.is_stable else "NO" for loop in (continuous, running)]
    rows.append(("stable", "yes", *stable, format_verdict(running.is_stable), ""))
    for row in verification.rows:
        values = [_format_with_unit(row, value) for value in (row.continuous, row.running)]
        rows.append((row.label, format_limit(row), *values, format_verdict(row.is_met(row.running)), row.claim))
    if continuous is None:
        rows = [(*row[:2], *row[3:]) for row in rows]
    return rows if any(row[-1] for row in rows[1:]) else [row[:-1] for row in rows]


def format_limit(row: Row) -> str:
    """Return the limit as text: "≤ 0.1 %", "everywhere" if infinite, or "" without limit."""
    if row.limit is None:
        return ""
    if math.isinf(row.limit.value):
        return "everywhere"
    return f"{'≤' if row.limit.at_most else '≥'} {format_number(row.limit.value)} {row.unit}".rstrip()


def format_verdict(is_met: bool | None) -> str:
    """Return "met", "MISSED", or "" for None."""
    return "" if is_met is None else "met" if is_met else "MISSED"


def format_number(value: float | None) -> str:
    """Return a number with at most six digits as text; "" for None, "–" for NaN, "no limit" for ±infinity."""
    if value is None:
        return ""
    if math.isnan(value):
        return "–"
    return "no limit" if math.isinf(value) else f"{value:.6g}"


def _format_with_unit(row: Row, value: float | None) -> str:
    """Return a value with the row's unit; no unit without a finite value."""
    text = format_number(value)
    return f"{text} {row.unit}".rstrip() if text not in ("", "–", "no limit") else text


def robustness(verification: Verification) -> list[tuple[str, ...]]:
    """Return headings, then a row for each plant parameter: tolerated change until unstable (of C(s), if it exists, and
    of C(z)), and until a requirement that is met now is missed.

    The last row is the tolerated additional delay. Robustness is computed if it was not before.
    """
    on_paper = verification.continuous is not None
    limit_kinds = ("continuous", "running", "running_missed")[0 if on_paper else 1 :]
    headings = ("C(s), until unstable", "C(z), until unstable", "C(z), until a requirement met now fails")
    rows = [("linear loop may move by", *headings[-len(limit_kinds) :])]
    rows += [
        (SHIFT_NAMES[name], *(format_range(ranges[kind]) for kind in limit_kinds))
        for name, ranges in verification.robustness.ranges.items()
    ]
    loop = verification.continuous or verification.running
    ticks = verification.robustness.delay_ticks
    delays = [
        f"+{format_number(verification.robustness.delay_us)} µs",
        f"more than {MOST_TRIED_TICKS - verification.delay_ticks} samples" if ticks is None else f"+{ticks} samples",
    ]
    delays = delays if on_paper else [" or ".join(delays)]
    return [*rows, ("delay", *(delays if loop.is_stable else ["–"] * len(delays)), "")]


def scenarios(verification: Verification) -> list[tuple[str, ...]]:
    """Return headings, then a row for each quantity: label, limit, worst value, verdict, and the plant with the worst
    value; [] without scenarios.
    """
    if verification.scenarios is None:
        return []
    rows = [
        (
            f"worst of {verification.scenarios.count} scenarios, linear",
            "required",
            "as it runs",
            "",
            "on the plant with",
        )
    ]
    return rows + [
        (
            row.label,
            format_limit(row),
            _format_with_unit(row, worst_value.value),
            format_verdict(verification.scenarios.is_met(row, worst_value)),
            worst_value.plant,
        )
        for row, worst_value in verification.scenarios.rows
    ]


def simulated(verification: Verification) -> list[tuple[str, ...]]:
    """Return headings, then a row for each step height: each figure with its verdict, peak drive, trips and active
    limits.

    [] if no steps were simulated.
    """
    if verification.simulated is None:
        return []
    rows = [
        (
            f"{100 * STEP_QUANTILE:g} of 100 simulated steps have at most",
            *(cell for name in JUDGED_QUANTITIES for cell in (QUANTITIES[name][0], "")),
            "peak |u|",
            "",
        )
    ]
    for step in verification.simulated.steps:
        cells = [
            cell
            for name in JUDGED_QUANTITIES
            for cell in (_format_step_value(step, name), format_verdict(verification.simulated.is_met(step, name)))
        ]
        low_um, high_um = step.levels_um
        notes = [f"between {low_um:.4g} and {high_um:.4g} µm"] if low_um != -high_um else []
        notes += ["TRIPS: " + ", ".join(step.trips)] if step.trips else []
        notes += [f"limited: {', '.join(step.limited)}"] if step.limited else []
        rows.append((f"{step.height_um:g} µm", *cells, f"{step.peak_drive_v:.4g} V", "; ".join(notes)))
    return rows


def _format_step_value(step: SimulatedStep, name: str) -> str:
    """Return the STEP_QUANTILE quantile of the quantity `name` with its unit; the median is added if noise decides it.

    An infinite time is "never", any other infinite quantity "–".
    """
    quantile, median, unit = getattr(step, name), step.typical[JUDGED_QUANTITIES.index(name)], QUANTITIES[name][1]
    if math.isinf(quantile):
        return "never" if unit == "ms" else "–"
    return f"{quantile:.4g} {unit}" if step.is_repeatable(name) else f"{quantile:.3g} {unit} (median {median:.3g})"


def simulation_notes(verification: Verification) -> list[str]:
    """Return notes on the simulated system and its noise at rest, on omitted steps, on a static error because of which
    steps miss their limit, and on verdicts that do not count; [] without simulation.
    """
    if verification.simulated is None:
        return []
    result = verification.simulated
    notes = [
        f"The real control law was simulated on {result.truth}, with hysteresis, limits, rounding and noise. At rest, "
        f"the position x moves by {result.noise_x_nm:.3g} nm rms, the command v by {result.noise_v_nm:.3g} nm rms."
    ]
    if result.omitted_heights_um:
        heights = ", ".join(f"{height:g}" for height in result.omitted_heights_um)
        notes.append(f"Steps of {heights} µm were left out: the command's range is {result.command_range}.")
    notes += _static_error_notes(verification)
    if result.required and (
        uncounted := [step for step in result.steps if step.height_um not in result.counted_heights_um]
    ):
        heights = ", ".join(f"{step.height_um:g}" for step in uncounted)
        notes.append(
            f"Steps of {heights} µm do not count for the verdict on the loop; set [simulation] judged = true in the "
            "specification to count them."
        )
    return notes


def _static_error_notes(verification: Verification) -> list[str]:
    """Return one note on the static error of the linear loop if a simulated step misses its limit because of this
    error; otherwise [].

    The error is a part of the position: away from 0 it is a larger part of a small step.
    """
    result = verification.simulated
    percent = next((row.running for row in verification.rows if row.name == "static_error_percent"), None)
    if result is None or percent is None:
        return []
    for step in result.steps:
        farthest_um = max(map(abs, step.levels_um))
        step_percent = percent * farthest_um / step.height_um
        if result.is_met(step, "static_error_percent") is False and 2 * step_percent > step.static_error_percent:
            return [
                f"The loop has no integrator: its static error is {percent:.3g} % of the position. At "
                f"{farthest_um:.4g} µm, this is {percent / 100 * farthest_um:.3g} µm, or {step_percent:.3g} % of a "
                f"step of {step.height_um:g} µm. `rtloop design auto --robust` designs a controller with an integrator."
            ]
    return []


def simultaneous_rows(margins: SimultaneousMargins) -> list[tuple[str, str]]:
    """Return rows (label, text) of the margins of all axes of a controller together; the single row ("stable", "NO") if
    their loop is unstable.
    """
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


def shifts(verification: Verification) -> list[tuple[str, str]]:
    """Return rows (label, text) of the tolerated shift of the resonance: continuous, and running for each delay."""
    rate = 1 / verification.running.period_s if verification.running.period_s else 0.0
    names = {"continuous": "continuous time"} | {
        key: f"at {rate:g} Hz, {key} sample{'' if key == '1' else 's'} of delay"
        for key in verification.robustness.shifts
        if key != "continuous"
    }
    return [(names[key], format_range(value)) for key, value in verification.robustness.shifts.items()]


def format_range(tolerated: PercentRange | None) -> str:
    """Return "down … up" in percent.

    "no requirement is met" for None, "none" for no tolerated change, "no lower limit" or "no upper limit" where no
    change within the searched range is too large, "no limit in the range searched" for both.
    """
    if tolerated is None:
        return "no requirement is met"
    if tolerated == PercentRange(0.0, 0.0):
        return "none"
    if tolerated.down is None and tolerated.up is None:
        return "no limit in the range searched"
    down = "no lower limit" if tolerated.down is None else f"−{tolerated.down:.2f} %"
    up = "no upper limit" if tolerated.up is None else f"+{tolerated.up:.2f} %"
    return f"{down} … {up}"


def answer(verification: Verification, place: str = "") -> str:
    """Return the concluding sentence on the loop, without full stop.

    A loop on the simulated rig that misses its specification comes first, then instability, the host's delay, missed
    requirements and contradictions. `place` says where the loop was judged; without it the sentence says whether
    simulated steps were judged, or linear figures alone.
    """
    if verification.on_rig is not None and not verification.on_rig.meets_specification:
        return answer(verification.on_rig, "on the simulated rig")
    place = place or ("by its linear figures" if verification.simulated is None else "as it will run")
    if not verification.running.is_stable:
        return f"{place}, the loop is UNSTABLE"
    if verification.host is not None and verification.host.is_spent:
        return "the delay of this host uses the whole delay margin of the loop"
    violations = [row.label for row in verification.missed_rows]
    if verification.scenarios is not None:
        violations += [
            f"{row.label} with {worst_value.plant}"
            for row, worst_value in verification.scenarios.missed_rows
            if row not in verification.missed_rows
        ]
    violations += (
        []
        if verification.simulated is None
        else [f"simulated, {violation}" for violation in verification.simulated.violations]
    )
    if violations:
        return f"{place}, the loop misses {'; '.join(violations)}"
    if verification.contradictions and verification.on_rig is None:
        return f"not judged: {'; '.join(verification.contradictions)}"
    if all(row.limit is None for row in verification.rows):
        return "stable; nothing is specified"
    missed = [] if verification.simulated is None else verification.simulated.uncounted_violations
    if missed:
        return f"{place}, the loop meets its specification; simulated steps that do not count miss {'; '.join(missed)}"
    return f"{place}, the loop meets its specification"
