"""From two recordings to a loop that damps its resonance, on rigs drawn at random (`noisy_rig`). `make soak-robust`.

Each rig is recorded under a slow sine and under steps; `design auto` designs for it in both ways; what --robust wrote
then runs steps up and down, each many times, in virtual time, with noise on. A row says what was promised and what was
seen, of the mean of all cycles, in which the noise is a fifth (1 µm: of single steps); or the refusal.
 Ends with 1 where an error other than a
refusal came, a loop tripped, or a run was further from its promise than LIMITS. Promised is the linear step; for steps
of 1 µm, of which the dead band and what the inverse leaves are a large part, the simulated one.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

import rtloop
from rtloop.commands.design import verified
from rtloop.commands.design_auto import write_design, write_robust_design
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.design.verification.bench import Bench
from rtloop.design.verification.simulated import simulate
from rtloop.errors import RtloopError
from rtloop.hil.options import RigOptions
from rtloop.hil.stages.hysteresis import THRESHOLDS_V
from rtloop.recording.views.steps import step_metrics
from rtloop.signals import trip_causes
from tests.design.modal_rigs import RATE_HZ, SINE_S, SPECIFICATION, STEPS_S, ModalRig, noisy_rig
from tests.recording.real_loop import record

HEIGHTS_UM, SMALL_UM = (5.0, 20.0, 40.0), 1.0
CYCLES = 24
SETTLING_PART, OVERSHOOT_POINTS = 0.15, 1.0
"""How far a run may be from its promise."""
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


class Seen(NamedTuple):
    """Of a step, up or down: settling to ±5 % in ms and overshoot in percent; what tripped the loop."""

    settling_ms: float
    overshoot_percent: float
    trips: tuple[str, ...] = ()

    def near(self, promised: Seen) -> bool:
        """Within LIMITS; a tick is what a record can tell."""
        allowed_ms = max(SETTLING_PART * promised.settling_ms, 1e3 / RATE_HZ)
        settles = abs(self.settling_ms - promised.settling_ms) <= allowed_ms
        return settles and abs(self.overshoot_percent - promised.overshoot_percent) <= OVERSHOOT_POINTS


def main() -> int:
    """Every draw, a few lines each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--restarts", type=int, default=4)
    parser.add_argument("--generations", type=int, default=300)
    given = parser.parse_args()
    bad = 0
    for seed in range(given.seed, given.seed + given.draws):
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            good, words = one(noisy_rig(seed), Path(folder), given.restarts, given.generations)
        bad += not good
        print(f"{seed:3} {words}  [{time.perf_counter() - started:.0f} s]{'' if good else '  BAD'}", flush=True)
    print(f"{given.draws} rigs, {bad} bad")
    return int(bad > 0)


def one(rig: ModalRig, folder: Path, restarts: int, generations: int) -> tuple[bool, str]:
    """Whether both ways designed or refused by code 1 and the robust one ran as promised; and what there is to say."""
    modes = " ".join(f"{hz:.0f}({damping:.3f})" for hz, damping in zip(rig.hz, rig.damping, strict=True))
    words = f"{modes} Hz, delay {rig.delay_ticks}, noise {1e3 * (rig.noise_um or 0.0):.0f} nm"
    sine = record(folder / "sine.mcap", rig.configuration(sine=True), round(SINE_S * 1000))[0]
    steps = record(folder / "steps.mcap", rig.configuration(sine=False), round(STEPS_S * RATE_HZ))[0]
    (folder / "hinf-spec.toml").write_text(SPECIFICATION, encoding="utf-8")
    reference_um = min(40.0, float(np.floor(0.8 * reach_um(rig))))
    (folder / "spec.toml").write_text(
        ROBUST.format(reference_um=reference_um, noise_um=rig.noise_um, restarts=restarts, generations=generations),
        encoding="utf-8",
    )
    good = True
    try:
        chain = write_design(sine, steps, folder / "hinf-spec.toml", folder / "hinf.toml")
        words += f"\n      H∞: γ {chain.synthesis.achieved:.3f}, order {chain.synthesis.controller.order}"
    except RtloopError as error:
        good = error.exit_code == 1
        words += f"\n      H∞: refused, {error.exit_code}: {error}"
    written = folder / "robust.toml"
    try:
        found = write_robust_design(sine, steps, folder / "spec.toml", written)
    except RtloopError as error:
        return good and error.exit_code == 1, f"{words}\n      robust: refused, {error.exit_code}: {error}"
    proof, taps = found.robust.certificate, found.taps
    words += (
        f"\n      robust ±{found.design.scenarios.resonance_percent:g} %: τ {proof.decay_ms.value:.2f} ms, "
        f"max |S| {proof.sensitivity.value:.2f}; {found.subject.options.taps} taps for "
        f"±{found.subject.options.scenarios.resonance_percent:g} %: {taps.proof.settling_ms:.2f} ms "
        f"{100 * taps.proof.overshoot:.2f} %; found delay {found.stage.dynamics.delay_ticks}, "
        f"{found.stage.dynamics.model.order} poles\n      promised | seen:"
    )
    linear, small, dwell_s = promised(written)
    for height_um in (SMALL_UM, *(height for height in HEIGHTS_UM if height <= reference_um)):
        expected = small if height_um == SMALL_UM else linear
        seen = run(written, height_um, dwell_s, averaged=height_um != SMALL_UM)
        near = seen.near(expected) and not seen.trips
        good = good and near
        words += (
            f"  {height_um:g} µm {expected.settling_ms:.2f} ms {expected.overshoot_percent:.2f} % | "
            f"{seen.settling_ms:.2f} ms {seen.overshoot_percent:.2f} %{'' if near else ' FAR'}"
            + (f" tripped: {', '.join(seen.trips)}" if seen.trips else "")
            + ";"
        )
    return good, words


def reach_um(rig: ModalRig) -> float:
    """What 10 V reach from rest."""
    return float(np.sum(rig.weights_um_per_v * (10.0 - np.array(THRESHOLDS_V))))


def promised(written: Path) -> tuple[Seen, Seen, float]:
    """The linear step, the simulated one of SMALL_UM, and how long a level lasts."""
    configuration = load(written)
    found, design = verified(configuration, prepare(configuration).checks[0], None)
    rows = {row.name: row.running for row in found.rows}
    asked = design.model_copy(update={"simulation": design.simulation.model_copy(update={"steps_um": (SMALL_UM,)})})
    (step,) = simulate(Bench(configuration, {}), configuration.axes[0], found.slowest_s, asked).steps
    linear = Seen(float(rows["settling_ms"] or np.nan), float(rows["overshoot_percent"] or 0.0))
    return linear, Seen(step.settling_ms, step.overshoot_percent), min(max(12 * found.slowest_s, 0.1), 1.0)


def run(written: Path, height_um: float, dwell_s: float, *, averaged: bool) -> Seen:
    """CYCLES steps up and down under another seed than the verification's; the worse of both means, or, as simulated
    steps are judged, the worst of the first four.
    """
    configuration = load(written)
    rig = configuration.driver_options
    assert isinstance(rig, RigOptions)
    levels = f'kind = "steps"\nlevels = [0.0, {height_um}]\ndwell_s = {dwell_s}'
    text = written.read_text(encoding="utf-8").replace('kind = "hold"\nvalue = 0.0', levels)
    text = text.replace(f"seed = {rig.seed}", f"seed = {rig.seed + 1000}")
    ticks = round(dwell_s * RATE_HZ)
    for old in written.parent.glob("run*.mcap"):
        old.unlink()
    recording = rtloop.load(record(written.with_name("run.mcap"), text, 2 * ticks * (CYCLES + 1))[0])
    trips = sorted({cause for value in np.unique(recording["flags"]) for cause in trip_causes(value)})
    if not averaged:
        first = slice(0, 5 * ticks)
        worst = step_metrics(recording["x_reference_um"][first], recording["x_true_position_um"][first], RATE_HZ)
        assert worst is not None
        return Seen(worst.settling_time_ms_worst, worst.overshoot_percent_worst, tuple(trips))
    cycles = recording["x_true_position_um"].reshape(CYCLES + 1, 2, ticks)[1:]
    low, high = cycles.mean(axis=0)
    sides = [
        judged((high - low[-1]) / (np.mean(high[-100:]) - low[-1])),
        judged((high[-1] - low) / (high[-1] - np.mean(low[-100:]))),
    ]
    settling_ms, overshoot_percent = np.max(sides, axis=0).tolist()
    return Seen(settling_ms, overshoot_percent, tuple(trips))


def judged(step: np.ndarray) -> tuple[float, float]:
    """Settling in ms and overshoot in percent of a step from 0 to 1, at ticks."""
    outside = np.flatnonzero(np.abs(step - 1) > 0.05)
    return 1e3 * (outside[-1] + 1 if outside.size else 0) / RATE_HZ, 100 * max(0.0, float(step.max()) - 1)


if __name__ == "__main__":
    sys.exit(main())
