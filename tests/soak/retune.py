"""A running service is told of a resonance that has moved, by `rtloop ctl retune`. `make soak-retune`.

deploy/robust.toml on a rig whose resonance is elsewhere: a step of 20 µm, the resonance measured and the taps made anew
and swapped in, the step again; then a scan of 40 µm, 10 times a second, into which the old taps and the new ones are
swapped in turn. From the recording, which is replayed: how far off the frequency is, both steps, how far a swap moved
the true position from what it does in the cycles before and after, and whether the bits are the same. Ends with 1 where
one of them is not as it should be. Gains are in retune_gain.py.
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
from rtloop.cli.retune import SWAP_STAGES
from rtloop.recording.replay.replay import replay
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.soak.flagship.stage import written

RATE_HZ, RESONANCE_HZ = 10_000, float(np.sqrt(1.4e7)) / (2 * np.pi)
SHIFTS_PERCENT = (-10.0, -5.0, 0.0, 5.0, 8.0, 10.0)
STEP_UM, SCAN_UM, SCAN_HZ, SWAPS = 20.0, 40.0, 10.0, 4
REST_S, CYCLE_TICKS, CLOSE_TICKS = 0.3, round(RATE_HZ / SCAN_HZ), round(0.005 * RATE_HZ)
FREQUENCY_PERCENT, SETTLING_MS, OVERSHOOT_PERCENT, MOVED_UM = 0.06, 3.2, 0.3, 0.05


class Step(NamedTuple):
    """Until the true position stays within 5 % of the step, in ms, and how far it goes beyond it, in %."""

    settling_ms: float
    overshoot_percent: float


def step_of(position_um: np.ndarray[Any, Any]) -> Step:
    """Of a step of STEP_UM at sample 0."""
    height = position_um - position_um[-round(0.1 * RATE_HZ) :].mean() + STEP_UM
    outside = np.flatnonzero(np.abs(height - STEP_UM) > 0.05 * STEP_UM)
    return Step(1e3 * (outside[-1] + 1) / RATE_HZ, 100 * (height.max() / STEP_UM - 1))


def moved_um(position_um: np.ndarray[Any, Any], tick: int) -> float:
    """How far it goes, soon after a swap at `tick`, beyond what it does there in a cycle before and in one after."""
    there = np.arange(tick, tick + CLOSE_TICKS)
    cycles = np.stack([position_um[there + cycle * CYCLE_TICKS] for cycle in (-2, -1, 1, 2)])
    now = position_um[there]
    return float(np.maximum(now - cycles.max(axis=0), cycles.min(axis=0) - now).max())


def ctl(bench: Bench, *arguments: str) -> dict[str, Any]:
    """The answer of the command line; 1 is its code where taps stay that are good enough."""
    command = [sys.executable, "-m", "rtloop", "ctl", "--socket", str(bench.client.path), *arguments]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert not ran.stderr, ran.stderr
    assert ran.returncode in (0, 1)
    return json.loads(ran.stdout)


def stepped(bench: Bench) -> int:
    """A step from rest; its tick."""
    bench.client.post("/setpoint", {"axis": "x", "value": 0.0})
    time.sleep(REST_S)
    tick = int(bench.client.post("/setpoint", {"axis": "x", "value": STEP_UM})["tick"])
    time.sleep(REST_S)
    return tick


def taps_of(bench: Bench) -> dict[str, Any]:
    """Both rows that are in force."""
    rows = bench.client.get("/configuration")["values"]["axis"][0]["prefilter"]
    return {name: rows[name] for name in ("taps", "command_taps")}


def swapped(bench: Bench, old: dict[str, Any], new: dict[str, Any]) -> list[int]:
    """The ticks of the stages in which new taps take over, as `retune` does it."""
    count, ticks = max(len(row) for taps in (old, new) for row in taps.values()), []
    for part in np.arange(1, SWAP_STAGES + 1) / SWAP_STAGES:
        values = {}
        for name in old:
            before, after = (np.pad(np.asarray(taps[name], float), (0, count - len(taps[name]))) for taps in (old, new))
            values[name] = ((1 - part) * before + part * after).tolist()
        body = {"axis": "x", "section": "prefilter", "values": values}
        ticks.append(int(bench.client.post("/tune", body, 60.0)["tick"]))
        time.sleep(3 / SCAN_HZ)
    return ticks


def text_of(folder: Path, percent: float, gain_percent: float = 0.0, adapt: str = "") -> str:
    """deploy/robust.toml at rest, on a rig whose resonance and gain are so far away; `adapt`: [axis.adapt]."""
    text = written("robust", percent, folder, gain_percent).read_text(encoding="utf-8")
    head, tail = text.split("[recording]")
    text = f'{head}[recording]\nfolder = "{folder}/recordings"\n' + "".join(tail.partition("\n[")[1:])
    start, end = text.index("[axis.reference]"), text.index("[axis.prefilter]")
    return f'{text[:start]}[axis.reference]\nkind = "hold"\nvalue = 0.0\n\n{adapt}{text[end:]}'


def retuned(percent: float) -> bool:
    """Whether all is as it should be with a resonance so far away; a line."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Bench(folder, board=False, text=text_of(folder, percent)) as bench:
            bench.await_state("running")
            wait_for(lambda: bench.status()["tick"] > REST_S * RATE_HZ, "a loop at rest")
            before, old = stepped(bench), taps_of(bench)
            found = ctl(bench, "retune", "x", "--yes", "--json")
            after, new = stepped(bench), taps_of(bench)
            scan = {"kind": "triangle", "amplitude": SCAN_UM / 2, "frequency_hz": SCAN_HZ}
            bench.client.post("/reference", {"axis": "x", "reference": scan})
            time.sleep(1.0)
            swaps = []
            for number in range(SWAPS):
                swaps += swapped(bench, *((new, old) if number % 2 == 0 else (old, new)))
            bench.client.post("/stop")
            assert bench.stop() == 0
        (path,) = (folder / "recordings").glob("*.mcap")
        recording = rtloop.load(path)
        position = recording["x_true_position_um"]
        steps = [step_of(position[tick : tick + round(REST_S * RATE_HZ)]) for tick in (before, after)]
        moved = max(moved_um(position, tick) for tick in swaps)
        verdict = replay(recording)
    hz, true_hz = found["resonance"]["hz"], (1 + percent / 100) * RESONANCE_HZ
    off = 100 * (hz / true_hz - 1)
    good = (
        abs(off) <= FREQUENCY_PERCENT and verdict.identical and moved <= MOVED_UM
        and steps[1].settling_ms <= SETTLING_MS and steps[1].overshoot_percent <= OVERSHOOT_PERCENT
        and found["better"] == (new != old)
    )  # fmt: skip
    print(
        f"{percent:+.0f} %: {hz:.2f} Hz ({off:+.4f} %); step {steps[0].settling_ms:.1f} -> {steps[1].settling_ms:.1f}"
        f" ms, {steps[0].overshoot_percent:.3f} -> {steps[1].overshoot_percent:.3f} %; "
        f"{'swapped in' if found['better'] else 'no better, not swapped in'}; {len(swaps)} swaps in a scan "
        f"move x by {1e3 * moved:.0f} nm at most; {verdict.ticks} ticks {'identical' if verdict.identical else verdict}"
        f"{'' if good else '  BAD'}",
        flush=True,
    )
    return good


def main() -> int:
    """Every shift."""
    good = [retuned(percent) for percent in SHIFTS_PERCENT]
    return int(not all(good))


if __name__ == "__main__":
    sys.exit(main())
