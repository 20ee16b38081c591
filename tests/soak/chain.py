"""From two recordings to a controller that runs, on rigs drawn at random, every step by its command. `make soak-chain`.

A rig's weights are those of eq (4) ± 20 %, its resonance is ± 10 % off. The written configuration then runs a step of
20 µm on that rig, noise and quantisation on, and is held against what the verification promised on the identified
model. A draw whose recording is rightly refused (a 10 V step beyond the position interlock) is counted apart.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import rtloop
from hil.hysteresis import NOMINAL_WEIGHTS_UM_PER_V, THRESHOLDS_V

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
STEP_UM, DWELL_S, RATE_HZ = 20.0, 0.5, 10_000
SECONDS = {"characterise": 25, "step-response": 1}
LIMITS = {"settling_ms": 0.5, "step": 0.05, "overshoot_percent": 3.0, "static_percent": 0.2}
"""How far a run may be from the promise: settling, the step at each reported time, overshoot, static error."""
SMALLEST_SUM = 0.3


def main() -> int:
    """Every draw, a line each, and the largest distances; 1 where a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    found: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(given.seed, given.seed + given.draws):
            distances = one(seed, Path(folder))
            if distances is not None:
                found.append(distances)
                print(
                    f"rig {seed}: " + ", ".join(f"{name} {value:.4f}" for name, value in distances.items()), flush=True
                )
    print(f"{len(found)} of {given.draws} rigs were designed for; largest distance from the promise:")
    largest = {name: max(distances[name] for distances in found) for name in LIMITS}
    for name, limit in LIMITS.items():
        print(f"  {name:20}{largest[name]:10.4f}  (limit {limit:g})")
    return int(any(largest[name] > limit for name, limit in LIMITS.items()))


def one(seed: int, folder: Path) -> dict[str, float] | None:
    """Distances from the promise on one rig; None where its step was refused."""
    recordings = []
    plant = drawn_plant(seed)
    for name, seconds in SECONDS.items():
        config = folder / f"{name}-{seed}.toml"
        text = (DEPLOY / f"{name}.toml").read_text()
        config.write_text(re.sub(r"\[driver\.plant\.hysteresis\]\ntruth = [^\n]*\n", lambda _: plant, text))
        summary = command("run", config, "--unpaced", "--duration", seconds, "--out", folder, "--json")
        recordings.append(summary["recording"])
    written = folder / f"designed-{seed}.toml"
    specification = DEPLOY / "paper-spec.toml"
    verdict = command("design", "auto", *recordings, "--specs", specification, "--out", written, "--json")
    if "error" in verdict:
        print(f"rig {seed}: refused: {verdict['error'].rpartition('/')[2]}")
        return None
    promised = command("check", written, "--json")["axes"][0]["running"]
    stepping = folder / f"stepping-{seed}.toml"
    levels = f'kind = "steps"\nlevels = [{STEP_UM}, 0.0]\ndwell_s = {DWELL_S}'
    stepping.write_text(written.read_text().replace('kind = "hold"\nvalue = 0.0', levels))
    summary = command("run", stepping, "--unpaced", "--duration", 2 * DWELL_S, "--out", folder, "--json")
    assert summary["trips"] == [], summary["trips"]
    return distances_from(promised, rtloop.load(summary["recording"])["x_true_position_um"])


def distances_from(promised: dict[str, Any], position_um: np.ndarray[Any, Any]) -> dict[str, float]:
    """How far the first step (ticks,) is from what was promised."""
    step = position_um[: round(DWELL_S * RATE_HZ)] / STEP_UM
    final = float(np.mean(step[-500:]))
    settling_s = (np.flatnonzero(np.abs(step / final - 1) > 0.05)[-1] + 1) / RATE_HZ
    times = zip(promised["step_times_s"], promised["step_position"], strict=True)
    return {
        "settling_ms": 1e3 * abs(settling_s - promised["settling_time_s"]),
        "step": max(abs(float(step[round(time_s * RATE_HZ)]) - value) for time_s, value in times),
        "overshoot_percent": 100 * (float(np.max(step)) - 1) - promised["overshoot_percent"],
        "static_percent": abs(100 * abs(final - 1) - promised["static_error_percent"]),
    }


def drawn_plant(seed: int) -> str:
    """The rig's section of a configuration."""
    random = np.random.default_rng(seed)
    weights = np.zeros(1)
    while np.any(np.cumsum(weights) < SMALLEST_SUM):
        weights = np.array(NOMINAL_WEIGHTS_UM_PER_V) * (1 + random.uniform(-0.2, 0.2, len(NOMINAL_WEIGHTS_UM_PER_V)))
    return (
        f'[driver.plant.hysteresis]\ntruth = "custom"\nthresholds_v = {list(THRESHOLDS_V)}\n'
        f"weights_um_per_v = {weights.tolist()}\n"
        f"[driver.plant.dynamics]\nresonance_shift = {random.uniform(-0.1, 0.1)}\n"
    )


def command(*arguments: Any) -> dict[str, Any]:
    """The JSON that a command prints."""
    line = [sys.executable, "-m", "rtloop", *map(str, arguments)]
    return json.loads(subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False).stdout)


if __name__ == "__main__":
    sys.exit(main())
