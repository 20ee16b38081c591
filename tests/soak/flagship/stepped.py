"""Steps on the rig: as configured, with the resonance elsewhere, with taps made for it, and on rigs drawn at random."""

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
    bench,
    changed,
    controller_of,
    shifted,
    steps,
    subject,
    taps_for,
    trace,
    with_taps,
)
from tests.soak.flagship.table import Row

SEEDS = (1, 2, 3)
"""Of the sensor's noise; the worst is said."""
SHIFTS = tuple(float(percent) for percent in range(-10, 11))
RETUNED = (-10.0, -5.0, 0.0, 5.0, 10.0)
TRACED, TRACED_UM = (-10.0, 0.0, 10.0), 40.0
RETUNED_WITHIN, RETUNED_OVERSHOOT = 0.5, 0.0005
"""Percent around the measured resonance that taps are made for; overshoot that they may have on the model."""
WIDE, WIDE_OVERSHOOT, WIDE_MS = 10.0, 0.002, 3.2
"""The same of taps made for all of ±10 %, and when they settle."""
DRAWN = ScenarioOptions(resonance_percent=10.0, damping=(0.5, 2.0), gain_percent=2.0)
Say = Callable[[str], None]


class Worst(NamedTuple):
    """Of several runs of steps: ms, % of 40 µm, % of 10 µm, %, V."""

    settling_ms: float
    overshoot: float
    overshoot_small: float
    static: float
    peak_v: float


def worst(runs: Sequence[Steps]) -> Worst:
    """Of each quantity."""
    return Worst(
        max(one.settling_ms for one in runs), max(one.overshoot(40.0) for one in runs),
        max(one.overshoot(10.0) for one in runs), max(one.static_percent for one in runs),
        max(one.peak_v for one in runs),
    )  # fmt: skip


def as_configured(paper: Configuration, ours: Configuration) -> list[Row]:
    """Eight steps, every seed; also with a worse sensor, and without an identification of one's own."""
    runs = {name: [steps(bench(one, seed=seed)) for seed in SEEDS] for name, one in (("paper", paper), ("ours", ours))}
    theirs, mine = worst(runs["paper"]), worst(runs["ours"])
    limits = {name: sorted({limit for one in some for limit in one.limited}) for name, some in runs.items()}
    said = "; ".join(f"{name} limits {' and '.join(found) or 'nothing'}" for name, found in limits.items())
    rows = [
        Row("eight steps: settling", "ms", 3.0, theirs.settling_ms, mine.settling_ms),
        Row("  overshoot, 40 µm", "%", 0.1, theirs.overshoot, mine.overshoot),
        Row("  overshoot, 10 µm", "%", 0.2, theirs.overshoot_small, mine.overshoot_small),
        Row("  static error", "%", 0.02, theirs.static, mine.static),
        Row("  largest |u|", "V", 9.98, theirs.peak_v, mine.peak_v, note=said),
    ]
    noisy = [worst([steps(bench(one, seed=seed, noise_um=0.1)) for seed in SEEDS]) for one in (paper, ours)]
    rows += [
        Row("sensor of 100 nm: settling", "ms", None, noisy[0].settling_ms, noisy[1].settling_ms),
        Row("  overshoot, 40 µm", "%", None, noisy[0].overshoot, noisy[1].overshoot),
    ]
    printed = paper.axes[0].feedforward.model_copy(update={"dead_band": "exact"})
    other = worst([steps(bench(changed(ours, feedforward=printed), seed=seed)) for seed in SEEDS])
    rows += [
        Row("eq (4) in place of an identification: settling", "ms", None, theirs.settling_ms, other.settling_ms),
        Row("  overshoot, 40 µm", "%", None, theirs.overshoot, other.overshoot),
    ]
    return rows


class Shifted(NamedTuple):
    """Steps by loop and shift of the resonance in %; traces of one step, the same way; the loop with taps for ±10 %."""

    steps: Mapping[str, Mapping[float, Steps]]
    traces: Mapping[str, Mapping[float, tuple[Real, Real]]]
    wide: Configuration


def over_shift(paper: Configuration, ours: Configuration, say: Say) -> tuple[list[Row], Shifted]:
    """The resonance anywhere: taps as they are, made for ±10 %, made for where it was measured."""
    about = subject(ours)
    wide = with_taps(ours, taps_for(about, about.plant, WIDE, WIDE_OVERSHOOT, WIDE_MS))
    found: dict[str, dict[float, Steps]] = {
        name: {percent: steps(bench(one, shifted(percent)), DWELL_S) for percent in SHIFTS}
        for name, one in (("paper", paper), ("ours", ours), ("wide", wide))
    }
    traces = {name: {percent: trace(bench(one, shifted(percent)), TRACED_UM) for percent in TRACED}
              for name, one in (("paper", paper), ("ours", ours))}  # fmt: skip
    traces["retuned"] = {}
    say("resonance shifted: done; taps are made anew")
    found["retuned"], errors = {}, []
    for percent in RETUNED:
        seen = measured_percent(ours, percent)
        errors.append(abs(seen - percent))
        taps = taps_for(about, shift_resonance(about.plant, seen), RETUNED_WITHIN, RETUNED_OVERSHOOT)
        retuned = with_taps(ours, taps)
        found["retuned"][percent] = steps(bench(retuned, shifted(percent)))
        if percent in TRACED:
            traces["retuned"][percent] = trace(bench(retuned, shifted(percent)), TRACED_UM)
        say(f"resonance at {percent:+g} %, measured {seen:+.3f} %")
    rows = []
    for name, title, limits in (
        ("ours", "taps of robust.toml", ((3.0, 3.1, 0.3), (5.0, 3.8, 0.6), (10.0, 3.8, 1.5))),
        ("wide", "taps made for ±10 %", ((10.0, 3.3, 0.3),)),
        ("retuned", f"taps retuned, measured to {max(errors):.2g} %", ((10.0, 3.1, 0.2),)),
    ):
        for within, settling_ms, overshoot in limits:
            some = worst([one for percent, one in found[name].items() if abs(percent) <= within])
            theirs = worst([one for percent, one in found["paper"].items() if abs(percent) <= within])
            rows += [
                Row(f"resonance ±{within:g} %, {title}: settling", "ms", settling_ms, theirs.settling_ms,
                    some.settling_ms),
                Row("  overshoot, 40 µm", "%", overshoot, theirs.overshoot, some.overshoot),
                Row("  overshoot, 10 µm", "%", None, theirs.overshoot_small, some.overshoot_small),
            ]  # fmt: skip
    return rows, Shifted(found, traces, wide)


def measured_percent(configuration: Configuration, truth_percent: float) -> float:
    """Where the resonance is, in % of the model's, by the experiment `response` on the rig: a small multisine."""
    (axis,) = configuration.axes
    assert axis.model is not None
    options = response.ResponseOptions()
    (run,) = response.runs(options, Setting(RATE_HZ, axis, is_virgin=True))
    (wave,) = [one["levels"] for one in run.timeline.references if one["kind"] == "steps"]
    recorded = bench(configuration, shifted(truth_percent)).run("x", wave * (options.periods + 1), PERIOD_S)
    signals = {name: recorded[f"x_{name}"] for name in ("reference_um", "error_um", "command_um", "position_um")}
    model_hz = resonance_hz(axis.model.transfer())
    assert model_hz is not None
    mode = measure_loop(
        signals,
        RATE_HZ,
        model_hz[0],
        discrete_loop(controller_of(configuration), axis.model.transfer()),
        axis.prefilter.command_taps,
    ).mode
    assert mode is not None
    return 100 * (mode.hz / model_hz[0] - 1)


def drawn(loops: Mapping[str, Configuration], draws: int, seed: int, say: Say) -> tuple[list[Row], dict[str, Real]]:
    """The same rigs for every loop: settling in ms, overshoot of 40 µm and of 10 µm in %, (draws, 3) each."""
    scenarios = [*Family(TRUTH.model, 0, DRAWN, PERIOD_S).random_scenarios(draws, seed)]
    found, unstable = {}, {}
    for name, one in loops.items():
        linear, rows = controller_of(one), list[tuple[float, ...]]()
        unstable[name] = 0
        for number, truth in enumerate(scenarios):
            stable = discrete_loop(linear, TRUTH.plant(truth)).is_stable
            ran = steps(bench(one, truth, seed + number), SHORT_S) if stable else None
            bad = ran is None or bool(ran.trips)
            unstable[name] += bad
            rows.append((np.inf,) * 3 if ran is None else (ran.settling_ms, ran.overshoot(40.0), ran.overshoot(10.0)))
        found[name] = np.array(rows)
        say(f"{draws} rigs, {name}: {unstable[name]} unstable")
    rows = []
    for name in ("ours", "wide"):
        title = {"ours": "taps of robust.toml", "wide": "taps made for ±10 %"}[name]
        rows.append(Row(f"{draws} rigs drawn, {title}: unstable", "", 0.0, unstable["paper"], unstable[name]))
        for column, words, unit in ((0, "settling", "ms"), (1, "overshoot, 40 µm", "%"), (2, "overshoot, 10 µm", "%")):
            for part, label in ((0.5, "p50"), (0.95, "p95"), (1.0, "max")):
                theirs, mine = (
                    float(np.quantile(found[one][:, column], part, method="higher")) for one in ("paper", name)
                )
                rows.append(Row(f"  {words}, {label}", unit, None, theirs, mine))
    return rows, found
