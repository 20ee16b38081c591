"""Promise and run of `design auto --robust` from two recordings, on rigs drawn at random (`noisy_rig`).

Each rig is recorded under a slow sine and under steps; `design auto` designs for it by H∞ and by --robust. The steps of
the robust design are promised by a simulation, as in `design verify`: with all nonlinearities, on a rig after the
identified models, independent of the true rig. The same steps then run on the true rig, in virtual time, with noise of
another seed. A promise is the figure that 95 of 100 steps keep, as in a verification: the worst of a few steps would
vary from draw to draw, most of all a settling time where the overshoot comes near its band.

The exit code is 1 where an error other than a refusal occurred, a loop tripped, or a run was further than SETTLING_PART
or OVERSHOOT_POINTS from its promise.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rtloop
from rtloop.cli.auto import write_design, write_robust_design
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.design.verification.axes import verify_axis
from rtloop.design.verification.bench import Bench, HardwareModel
from rtloop.errors import RtloopError
from rtloop.hil.options import RigOptions
from rtloop.signals import trip_causes
from tests.design.modal_rigs import RATE_HZ, SINE_S, SPECIFICATION, STEPS_S, ModalRig, noisy_rig
from tests.recording.real_loop import record
from tests.soak.chain import replace_reference_by_steps
from tests.soak.draws import check_draws

HEIGHTS_UM = (1.0, 5.0, 20.0, 40.0)
CYCLES, DRAWS, KEPT = 12, 8, 0.95
"""Cycles of four steps in a run; draws of the noise; share of all steps that keep a promise."""
SETTLING_PART, OVERSHOOT_POINTS, OVERSHOOT_PART = 0.15, 1.0, 0.1
"""Largest distance of a run from its promise: share of the settling time, percentage points of overshoot; or, of steps
below SMALL_UM, which overshoot by tens of percent, a share of the overshoot.
"""
SMALL_UM = 5.0
ROBUST = """
[specification]
overshoot_percent = 1.0
[specification.command]
reference_um = {reference_um}
command_um = 43.0
[sensor]
noise_um = {noise_um}
[robust]
restarts = {restarts}
generations = {generations}
[shape]
taps = 40
points_per_tick = 3
"""


class Steps(NamedTuple):
    """Steps of one height: settling to ±5 % (ms) and overshoot (%) that the share KEPT keeps; their medians."""

    height_um: float
    settling_ms: float
    overshoot_percent: float
    medians: tuple[float, float]
    trips: tuple[str, ...]

    def agrees_with(self, promised: Steps) -> bool:
        """Return whether the figures agree with the promise; the resolution is one tick."""
        allowed_ms = max(SETTLING_PART * self.settling_ms, 1e3 / RATE_HZ)
        share = OVERSHOOT_PART if self.height_um < SMALL_UM else 0.0
        allowed_percent = max(OVERSHOOT_POINTS, share * self.overshoot_percent)
        return (
            abs(self.settling_ms - promised.settling_ms) <= allowed_ms
            and abs(self.overshoot_percent - promised.overshoot_percent) <= allowed_percent
        )

    def __str__(self) -> str:
        median_ms, median_percent = self.medians
        return (
            f"{self.settling_ms:.2f} (median {median_ms:.2f}) ms, "
            f"{self.overshoot_percent:.2f} (median {median_percent:.2f}) %"
        )


def main() -> int:
    """Check every drawn rig and print a few lines for each; return 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--restarts", type=int, default=4)
    parser.add_argument("--generations", type=int, default=300)
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.draws)
    return check_draws(
        seeds, lambda seed, folder: design_and_run(noisy_rig(seed), folder, options.restarts, options.generations)
    )


def design_and_run(rig: ModalRig, folder: Path, restarts: int, generations: int) -> tuple[bool, str]:
    """Return whether each design succeeded or was refused with code 1, and the robust one ran as promised; and text."""
    modes = " ".join(f"{hz:.0f}({damping:.3f})" for hz, damping in zip(rig.hz, rig.damping, strict=True))
    actuator = "" if rig.bouc_wen is None else ", Bouc-Wen"
    text = f"{modes} Hz{actuator}, delay {rig.delay_ticks}, noise {1e3 * (rig.noise_um or 0.0):.0f} nm"
    sine = record(folder / "sine.mcap", rig.configuration(sine=True), round(SINE_S * 1000))[0]
    steps = record(folder / "steps.mcap", rig.configuration(sine=False), round(STEPS_S * RATE_HZ))[0]
    (folder / "hinf-spec.toml").write_text(SPECIFICATION, encoding="utf-8")
    reference_um = min(40.0, float(np.floor(0.8 * rig.reach_um)))
    (folder / "spec.toml").write_text(
        ROBUST.format(reference_um=reference_um, noise_um=rig.noise_um, restarts=restarts, generations=generations),
        encoding="utf-8",
    )
    passed = True
    try:
        chain = write_design(sine, steps, folder / "hinf-spec.toml", folder / "hinf.toml")
        text += f"\n      H∞: γ {chain.synthesis.achieved:.3f}, order {chain.synthesis.controller.order}"
    except RtloopError as error:
        passed = error.exit_code == 1
        text += f"\n      H∞: refused, {error.exit_code}: {error}"
    designed = folder / "robust.toml"
    try:
        robust_chain = write_robust_design(sine, steps, folder / "spec.toml", designed)
    except RtloopError as error:
        return passed and error.exit_code == 1, f"{text}\n      robust: refused, {error.exit_code}: {error}"
    certificate, taps = robust_chain.robust.certificate, robust_chain.taps
    text += (
        f"\n      robust ±{robust_chain.design.scenarios.resonance_percent:g} %: "
        f"τ {certificate.decay_ms.value:.2f} ms, max |S| {certificate.sensitivity.value:.2f}; "
        f"{robust_chain.subject.options.taps} taps for "
        f"±{robust_chain.subject.options.scenarios.resonance_percent:g} %: {taps.proof.settling_ms:.2f} ms "
        f"{100 * taps.proof.overshoot:.2f} %; identified delay {robust_chain.stage.dynamics.delay_ticks}, "
        f"{robust_chain.stage.dynamics.model.order} poles\n      promised | measured:"
    )
    for promised, measured in promised_and_run_steps(designed):
        agrees = measured.agrees_with(promised) and not measured.trips
        passed = passed and agrees
        text += f"  {measured.height_um:g} µm {promised} | {measured}{'' if agrees else ' FAR'}"
        text += f" tripped: {', '.join(measured.trips)};" if measured.trips else ";"
    return passed, text


def promised_and_run_steps(designed: Path) -> Iterator[tuple[Steps, Steps]]:
    """Yield the steps of each height, on a rig after the identified models and on the true rig."""
    configuration = load(designed)
    verification, options = verify_axis(configuration, prepare(configuration).checks[0], None)
    (axis,) = configuration.axes
    hardware = HardwareModel(axis.model, options.sensor.noise_um, options.sensor.resolution_um, None, 0.0)
    bench = Bench(replace(configuration, driver_kind="hardware", driver_options=None), {axis.name: hardware})
    dwell_s = min(max(12 * verification.slowest_s, 0.1), 1.0)
    for height_um in (height for height in HEIGHTS_UM if height <= options.specification.command.reference_um):
        levels = (0.0, *CYCLES * (height_um, 0.0, -height_um, 0.0))
        yield (
            evaluate_steps(height_um, [bench.run(axis.name, levels, dwell_s, draw) for draw in range(DRAWS)]),
            evaluate_steps(height_um, [run_levels(designed, levels, dwell_s, draw) for draw in range(DRAWS)]),
        )


def run_levels(designed: Path, levels: Sequence[float], dwell_s: float, draw: int) -> rtloop.Recording:
    """Run the levels (µm) on the true rig, with noise of the seed `draw`; return the recording."""
    text = replace_reference_by_steps(designed.read_text(encoding="utf-8"), [*levels], dwell_s)
    rig = load(designed).driver_options
    assert isinstance(rig, RigOptions)
    text = text.replace(f"seed = {rig.seed}", f"seed = {rig.seed + 1000 + draw}")
    for old in designed.parent.glob(f"run{draw}*.mcap"):
        old.unlink()
    ticks = round(dwell_s * RATE_HZ) * len(levels)
    return rtloop.load(record(designed.with_name(f"run{draw}.mcap"), text, ticks)[0])


def evaluate_steps(height_um: float, runs: Sequence[Any]) -> Steps:
    """Return the figures of all steps in runs (columns by name): the levels after the first one, four a cycle."""
    upwards = np.tile([1, -1, -1, 1], CYCLES)[:, None] / height_um
    levels = np.vstack([run["x_true_position_um"].reshape(4 * CYCLES + 1, -1)[1:] * upwards for run in runs])
    flags = np.concatenate([run["flags"] for run in runs])
    figures = np.array([_evaluate_step(step) for step in levels])
    trips = sorted({cause for value in np.unique(flags) for cause in trip_causes(value)})
    kept_figures, median_figures = np.quantile(figures, KEPT, axis=0).tolist(), np.median(figures, axis=0).tolist()
    return Steps(height_um, *kept_figures, tuple(median_figures), tuple(trips))


def _evaluate_step(step: np.ndarray[Any, Any]) -> tuple[float, float]:
    """Return settling (ms) and overshoot (%) of a step by 1 upwards, about the mean of its last fifth."""
    beyond = step - step[-(step.size // 5) :].mean()
    outside = np.flatnonzero(np.abs(beyond) > 0.05)
    return 1e3 * (outside[-1] + 1 if outside.size else 0) / RATE_HZ, 100 * max(0.0, float(beyond.max()))


if __name__ == "__main__":
    sys.exit(main())
