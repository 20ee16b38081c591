"""A stage of 800 Hz behind a lag and a delay: its delay, the promise of its design, the worth of ±.

Ten rigs go through the commands `run`, `design auto`, `run`. The delay must be the rig's, the promised steps those of
an unpaced run, and the exit code that of a judgement of this run; so, too, for the design with its gain tripled. Then
`--draws` identifications of the first rig: how often ± (95 %) covers the truth (`delay_coverage`).
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rtloop
from rtloop.recording.views.steps import measure_steps
from tests.soak.chain import with_steps
from tests.soak.delay_coverage import coverage
from tests.soak.lagged_rig import DEPLOY, NOISE_UM, RIGS, Rig, with_value

STEP_UM, DWELL_S, CYCLES = 10.0, 0.1, 6
SETTLING_PART, OVERSHOOT_POINTS = 0.15, 1.0
"""How far a run may be from its promise."""


def command(*arguments: object) -> tuple[int, str]:
    """Run `rtloop`; its exit code and output."""
    words = [sys.executable, "-m", "rtloop", *map(str, arguments)]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    if ended.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(words)}: {ended.returncode}\n{ended.stderr}")
    return ended.returncode, ended.stdout


def recorded(config: Path, duration_s: float) -> Path:
    """Record an unpaced run of a configuration; the only file of its folder."""
    folder = config.with_suffix("")
    command("run", config, "--duration", duration_s, "--unpaced", "--out", folder)
    (path,) = folder.glob("*.mcap")
    return path


class Steps(NamedTuple):
    """Medians over steps: overshoot in %, settling in ms, static error in %."""

    overshoot_percent: float
    settling_ms: float
    static_error_percent: float

    def near(self, promised: Steps) -> bool:
        """Whether a run is as promised; a tick is what a record can tell."""
        allowed_ms = max(SETTLING_PART * self.settling_ms, 0.1)
        return (
            abs(self.settling_ms - promised.settling_ms) <= allowed_ms
            and abs(self.overshoot_percent - promised.overshoot_percent) <= OVERSHOOT_POINTS
        )

    @property
    def meets(self) -> bool:
        """Whether a run keeps deploy/own-stage-spec.toml."""
        return self.overshoot_percent <= 1.0 and self.settling_ms <= 6.0 and self.static_error_percent <= 0.2

    def __str__(self) -> str:
        return f"{self.settling_ms:.2f} ms {self.overshoot_percent:.2f} % ({self.static_error_percent:.3f} % static)"


def run_steps(config: Path) -> Steps:
    """Steps of STEP_UM up and down of a configuration in closed loop, seen without the sensor's noise."""
    text = config.read_text(encoding="utf-8")
    levels = [0.0, *CYCLES * [STEP_UM, 0.0]]
    running = config.with_name(f"{config.stem}-steps.toml")
    running.write_text(with_steps(text, levels, DWELL_S), encoding="utf-8")
    run = rtloop.load(recorded(running, len(levels) * DWELL_S))
    table = measure_steps(run["x_reference_um"], run["x_true_position_um"], 1e4)
    return Steps(*(np.median(table, axis=0) if table is not None else [np.nan] * 3))


def promised_of(report: dict[str, Any]) -> Steps:
    """The linear figures of a verification, as it runs."""
    rows = {row["name"]: row["running"] for row in report["axes"][0]["rows"]}
    return Steps(*(float("nan" if rows[name] is None else rows[name]) for name in Steps._fields))


def one_rig(rig: Rig, folder: Path) -> bool:
    """Print a line; whether delay, promise and exit codes are right."""
    paths = []
    for name, duration_s in (("own-stage-sine", 25.0), ("own-stage", 1.0)):
        config = folder / f"{name}.toml"
        config.write_text(rig.text(name, 1), encoding="utf-8")
        paths.append(recorded(config, duration_s))
    specs = folder / "spec.toml"
    specs.write_text(with_value((DEPLOY / "own-stage-spec.toml").read_text(encoding="utf-8"), "noise_um", NOISE_UM))
    designed = folder / "designed.toml"
    code, output = command("design", "auto", *paths, "--specs", specs, "--out", designed, "--json")
    promised, seen = promised_of(json.loads(output)), run_steps(designed)
    delay_ticks = int(re.findall(r"(?m)^delay_ticks = (\d+)", designed.read_text(encoding="utf-8"))[0])
    bad_code, bad_seen = tripled(designed)
    good = (
        delay_ticks == rig.delay_ticks
        and seen.near(promised)
        and seen.meets == (code == 0)
        and bad_seen.meets == (bad_code == 0)
    )
    print(
        f"lag {rig.lag_hz:g} Hz, delay {rig.delay_ticks}: identified {delay_ticks}; promised {promised}, ran {seen}, "
        f"exit {code}; gain × 3: exit {bad_code}, ran {bad_seen}{'' if good else '  BAD'}",
        flush=True,
    )
    return good


def tripled(designed: Path) -> tuple[int, Steps]:
    """The exit code of `design verify` for the controller with three times its gain, and its steps."""
    text = designed.read_text(encoding="utf-8")
    head, section = text.split("[axis.controller]\n")
    gain = float(re.findall(r"(?m)^gain = (.*)$", section)[0])
    bad = designed.with_name("bad.toml")
    changed = re.sub(r"(?m)^gain = .*$", f"gain = {3 * gain!r}", section, count=1)
    bad.write_text(f"{head}[axis.controller]\n{changed}", encoding="utf-8")
    return command("design", "verify", bad)[0], run_steps(bad)


def main() -> int:
    """Rigs, then coverage; 1 where a figure is not as it must be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=50, help="identifications of the first rig; 0 for none")
    parser.add_argument("--rigs", type=int, default=len(RIGS), help="how many of the rigs; 0 for none")
    given = parser.parse_args()
    bad = 0
    for rig in RIGS[: given.rigs]:
        with tempfile.TemporaryDirectory() as folder:
            bad += not one_rig(rig, Path(folder))
    print(f"{given.rigs} rigs, {bad} bad")
    covers = coverage(RIGS[0], given.draws) if given.draws else True
    return int(bad > 0 or not covers)


if __name__ == "__main__":
    sys.exit(main())
