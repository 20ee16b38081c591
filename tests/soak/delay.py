"""Stages of 800 Hz with a lag and a delay: identified delay, promise of the design, and coverage of ±.

Ten rigs go through the commands `run`, `design auto`, `run`. The identified delay must equal the rig's, the promised
steps must agree with an unpaced run, and the exit code with the verdict on this run; the exit code must do so for a
tripled gain too. Then `--draws` identifications of the first rig: how often ± (95 %) covers the truth (delay_coverage).
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
from tests.soak.chain import replace_reference_by_steps
from tests.soak.delay_coverage import check_coverage
from tests.soak.lagged_rig import DEPLOY, NOISE_UM, RIGS, Rig, replace_value

STEP_UM, DWELL_S, CYCLES = 10.0, 0.1, 6
SETTLING_PART, OVERSHOOT_POINTS = 0.15, 1.0
"""Largest distance of a run from its promise: share of the settling time, percentage points of overshoot."""


def run_command(*arguments: object) -> tuple[int, str]:
    """Run `rtloop`; return its exit code, 0 or 1, and output. Raises RuntimeError for other exit codes."""
    words = [sys.executable, "-m", "rtloop", *map(str, arguments)]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    if ended.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(words)}: {ended.returncode}\n{ended.stderr}")
    return ended.returncode, ended.stdout


def record_run(config: Path, duration_s: float) -> Path:
    """Record an unpaced run of a configuration; return the path of the recording."""
    folder = config.with_suffix("")
    run_command("run", config, "--duration", duration_s, "--unpaced", "--out", folder)
    (path,) = folder.glob("*.mcap")
    return path


class Steps(NamedTuple):
    """Medians over steps: overshoot in %, settling in ms, static error in %."""

    overshoot_percent: float
    settling_ms: float
    static_error_percent: float

    def agrees_with(self, promised: Steps) -> bool:
        """Return whether settling and overshoot agree with the promise; the resolution is one tick."""
        allowed_ms = max(SETTLING_PART * self.settling_ms, 0.1)
        return (
            abs(self.settling_ms - promised.settling_ms) <= allowed_ms
            and abs(self.overshoot_percent - promised.overshoot_percent) <= OVERSHOOT_POINTS
        )

    @property
    def meets_specification(self) -> bool:
        """Whether the steps meet deploy/own-stage-spec.toml."""
        return self.overshoot_percent <= 1.0 and self.settling_ms <= 6.0 and self.static_error_percent <= 0.2

    def __str__(self) -> str:
        return f"{self.settling_ms:.2f} ms {self.overshoot_percent:.2f} % ({self.static_error_percent:.3f} % static)"


def run_steps(config: Path) -> Steps:
    """Run steps of STEP_UM up and down in closed loop; return their medians, of the true position."""
    text = config.read_text(encoding="utf-8")
    levels = [0.0, *CYCLES * [STEP_UM, 0.0]]
    running = config.with_name(f"{config.stem}-steps.toml")
    running.write_text(replace_reference_by_steps(text, levels, DWELL_S), encoding="utf-8")
    run = rtloop.load(record_run(running, len(levels) * DWELL_S))
    table = measure_steps(run["x_reference_um"], run["x_true_position_um"], 1e4)
    return Steps(*(np.median(table, axis=0) if table is not None else [np.nan] * 3))


def promised_steps(report: dict[str, Any]) -> Steps:
    """Return the linear figures of the running controller from a design report."""
    rows = {row["name"]: row["running"] for row in report["axes"][0]["rows"]}
    return Steps(*(float("nan" if rows[name] is None else rows[name]) for name in Steps._fields))


def check_rig(rig: Rig, folder: Path) -> bool:
    """Design for a rig and print a line; return whether delay, promise and exit codes are right."""
    recordings = []
    for name, duration_s in (("own-stage-sine", 25.0), ("own-stage", 1.0)):
        config = folder / f"{name}.toml"
        config.write_text(rig.text(name, 1), encoding="utf-8")
        recordings.append(record_run(config, duration_s))
    specs = folder / "spec.toml"
    specs.write_text(replace_value((DEPLOY / "own-stage-spec.toml").read_text(encoding="utf-8"), "noise_um", NOISE_UM))
    designed = folder / "designed.toml"
    code, output = run_command("design", "auto", *recordings, "--specs", specs, "--out", designed, "--json")
    promised, measured = promised_steps(json.loads(output)), run_steps(designed)
    delay_ticks = int(re.findall(r"(?m)^delay_ticks = (\d+)", designed.read_text(encoding="utf-8"))[0])
    tripled_code, tripled_steps = triple_gain(designed)
    passed = (
        delay_ticks == rig.delay_ticks
        and measured.agrees_with(promised)
        and measured.meets_specification == (code == 0)
        and tripled_steps.meets_specification == (tripled_code == 0)
    )
    print(
        f"lag {rig.lag_hz:g} Hz, delay {rig.delay_ticks}: identified {delay_ticks}; promised {promised}, "
        f"ran {measured}, exit {code}; gain × 3: exit {tripled_code}, ran {tripled_steps}{'' if passed else '  BAD'}",
        flush=True,
    )
    return passed


def triple_gain(designed: Path) -> tuple[int, Steps]:
    """Triple the gain of the designed controller. Return the exit code of `design verify`, and the steps of a run."""
    text = designed.read_text(encoding="utf-8")
    head, section = text.split("[axis.controller]\n")
    gain = float(re.findall(r"(?m)^gain = (.*)$", section)[0])
    tripled = designed.with_name("bad.toml")
    tripled_section = re.sub(r"(?m)^gain = .*$", f"gain = {3 * gain!r}", section, count=1)
    tripled.write_text(f"{head}[axis.controller]\n{tripled_section}", encoding="utf-8")
    return run_command("design", "verify", tripled)[0], run_steps(tripled)


def main() -> int:
    """Check the rigs, then the coverage; return 1 if a figure is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=50, help="identifications of the first rig; 0 for none")
    parser.add_argument("--rigs", type=int, default=len(RIGS), help="how many of the rigs; 0 for none")
    options = parser.parse_args()
    failures = 0
    for rig in RIGS[: options.rigs]:
        with tempfile.TemporaryDirectory() as folder:
            failures += not check_rig(rig, Path(folder))
    print(f"{options.rigs} rigs, {failures} bad")
    is_covered = check_coverage(RIGS[0], options.draws) if options.draws else True
    return int(failures > 0 or not is_covered)


if __name__ == "__main__":
    sys.exit(main())
