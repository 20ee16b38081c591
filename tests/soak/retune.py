"""`rtloop ctl retune` adapts a running service to a resonance that has moved. `make soak NAME=retune`.

deploy/robust.toml runs on a rig with another resonance: a step of 20 µm; `retune` measures the resonance, designs new
taps and swaps them in; the step again. Then old and new taps are swapped in turn during a scan of 40 µm at 10 Hz. The
recording gives the error of the frequency, both steps, and the displacement of the true position by a swap, compared
with the cycles before and after; it must replay identical. The exit code is 1 where one of these figures exceeds its
limit. Gains are in retune_gain.py.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rtloop
from rtloop.client.retuning import STAGES
from rtloop.recording.replay.replay import replay
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.soak.flagship.stage import write_shifted_configuration

RATE_HZ, RESONANCE_HZ = 10_000, float(np.sqrt(1.4e7)) / (2 * np.pi)
SHIFTS_PERCENT = (-10.0, -5.0, 0.0, 5.0, 8.0, 10.0)
STEP_UM, SCAN_UM, SCAN_HZ, SWAPS = 20.0, 40.0, 10.0, 4
REST_S, CYCLE_TICKS, CLOSE_TICKS = 0.3, round(RATE_HZ / SCAN_HZ), round(0.005 * RATE_HZ)
FREQUENCY_PERCENT, SETTLING_MS, OVERSHOOT_PERCENT, MOVED_UM = 0.06, 3.2, 0.3, 0.05
"""Limits: error of the frequency, second step, displacement by a swap."""


class Step(NamedTuple):
    """Time (ms) until the true position stays within 5 % of the step, and overshoot (%)."""

    settling_ms: float
    overshoot_percent: float


def measure_step(position_um: np.ndarray[Any, Any]) -> Step:
    """Return settling and overshoot of a step of STEP_UM at sample 0."""
    height = position_um - position_um[-round(0.1 * RATE_HZ) :].mean() + STEP_UM
    outside = np.flatnonzero(np.abs(height - STEP_UM) > 0.05 * STEP_UM)
    return Step(1e3 * (outside[-1] + 1) / RATE_HZ, 100 * (height.max() / STEP_UM - 1))


def displacement_um(position_um: np.ndarray[Any, Any], tick: int) -> float:
    """Return how far (µm) the position leaves, soon after a swap, the range of two cycles before and two after."""
    ticks_after = np.arange(tick, tick + CLOSE_TICKS)
    other_cycles = np.stack([position_um[ticks_after + cycle * CYCLE_TICKS] for cycle in (-2, -1, 1, 2)])
    after_swap = position_um[ticks_after]
    return float(np.maximum(after_swap - other_cycles.max(axis=0), other_cycles.min(axis=0) - after_swap).max())


def run_ctl(bench: Bench, *arguments: str) -> dict[str, Any]:
    """Run `rtloop ctl` and return its JSON. Exit code 1 is allowed: `retune` kept taps that are good enough."""
    command = [sys.executable, "-m", "rtloop", "ctl", "--socket", str(bench.client.path), *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert not result.stderr, result.stderr
    assert result.returncode in (0, 1)
    return json.loads(result.stdout)


def set_step(bench: Bench) -> int:
    """Set a step of STEP_UM from rest; return its tick."""
    bench.client.post("/setpoint", {"axis": "x", "value": 0.0})
    time.sleep(REST_S)
    tick = int(bench.client.post("/setpoint", {"axis": "x", "value": STEP_UM})["tick"])
    time.sleep(REST_S)
    return tick


def current_taps(bench: Bench) -> dict[str, Any]:
    """Return both rows of taps in force, by name."""
    rows = bench.client.get("/configuration")["values"]["axis"][0]["prefilter"]
    return {name: rows[name] for name in ("taps", "command_taps")}


def swap_taps(bench: Bench, old: dict[str, Any], new: dict[str, Any]) -> list[int]:
    """Change from old to new taps in stages, as `retune` does; return the tick of each stage."""
    count, ticks = max(len(row) for taps in (old, new) for row in taps.values()), []
    for share in np.arange(1, STAGES + 1) / STAGES:
        values = {}
        for name in old:
            old_row, new_row = (
                np.pad(np.asarray(taps[name], float), (0, count - len(taps[name]))) for taps in (old, new)
            )
            values[name] = ((1 - share) * old_row + share * new_row).tolist()
        body = {"axis": "x", "section": "prefilter", "values": values}
        ticks.append(int(bench.client.post("/tune", body, 60.0)["tick"]))
        time.sleep(3 / SCAN_HZ)
    return ticks


def shifted_configuration(folder: Path, percent: float, gain_percent: float = 0.0, adapt: str = "") -> str:
    """Return deploy/robust.toml at rest, on a rig with shifts of resonance and gain; `adapt`: text of [axis.adapt]."""
    text = write_shifted_configuration("robust", percent, folder, gain_percent).read_text(encoding="utf-8")
    head, tail = text.split("[recording]")
    text = f'{head}[recording]\nfolder = "{folder}/recordings"\n' + "".join(tail.partition("\n[")[1:])
    start, end = text.index("[axis.reference]"), text.index("[axis.prefilter]")
    return f'{text[:start]}[axis.reference]\nkind = "hold"\nvalue = 0.0\n\n{adapt}{text[end:]}'


def check_retuning(percent: float) -> bool:
    """Retune at a resonance shifted by `percent` and print a line; return whether all figures keep their limits."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Bench(folder, board=False, text=shifted_configuration(folder, percent)) as bench:
            bench.await_state("running")
            wait_for(lambda: bench.status()["tick"] > REST_S * RATE_HZ, "a loop at rest")
            first_tick, old = set_step(bench), current_taps(bench)
            answer = run_ctl(bench, "retune", "x", "--yes", "--json")
            second_tick, new = set_step(bench), current_taps(bench)
            scan = {"kind": "triangle", "amplitude": SCAN_UM / 2, "frequency_hz": SCAN_HZ}
            bench.client.post("/reference", {"axis": "x", "reference": scan})
            time.sleep(1.0)
            swaps = []
            for number in range(SWAPS):
                swaps += swap_taps(bench, *((new, old) if number % 2 == 0 else (old, new)))
            bench.client.post("/stop")
            assert bench.stop() == 0
        (path,) = (folder / "recordings").glob("*.mcap")
        recording = rtloop.load(path)
        position = recording["x_true_position_um"]
        steps = [measure_step(position[tick : tick + round(REST_S * RATE_HZ)]) for tick in (first_tick, second_tick)]
        largest_um = max(displacement_um(position, tick) for tick in swaps)
        verdict = replay(recording)
    hz, true_hz = answer["resonance"]["hz"], (1 + percent / 100) * RESONANCE_HZ
    error_percent = 100 * (hz / true_hz - 1)
    passed = (
        abs(error_percent) <= FREQUENCY_PERCENT and verdict.identical and largest_um <= MOVED_UM
        and steps[1].settling_ms <= SETTLING_MS and steps[1].overshoot_percent <= OVERSHOOT_PERCENT
        and answer["better"] == (new != old)
    )  # fmt: skip
    print(
        f"{percent:+.0f} %: {hz:.2f} Hz ({error_percent:+.4f} %); step {steps[0].settling_ms:.1f} -> "
        f"{steps[1].settling_ms:.1f} ms, {steps[0].overshoot_percent:.3f} -> {steps[1].overshoot_percent:.3f} %; "
        f"{'swapped in' if answer['better'] else 'no better, not swapped in'}; {len(swaps)} swaps in a scan "
        f"move x by {1e3 * largest_um:.0f} nm at most; {verdict.ticks} ticks "
        f"{'identical' if verdict.identical else verdict}{'' if passed else '  BAD'}",
        flush=True,
    )
    return passed


def main() -> int:
    """Check every shift; return 1 if one fails."""
    passed = [check_retuning(percent) for percent in SHIFTS_PERCENT]
    return int(not all(passed))


if __name__ == "__main__":
    sys.exit(main())
