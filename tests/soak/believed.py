"""What `design verify` says of steps and rest beside what recorded runs show, drawn at random. `make soak-verify`.

The paper's loop, also with the rig's resonance moved where the model is not, and a stage that `design auto` designed
for; steps of 1 to 40 µm. Seen is a recording under another seed than the simulation's, judged at ticks. Ends with 1
where more than one run in twenty is further from what is simulated than LIMITS: a loop hunts in a dead band at random.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import rtloop
from rtloop.cli.auto import write_design
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.design.verification.axes import verify_axis
from rtloop.design.verification.bench import Bench
from rtloop.design.verification.simulation import REST_PLACES, REST_S, SETTLING_S, STEP_QUANTILE, simulate
from rtloop.recording.views.steps import measure_steps
from tests.recording.real_loop import ROOT, record

DEPLOY = ROOT / "deploy"
DWELL_S, CYCLES = 0.5, 5
"""Of four steps each."""
COLUMNS = ("OS %", "ts ms", "x nm", "v nm")
LIMITS = (3.0, 15.0, 3.0, 60.0)
"""How far a simulation may be from a run, each being one draw of the noise: so much, or half of what is seen."""
MOST_FAR = 0.05
REFERENCE = 'kind = "steps"\nlevels = {levels}\ndwell_s = {dwell_s}\nrepeat = false\n'


@dataclass(frozen=True)
class Stage:
    """A configuration whose [axis.reference] is cut off, with `seed = 1` in it."""

    name: str
    head: str
    tail: str
    reach_um: float
    specification: str

    def text(self, levels: list[float], dwell_s: float, seed: int) -> str:
        """With steps, under another seed."""
        assert self.head.count("seed = 1") == 1
        reference = REFERENCE.format(levels=[float(level) for level in levels], dwell_s=dwell_s)
        return self.head.replace("seed = 1", f"seed = {seed}") + reference + self.tail


def paper(shift: float) -> Stage:
    """The paper's loop on its rig, whose resonance is moved by a part of it."""
    text = (DEPLOY / "paper.toml").read_text(encoding="utf-8")
    text = text.replace("# [driver.plant.dynamics]", "[driver.plant.dynamics]")
    text = text.replace("# resonance_shift = 0.0", f"resonance_shift = {shift}")
    head, rest = text.split("[axis.reference]\n")
    return Stage(
        f"paper {100 * shift:+.1f} %",
        f"{head}[axis.reference]\n",
        rest[rest.index("[recording]") :],
        40.0,
        "paper-spec.toml",
    )


def own_stage(folder: Path) -> Stage:
    """What `design auto` writes for deploy/own-stage.toml."""
    paths = [
        record(folder / f"{name}.mcap", (DEPLOY / f"{name}.toml").read_text(encoding="utf-8"), ticks)[0]
        for name, ticks in (("own-stage-sine", 25_000), ("own-stage", 10_000))
    ]
    out = folder / "own.toml"
    write_design(paths[0], paths[1], DEPLOY / "own-stage-spec.toml", out)
    head, rest = out.read_text(encoding="utf-8").split("[axis.reference]\n")
    at = rest.find("[", 1)
    return Stage("own stage", f"{head}[axis.reference]\n", rest[at:] if at >= 0 else "", 20.0, "own-stage-spec.toml")


def one(stage: Stage, height_um: float, seed: int, folder: Path) -> tuple[list[float], list[float], list[float]]:
    """Overshoot, settling, noise in x and v: linear, simulated, seen."""
    text = stage.text([0.0], 1.0, seed)
    configuration = parse(text, "believed", folder, "believed.toml")
    check = prepare(configuration).checks[0]
    found, design = verify_axis(configuration, check, DEPLOY / stage.specification)
    rows = {row.name: row.running for row in found.rows}
    linear = [rows[name] for name in ("overshoot_percent", "settling_ms", "noise_x_nm", "noise_v_nm")]
    asked = design.model_copy(update={"simulation": design.simulation.model_copy(update={"steps_um": (height_um,)})})
    simulated = simulate(Bench(configuration, {}), configuration.axes[0], found.slowest_s, asked)
    (step,) = simulated.steps
    predicted = [step.overshoot_percent, step.settling_ms, simulated.noise_x_nm, simulated.noise_v_nm]
    return [float(value or np.nan) for value in linear], predicted, seen(stage, height_um, seed + 1000, folder)


def seen(stage: Stage, height_um: float, seed: int, folder: Path) -> list[float]:
    """The same of recordings."""
    text = stage.text([0.0, *CYCLES * (height_um, 0.0, -height_um, 0.0)], DWELL_S, seed)
    taken = recorded(folder / "steps.mcap", text, (1 + 4 * CYCLES) * DWELL_S)
    table = measure_steps(taken["x_reference_um"], taken["x_true_position_um"], 1e4)
    assert table is not None
    overshoot_percent, settling_ms, _ = np.quantile(table, STEP_QUANTILE, axis=0)
    squares = []
    for number, part in enumerate(REST_PLACES):
        text = stage.text([part * stage.reach_um], SETTLING_S + REST_S, seed + 10_000 * number)
        rest = recorded(folder / f"rest{number}.mcap", text, SETTLING_S + REST_S)
        last = round(SETTLING_S * 1e4)
        squares.append([rest[name][last:].var() for name in ("x_true_position_um", "x_command_um")])
    return [overshoot_percent, settling_ms, *(1e3 * np.sqrt(np.mean(squares, axis=0)))]


def recorded(path: Path, text: str, duration_s: float) -> rtloop.Recording:
    """A run in virtual time, read back."""
    for old in path.parent.glob(f"{path.stem}*"):
        old.unlink()
    return rtloop.load(record(path, text, round(duration_s * 1e4))[0])


def main() -> int:
    """A line a run, then what the differences come to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    random, differences, bad = np.random.default_rng(given.seed), [], 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        own = own_stage(folder)
        print(f"{'':16} {'step':>6}  " + "  ".join(f"{column + ': linear, simulated, seen':>30}" for column in COLUMNS))
        for number in range(given.draws):
            stage = own if number % 3 == 2 else paper(float(np.round(random.uniform(-0.03, 0.012), 3)) * (number % 3))
            height_um = float(np.round(np.exp(random.uniform(0, np.log(stage.reach_um))), 1))
            linear, simulated, real = one(stage, height_um, int(random.integers(1, 1000)), folder)
            far = [abs(a - b) > max(limit, 0.5 * b) for a, b, limit in zip(simulated, real, LIMITS, strict=True)]
            bad += any(far)
            differences.append([np.subtract(linear, real), np.subtract(simulated, real)])
            cells = "  ".join(f"{a:9.2f} {b:9.2f} {c:9.2f} " for a, b, c in zip(linear, simulated, real, strict=True))
            print(f"{stage.name:16} {height_um:6.1f}  {cells}{'  FAR' if any(far) else ''}", flush=True)
    sizes = np.abs(differences)
    for row, title in ((0, "linear"), (1, "simulated")):
        for quantile, words in ((0.5, "median"), (1.0, "largest")):
            values = zip(COLUMNS, np.quantile(sizes[:, row], quantile, axis=0), strict=True)
            print(f"{title} − seen, {words}: " + "  ".join(f"{column} {value:.2f}" for column, value in values))
    print(f"{given.draws} runs, {bad} far")
    return int(bad > MOST_FAR * given.draws)


if __name__ == "__main__":
    sys.exit(main())
