"""`rtloop check`: what a configuration would run, and how good it is on paper."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from rtloop.analysis.loop_analysis import LoopAnalysis
from rtloop.analysis.perturbation import PercentRange, loop_builder, plant_changes, stability_range
from rtloop.configuration.cautions import cautions
from rtloop.configuration.checks import AxisCheck, Together
from rtloop.configuration.file import load
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.design.verification.text import answer, format_range, together
from rtloop.design.verification.verify import Verification
from rtloop.errors import ConfigError
from rtloop.supervision.host_delay import SpentMargin, load_host_delay, spent_margin
from rtloop.terminal.machine import echo_json
from rtloop.terminal.table import console as _console
from rtloop.terminal.table import figure
from rtloop.values import count_text

ROWS = (
    ("stable", lambda loop: "yes" if loop.stable else "NO"),
    ("crossover", lambda loop: f"{loop.crossover_hz:.2f} Hz"),
    ("phase margin", lambda loop: f"{loop.phase_margin_deg:.2f}°"),
    ("gain margin", lambda loop: f"{loop.gain_margin:.3f}"),
    ("max |S|", lambda loop: f"{loop.max_sensitivity:.3f} at {loop.max_sensitivity_hz:.1f} Hz"),
    ("static error", lambda loop: f"{loop.static_error_percent:.4f} %"),
    ("settling (5 %)", lambda loop: figure(1e3 * loop.settling_time_s, 2, " ms")),
    ("overshoot", lambda loop: figure(loop.overshoot_percent, 2, " %")),
    ("peak of v per unit step", lambda loop: f"{loop.peak_command:.4f}"),
)


def check_configuration(config: Path, strict: bool, as_json: bool) -> int:
    """Check and print; raises ConfigError where the configuration cannot run, or if `strict` where it should not."""
    prepared = prepare(load(config))
    warnings = [*prepared.warnings, *cautions(prepared)]
    if strict and (faults := [*warnings, *_second_opinion_faults(prepared)]):
        raise ConfigError(str(config), faults)
    shifts = {check.name: _shifts(check) for check in prepared.checks}
    judged = {check.name: _judged(prepared, check) for check in prepared.checks}
    host = load_host_delay(prepared.configuration)
    spent = {} if host is None else {check.name: spent_margin(check, host) for check in prepared.checks}
    if as_json:
        echo_json(_report(prepared, warnings, shifts, judged, spent))
        return 0
    console = _console()
    plan, facts = prepared.plan, prepared.facts
    console.print(
        f"[bold]{escape(plan.name)}[/]: {count_text(len(plan.axes), 'axis', 'axes')} at {plan.pacing.rate_hz:g} Hz, "
        f"mode {plan.mode.name.lower()}, driver {plan.driver_kind} ({len(facts.inputs)} in, {len(facts.outputs)} out)"
    )
    for axis, check in zip(prepared.configuration.axes, prepared.checks, strict=True):
        limits, interlocks = axis.limits, axis.interlocks
        sides = f"±{limits.drive_v:g}"
        if limits.lowest_v != -limits.drive_v:
            sides = f"{limits.lowest_v:g} … {limits.drive_v:g}"
        slew = "no running slew limit" if limits.slew_v_per_s is None else f"slew {limits.slew_v_per_s:g} V/s"
        console.print(
            f"\n[bold]axis {axis.name}[/]: drive {sides} V, command ±{limits.command_um:g} µm, {slew}, "
            f"trip ramp {limits.trip_slew_v_per_s:g} V/s; trips beyond ±{interlocks.position_um:g} µm "
            f"or {interlocks.sensor_min_v:g} … {interlocks.sensor_max_v:g} V at the sensor"
        )
        _print_axis(console, check, shifts[check.name])
        if (one := spent.get(check.name)) is not None:
            console.print(one.text)
        found = judged[axis.name]
        if found is not None:
            console.print(f"{escape(str(axis.specification))}: {answer(found)}; `rtloop design verify` shows it all")
    for warning in warnings:
        click.echo(f"warning: {warning}", err=True)
    return 0


def _second_opinion_faults(prepared: Prepared) -> list[str]:
    """Return a sentence for each quantity of a loop for which python-control computes another value."""
    from rtloop.design.verification.second_opinion import axis_faults  # more than a second of import

    return [
        fault
        for axis, check in zip(prepared.configuration.axes, prepared.checks, strict=True)
        if check.on_model is not None
        for fault in axis_faults(check, axis.model, axis.prefilter, check.on_model, check.delay_ticks)
    ]


def _judged(prepared: Prepared, check: AxisCheck) -> Verification | None:
    """The axis against the specification that it names; None where there is nothing to judge, or to judge by."""
    axis = prepared.configuration.axes[prepared.plan.axes.index(check.name)]
    if axis.specification is None or not check.is_known:
        return None
    from rtloop.commands.design.verify import verified  # half a second of import, for who has a specification

    return verified(prepared.configuration, check, None)[0]


def _print_axis(console: Console, check: AxisCheck, shifts: dict[str, PercentRange]) -> None:
    if check.law is None:
        console.print("no controller: feedforward, raw and off only")
        return
    if check.together is not None:
        console.print(_described_together(check.together))
    elif check.discrete is not None and check.comparison is not None:
        console.print(f"C(z) by {check.discrete.method}, order {check.discrete.order}")
        for shift in check.comparison.shifts:
            console.print(f"  {shift.kind} at {shift.frequency_hz:.1f} Hz is at {shift.discrete_hz:.1f} Hz in C(z)")
    else:
        order = "" if check.linear is None else f", linear about its rest, of order {check.linear.order}"
        console.print(f"law {check.law.kind!r}{order}")
    found = {"continuous C(s)": ("continuous", check.continuous), "as it runs": ("running", check.running)}
    found = {heading: (key, one) for heading, (key, one) in found.items() if one is not None}
    if not found:
        return
    heading = "on the model" if check.together is None else "on the models, broken alone"
    table = Table(heading, *found, box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for label, show in ROWS:
        table.add_row(label, *(show(one) for _, one in found.values() if one is not None))
    if shifts:
        table.add_row("resonance may move by", *(format_range(shifts[key]) for key, _ in found.values()))
    console.print(table)
    if check.together is not None and check.together.margins is not None and check.together.place == 0:
        heading = f"{' and '.join(check.together.axes)} together"
        table = Table(heading, "as they run", box=None, pad_edge=False, padding=(0, 3, 0, 0))
        for label, value in together(check.together.margins):
            table.add_row(label, value)
        console.print(table)


def _described_together(found: Together) -> str:
    """Whose controller it is, and which."""
    if found.place > 0:
        return f"shares the controller of axis {found.axes[0]}"
    order = "" if found.linear is None else f", linear about its rest, of order {found.linear.order}"
    return f"law {found.law.kind!r} of axes {', '.join(found.axes)}{order}"


def _shifts(check: AxisCheck) -> dict[str, PercentRange]:
    """Shift of the model's resonance that the loop survives."""
    if check.plant is None or check.on_model is None:
        return {}
    resonance = plant_changes(check.plant).get("resonance")
    if resonance is None:
        return {}
    runs = stability_range(lambda moved: check.loop(moved, check.delay_ticks), check.plant, resonance)
    running = {"running": runs}
    if check.controller is None:
        return running
    return {"continuous": stability_range(loop_builder(check.controller), check.plant, resonance), **running}


def _report(
    prepared: Prepared,
    warnings: list[str],
    shifts: dict[str, dict[str, PercentRange]],
    judged: dict[str, Verification | None],
    spent: dict[str, SpentMargin | None],
) -> dict[str, Any]:
    plan = prepared.plan
    return {
        "name": plan.name,
        "rate_hz": plan.pacing.rate_hz,
        "mode": plan.mode.name.lower(),
        "driver": plan.driver_kind,
        "columns": list(plan.columns),
        "warnings": warnings,
        "axes": [
            {
                "name": check.name,
                "host_delay": None if (one := spent.get(check.name)) is None else asdict(one),
                "comparison": check.comparison and check.comparison.as_dict(),
                "continuous": _analysis(check.continuous),
                "running": _analysis(check.running),
                "together": check.together and _together(check.together),
                "meets": None if (found := judged[check.name]) is None else found.meets_specification,
                "missed": None if found is None else _missed_labels(found),
                "resonance_shift_tolerated_percent": {name: list(value) for name, value in shifts[check.name].items()},
            }
            for check in prepared.checks
        ],
    }


def _missed_labels(found: Verification) -> list[str]:
    """Return labels of the rows that the loop misses, or, with contradictions, that it misses on the simulated rig."""
    rows = found.missed_rows if found.on_rig is None else found.on_rig.missed_rows
    return [row.label for row in rows]


def _together(found: Together) -> dict[str, Any]:
    return {"axes": list(found.axes), "margins": found.margins and found.margins.as_dict()}


def _analysis(analysis: LoopAnalysis | None) -> dict[str, Any] | None:
    return None if analysis is None else analysis.as_dict()
