"""Rows of steps on the rig: as configured, with the resonance shifted, with retuned taps, and on drawn rigs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rtloop.analysis.closed_loop import discrete_loop
from rtloop.analysis.measured.measurement import measure_loop
from rtloop.analysis.perturbation import resonance_hz, shift_resonance
from rtloop.configuration.file import Configuration
from rtloop.design.robust.options import ScenarioOptions
from rtloop.design.robust.scenarios import Family
from rtloop.experiments.procedures import response
from rtloop.experiments.setting import Setting
from rtloop.foundation.arrays import Real
from tests.soak.flagship.stage import (
    DWELL_S,
    PERIOD_S,
    RATE_HZ,
    SHORT_S,
    TRUTH,
    Steps,
    design_taps_within,
    linear_controller,
    replace_sections,
    replace_taps,
    rig_bench,
    run_steps,
    shifted_plant,
    tap_subject,
    trace_step,
)
from tests.soak.flagship.table import Row

SEEDS = (1, 2, 3)
"""Seeds of the sensor's noise; rows give the worst figures."""
SHIFTS = tuple(float(percent) for percent in range(-10, 11))
RETUNED = (-10.0, -5.0, 0.0, 5.0, 10.0)
TRACED, TRACED_UM = (-10.0, 0.0, 10.0), 40.0
RETUNED_WITHIN, RETUNED_OVERSHOOT = 0.5, 0.0005
"""Taps after retuning: range (%) around the measured resonance, and allowed overshoot on the model."""
WIDE, WIDE_OVERSHOOT, WIDE_MS = 10.0, 0.002, 3.2
"""Taps for all of ±10 %: range, allowed overshoot, and settling time."""
DRAWN = ScenarioOptions(resonance_percent=10.0, damping=(0.5, 2.0), gain_percent=2.0)
Progress = Callable[[str], None]
"""Function that prints a line of progress."""


class WorstFigures(NamedTuple):
    """Worst figures of several runs: settling (ms), overshoot of 40 µm and of 10 µm (%), static error (%), |u| (V)."""

    settling_ms: float
    overshoot: float
    overshoot_small: float
    static: float
    peak_v: float


def worst_figures(runs: Sequence[Steps]) -> WorstFigures:
    """Return the worst of each figure over the runs."""
    return WorstFigures(
        max(run.settling_ms for run in runs), max(run.overshoot(40.0) for run in runs),
        max(run.overshoot(10.0) for run in runs), max(run.static_percent for run in runs),
        max(run.peak_v for run in runs),
    )  # fmt: skip


def configured_rows(paper: Configuration, ours: Configuration) -> list[Row]:
    """Return rows of eight steps with every seed; also with a noisier sensor, and with eq (4) for the hysteresis."""
    runs = {
        name: [run_steps(rig_bench(configuration, seed=seed)) for seed in SEEDS]
        for name, configuration in (("paper", paper), ("ours", ours))
    }
    paper_figures, our_figures = worst_figures(runs["paper"]), worst_figures(runs["ours"])
    limits = {name: sorted({limit for run in loop_runs for limit in run.limited}) for name, loop_runs in runs.items()}
    note = "; ".join(f"{name} limits {' and '.join(names) or 'nothing'}" for name, names in limits.items())
    rows = [
        Row("eight steps: settling", "ms", 3.0, paper_figures.settling_ms, our_figures.settling_ms),
        Row("  overshoot, 40 µm", "%", 0.1, paper_figures.overshoot, our_figures.overshoot),
        Row("  overshoot, 10 µm", "%", 0.2, paper_figures.overshoot_small, our_figures.overshoot_small),
        Row("  static error", "%", 0.02, paper_figures.static, our_figures.static),
        Row("  largest |u|", "V", 9.98, paper_figures.peak_v, our_figures.peak_v, note=note),
    ]
    noisy = [
        worst_figures([run_steps(rig_bench(configuration, seed=seed, noise_um=0.1)) for seed in SEEDS])
        for configuration in (paper, ours)
    ]
    rows += [
        Row("sensor of 100 nm: settling", "ms", None, noisy[0].settling_ms, noisy[1].settling_ms),
        Row("  overshoot, 40 µm", "%", None, noisy[0].overshoot, noisy[1].overshoot),
    ]
    printed = paper.axes[0].feedforward.model_copy(update={"dead_band": "exact"})
    printed_figures = worst_figures(
        [run_steps(rig_bench(replace_sections(ours, feedforward=printed), seed=seed)) for seed in SEEDS]
    )
    rows += [
        Row(
            "eq (4) in place of an identification: settling",
            "ms",
            None,
            paper_figures.settling_ms,
            printed_figures.settling_ms,
        ),
        Row("  overshoot, 40 µm", "%", None, paper_figures.overshoot, printed_figures.overshoot),
    ]
    return rows


class ShiftedRuns(NamedTuple):
    """Steps, and traces of one step, by loop and by shift of the resonance (%); the loop with taps for ±10 %."""

    steps: Mapping[str, Mapping[float, Steps]]
    traces: Mapping[str, Mapping[float, tuple[Real, Real]]]
    wide: Configuration


def shift_rows(paper: Configuration, ours: Configuration, show_progress: Progress) -> tuple[list[Row], ShiftedRuns]:
    """Return rows and runs over shifts of the resonance: with configured, ±10 % and retuned taps."""
    subject = tap_subject(ours)
    wide = replace_taps(ours, design_taps_within(subject, subject.plant, WIDE, WIDE_OVERSHOOT, WIDE_MS))
    steps: dict[str, dict[float, Steps]] = {
        name: {percent: run_steps(rig_bench(configuration, shifted_plant(percent)), DWELL_S) for percent in SHIFTS}
        for name, configuration in (("paper", paper), ("ours", ours), ("wide", wide))
    }
    traces = {
        name: {percent: trace_step(rig_bench(configuration, shifted_plant(percent)), TRACED_UM) for percent in TRACED}
        for name, configuration in (("paper", paper), ("ours", ours))
    }
    traces["retuned"] = {}
    show_progress("resonance shifted: done; taps are retuned")
    steps["retuned"], errors = {}, []
    for percent in RETUNED:
        measured = measured_percent(ours, percent)
        errors.append(abs(measured - percent))
        taps = design_taps_within(subject, shift_resonance(subject.plant, measured), RETUNED_WITHIN, RETUNED_OVERSHOOT)
        retuned = replace_taps(ours, taps)
        steps["retuned"][percent] = run_steps(rig_bench(retuned, shifted_plant(percent)))
        if percent in TRACED:
            traces["retuned"][percent] = trace_step(rig_bench(retuned, shifted_plant(percent)), TRACED_UM)
        show_progress(f"resonance at {percent:+g} %, measured {measured:+.3f} %")
    rows = []
    for name, title, limits in (
        ("ours", "taps of robust.toml", ((3.0, 3.1, 0.3), (5.0, 3.8, 0.6), (10.0, 3.8, 1.5))),
        ("wide", "taps made for ±10 %", ((10.0, 3.3, 0.3),)),
        ("retuned", f"taps retuned, measured to {max(errors):.2g} %", ((10.0, 3.1, 0.2),)),
    ):
        for within, settling_ms, overshoot in limits:
            figures = worst_figures([run for percent, run in steps[name].items() if abs(percent) <= within])
            paper_figures = worst_figures([run for percent, run in steps["paper"].items() if abs(percent) <= within])
            rows += [
                Row(f"resonance ±{within:g} %, {title}: settling", "ms", settling_ms, paper_figures.settling_ms,
                    figures.settling_ms),
                Row("  overshoot, 40 µm", "%", overshoot, paper_figures.overshoot, figures.overshoot),
                Row("  overshoot, 10 µm", "%", None, paper_figures.overshoot_small, figures.overshoot_small),
            ]  # fmt: skip
    return rows, ShiftedRuns(steps, traces, wide)


def measured_percent(configuration: Configuration, truth_percent: float) -> float:
    """Return the shift (%) of the resonance, measured by the multisine of the experiment `response` on the rig."""
    (axis,) = configuration.axes
    assert axis.model is not None
    options = response.ResponseOptions()
    (run,) = response.runs(options, Setting(RATE_HZ, axis, is_virgin=True))
    (wave,) = [reference["levels"] for reference in run.timeline.references if reference["kind"] == "steps"]
    recorded = rig_bench(configuration, shifted_plant(truth_percent)).run("x", wave * (options.periods + 1), PERIOD_S)
    signals = {name: recorded[f"x_{name}"] for name in ("reference_um", "error_um", "command_um", "position_um")}
    model_hz = resonance_hz(axis.model.transfer())
    assert model_hz is not None
    mode = measure_loop(
        signals,
        RATE_HZ,
        model_hz[0],
        discrete_loop(linear_controller(configuration), axis.model.transfer()),
        axis.prefilter.command_taps,
    ).mode
    assert mode is not None
    return 100 * (mode.hz / model_hz[0] - 1)


def drawn_rows(
    loops: Mapping[str, Configuration], draws: int, seed: int, show_progress: Progress
) -> tuple[list[Row], dict[str, Real]]:
    """Run every loop on the same drawn rigs.

    Return rows and, by loop, settling (ms) and overshoot of 40 µm and of 10 µm (%), (draws, 3).
    """
    scenarios = [*Family(TRUTH.model, 0, DRAWN, PERIOD_S).random_scenarios(draws, seed)]
    figures, unstable = {}, {}
    for name, configuration in loops.items():
        controller, rows = linear_controller(configuration), list[tuple[float, ...]]()
        unstable[name] = 0
        for number, truth in enumerate(scenarios):
            stable = discrete_loop(controller, TRUTH.plant(truth)).is_stable
            run = run_steps(rig_bench(configuration, truth, seed + number), SHORT_S) if stable else None
            failed = run is None or bool(run.trips)
            unstable[name] += failed
            rows.append((np.inf,) * 3 if run is None else (run.settling_ms, run.overshoot(40.0), run.overshoot(10.0)))
        figures[name] = np.array(rows)
        show_progress(f"{draws} rigs, {name}: {unstable[name]} unstable")
    rows = []
    for name in ("ours", "wide"):
        title = {"ours": "taps of robust.toml", "wide": "taps made for ±10 %"}[name]
        rows.append(Row(f"{draws} rigs drawn, {title}: unstable", "", 0.0, unstable["paper"], unstable[name]))
        for column, quantity, unit in (
            (0, "settling", "ms"),
            (1, "overshoot, 40 µm", "%"),
            (2, "overshoot, 10 µm", "%"),
        ):
            for quantile, label in ((0.5, "p50"), (0.95, "p95"), (1.0, "max")):
                paper_value, our_value = (
                    float(np.quantile(figures[loop][:, column], quantile, method="higher")) for loop in ("paper", name)
                )
                rows.append(Row(f"  {quantity}, {label}", unit, None, paper_value, our_value))
    return rows, figures
