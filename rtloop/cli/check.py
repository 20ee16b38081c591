"""`rtloop check`: a configuration's loop, its limits and its margins on paper."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from rtloop.cli.exit_codes import report_errors, require_readable
from rtloop.cli.options import CONFIG, JSON
from rtloop.cli.output import echo_json, print_warnings
from rtloop.cli.output.tables import console, escape, format_figure, table
from rtloop.errors import ConfigError
from rtloop.values import count_text

if TYPE_CHECKING:
    from rich.console import Console

    from rtloop.analysis.perturbation import PercentRange
    from rtloop.configuration.axis import AxisOptions
    from rtloop.configuration.checks import AxisCheck
    from rtloop.configuration.prepare import Prepared
    from rtloop.design.verification.verify import Verification
    from rtloop.supervision.host_delay import SpentMargin


ROWS = (
    ("stable", lambda loop: "yes" if loop.stable else "NO"),
    ("crossover", lambda loop: f"{loop.crossover_hz:.2f} Hz"),
    ("phase margin", lambda loop: f"{loop.phase_margin_deg:.2f}°"),
    ("gain margin", lambda loop: f"{loop.gain_margin:.3f}"),
    ("max |S|", lambda loop: f"{loop.max_sensitivity:.3f} at {loop.max_sensitivity_hz:.1f} Hz"),
    ("static error", lambda loop: f"{loop.static_error_percent:.4f} %"),
    ("settling (5 %)", lambda loop: format_figure(1e3 * loop.settling_time_s, 2, " ms")),
    ("overshoot", lambda loop: format_figure(loop.overshoot_percent, 2, " %")),
    ("peak of v per unit step", lambda loop: f"{loop.peak_command:.4f}"),
)


class AxisJudgement(NamedTuple):
    """The result of `rtloop check` for one axis.

    `shifts` are the ranges, in percent, by which the resonance may move while the loop stays stable: "continuous" for
    C(s), "running" for the loop as it runs. `is_stable_on_rig` is None where configuration and simulated rig agree and
    the loop is stable there, and where no rig or loop is known; `verification` is None without a specification or loop.
    `spent` is the delay that this host adds, and the loop's delay margin; None without a measurement or a stable loop.
    """

    axis: AxisOptions
    check: AxisCheck
    shifts: dict[str, PercentRange]
    is_stable_on_rig: bool | None
    verification: Verification | None
    spent: SpentMargin | None


@click.command()
@CONFIG
@click.option("--strict", is_flag=True, help="Treat warnings as faults.")
@JSON
@report_errors
def check(config: Path, strict: bool, as_json: bool) -> None:
    """Show and judge the loop of CONFIG; touches no hardware.

    Shows limits, C(z) against C(s), margins on the model, and the verdict by the axis's specification.
    """
    require_readable(config)
    from rtloop.configuration.cautions import cautions
    from rtloop.configuration.file import load
    from rtloop.configuration.prepare import prepare
    from rtloop.supervision.host_delay import load_host_delay, spent_margin

    prepared = prepare(load(config))
    warnings = [*prepared.warnings, *cautions(prepared)]
    if strict and (faults := [*warnings, *_second_opinion_faults(prepared)]):
        raise ConfigError(str(config), faults)
    host = load_host_delay(prepared.configuration)
    judgements = [
        AxisJudgement(
            axis=axis,
            check=check,
            shifts=_tolerated_shifts(check),
            is_stable_on_rig=_stability_on_rig(prepared, axis, check),
            verification=_verify_axis(prepared, axis, check),
            spent=host and spent_margin(check, host),
        )
        for axis, check in zip(prepared.configuration.axes, prepared.checks, strict=True)
    ]
    if as_json:
        echo_json(_report(prepared, warnings, judgements))
        return
    _print_plan(prepared)
    for judgement in judgements:
        _print_axis(judgement)
    print_warnings(warnings)


def _second_opinion_faults(prepared: Prepared) -> list[str]:
    """Return a sentence for each quantity of a loop for which python-control computes another value, else []."""
    from rtloop.configuration.second_opinion import faults_on_models  # more than a second of import

    return faults_on_models(prepared)


def _verify_axis(prepared: Prepared, axis: AxisOptions, check: AxisCheck) -> Verification | None:
    """Judge an axis by its specification. Returns None without a specification or a known linear loop.

    No loop is known without a linear law, and for a shared controller without the models of all its axes. Raises
    ConfigError without a model or for an invalid specification, InputFileError for one that cannot be read.
    """
    if axis.specification is None or not check.is_known:
        return None
    from rtloop.design.verification.axes import verify_axis  # half a second of import

    return verify_axis(prepared.configuration, check, None)[0]


def _tolerated_shifts(check: AxisCheck) -> dict[str, PercentRange]:
    """Return {continuous, running}: ranges, in percent, by which the model's resonance may move in a stable loop.

    "continuous" belongs to C(s), and is missing for other laws; "running" belongs to the loop as it runs. {} without a
    loop on a model with a resonance.
    """
    from rtloop.analysis.perturbation import loop_builder, plant_changes, stability_range

    if check.plant is None or check.on_model is None:
        return {}
    resonance = plant_changes(check.plant).get("resonance")
    if resonance is None:
        return {}
    running = stability_range(lambda plant: check.loop(plant, check.delay_ticks), check.plant, resonance)
    if check.controller is None:
        return {"running": running}
    return {"continuous": stability_range(loop_builder(check.controller), check.plant, resonance), "running": running}


def _stability_on_rig(prepared: Prepared, axis: AxisOptions, check: AxisCheck) -> bool | None:
    """Whether the loop of an axis is stable on the simulated rig: False if not, True if so in spite of contradictions.

    None if it is stable and nothing contradicts the rig, for other drivers, and where no linear loop is known.
    """
    from rtloop.configuration.simulated import compare_with_rig

    on_rig = compare_with_rig(prepared.configuration, axis, check).on_rig
    return None if on_rig is None or on_rig.on_model is None else on_rig.on_model.is_stable


def _print_plan(prepared: Prepared) -> None:
    """Print the loop's rate, mode and driver, and the folder of its recordings."""
    from rtloop.supervision.recording_path import recordings_folder

    plan, facts = prepared.plan, prepared.facts
    axes = count_text(len(plan.axes), "axis", "axes")
    driver = f"driver {plan.driver_kind} ({len(facts.inputs)} in, {len(facts.outputs)} out)"
    rate = f"{plan.pacing.rate_hz:g} Hz"
    console().print(f"[bold]{escape(plan.name)}[/]: {axes} at {rate}, mode {plan.mode.name.lower()}, {driver}")
    console().print(f"records into {escape(str(recordings_folder(prepared.configuration)))}", soft_wrap=True)


def _print_axis(judgement: AxisJudgement) -> None:
    """Print limits, law, analyses and verdict of one axis."""
    from rtloop.design.verification.text import answer

    out, axis = console(), judgement.axis
    limits, interlocks = axis.limits, axis.interlocks
    drive = (
        f"±{limits.drive_v:g}" if limits.lowest_v == -limits.drive_v else f"{limits.lowest_v:g} … {limits.drive_v:g}"
    )
    slew = "no running slew limit" if limits.slew_v_per_s is None else f"slew {limits.slew_v_per_s:g} V/s"
    out.print(
        f"\n[bold]axis {axis.name}[/]: drive {drive} V, command ±{limits.command_um:g} µm, {slew}, "
        f"trip ramp {limits.trip_slew_v_per_s:g} V/s; trips beyond ±{interlocks.position_um:g} µm "
        f"or {interlocks.sensor_min_v:g} … {interlocks.sensor_max_v:g} V at the sensor"
    )
    _print_law(out, judgement.check)
    _print_analyses(out, judgement)
    if judgement.spent is not None:
        out.print(judgement.spent.text)
    if judgement.verification is not None:
        specification = escape(axis.specification)
        out.print(f"{specification}: {answer(judgement.verification)}; `rtloop design verify` shows all figures")


def _print_law(out: Console, check: AxisCheck) -> None:
    """Print the kind and the order of an axis's controller, and each notch or resonance that C(z) shifts."""
    linear = check.linear if check.together is None else check.together.linear
    order = "" if linear is None else f", linear about its rest, of order {linear.order}"
    if check.law is None:
        out.print("no controller; possible modes: feedforward, raw and off")
    elif check.together is not None:
        axes = check.together.axes
        shares = f"shares the controller of axis {axes[0]}"
        out.print(
            shares if check.together.place else f"law {check.together.law.kind!r} of axes {', '.join(axes)}{order}"
        )
    elif check.discrete is not None and check.comparison is not None:
        out.print(f"C(z) by {check.discrete.method}, order {check.discrete.order}")
        for shift in check.comparison.shifts:
            out.print(f"  {shift.kind} at {shift.frequency_hz:.1f} Hz is at {shift.discrete_hz:.1f} Hz in C(z)")
    else:
        out.print(f"law {check.law.kind!r}{order}")


def _print_analyses(out: Console, judgement: AxisJudgement) -> None:
    """Print the figures of an axis's loop, with C(s) and as it runs; of a shared controller also those of all axes."""
    from rtloop.design.verification.text import format_range, together

    check, shifts = judgement.check, judgement.shifts
    analyses = {"continuous C(s)": ("continuous", check.continuous), "as it runs": ("running", check.running)}
    analyses = {heading: (key, analysis) for heading, (key, analysis) in analyses.items() if analysis is not None}
    if check.law is None or not analyses:
        return
    heading = "on the model" if check.together is None else "on the models, each loop opened alone"
    rows = [(label, *(format_value(analysis) for _, analysis in analyses.values())) for label, format_value in ROWS]
    if judgement.is_stable_on_rig is not None:
        stable = "yes" if judgement.is_stable_on_rig else "[red]NO[/]"
        rows.insert(1, ("stable on the simulated rig", *("" for _ in list(analyses)[1:]), stable))
    if shifts:
        rows.append(("resonance may move by", *(format_range(shifts[key]) for key, _ in analyses.values())))
    out.print(table(heading, *analyses, rows=rows, words=(1, 2)))
    if check.together is not None and check.together.margins is not None and check.together.place == 0:
        heading = f"{' and '.join(check.together.axes)} together"
        out.print(table(heading, "as they run", rows=together(check.together.margins), words=(1,)))


def _report(prepared: Prepared, warnings: list[str], judgements: list[AxisJudgement]) -> dict[str, Any]:
    """Return the JSON report of `rtloop check`."""
    from rtloop.supervision.recording_path import recordings_folder

    plan = prepared.plan
    return {
        "name": plan.name,
        "rate_hz": plan.pacing.rate_hz,
        "mode": plan.mode.name.lower(),
        "driver": plan.driver_kind,
        "recordings": str(recordings_folder(prepared.configuration)),
        "columns": list(plan.columns),
        "warnings": warnings,
        "axes": [_axis_report(judgement) for judgement in judgements],
    }


def _axis_report(judgement: AxisJudgement) -> dict[str, Any]:
    """Return the JSON report on one axis; `missed` lists the labels of the requirements that its running loop misses.

    They are those on the simulated rig where the axis contradicts the rig. Without a specification, `meets` and
    `missed` are None.
    """
    check, verification, coupled = judgement.check, judgement.verification, judgement.check.together
    missed = None
    if verification is not None:
        missed = [row.label for row in (verification.on_rig or verification).missed_rows]
    return {
        "name": check.name,
        "host_delay": judgement.spent and asdict(judgement.spent),
        "comparison": check.comparison and check.comparison.as_dict(),
        "continuous": check.continuous and check.continuous.as_dict(),
        "running": check.running and check.running.as_dict(),
        "stable_on_rig": judgement.is_stable_on_rig,
        "together": coupled and {"axes": list(coupled.axes), "margins": coupled.margins and coupled.margins.as_dict()},
        "meets": None if verification is None else verification.meets_specification,
        "missed": missed,
        "resonance_shift_tolerated_percent": {name: list(value) for name, value in judgement.shifts.items()},
    }
