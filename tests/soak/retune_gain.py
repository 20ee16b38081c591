"""`rtloop ctl retune` and scheduled retuning adapt a running service to a gain that has moved.

deploy/robust.toml runs on rigs with another gain, and on a rig whose gain drifts by 1 % an hour and is followed by
scheduled retuning, every quarter of an hour and every hour. Eight steps of 10 to 40 µm, judged between ticks too,
before and after. The exit code is 1 where the steps or the measured gain exceed their limits.
"""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.configuration.file import Configuration
from rtloop.design.robust.programme import Taps
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.soak.flagship.stage import NOMINAL, RATE_HZ, Steps, load_loop, replace_taps, rig_bench, run_steps
from tests.soak.retune import REST_S, current_taps, run_ctl, shifted_configuration

GAINS_PERCENT, GAIN_STDS = (-5.0, -2.0, 2.0, 5.0), 3.0
DRIFTS = ((0.25, 8), (1.0, 3))
"""Drift (%) between scheduled retunings, and their number: every quarter of an hour, every hour."""
SETTLING_MS, OVERSHOOT_PERCENT, RETUNED_S = 3.1, 0.2, 120.0
ADAPT = "[axis.adapt]\nevery_s = 10.0\ngain_um = 10.0\n\n"
OUTCOME = re.compile(r"axis x (.+)")


def check_gain(gain_percent: float) -> bool:
    """Retune at a gain shifted by `gain_percent` and print a line; return whether steps and gain keep their limits."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Bench(folder, board=False, text=shifted_configuration(folder, 0.0, gain_percent)) as bench:
            bench.await_state("running")
            wait_for(lambda: bench.status()["tick"] > REST_S * RATE_HZ, "a loop at rest")
            answer = run_ctl(bench, "retune", "x", "--yes", "--json")
            measured, new = bench.status()["measured"]["x"]["gain"], current_taps(bench)
            assert measured == answer["gain"], measured
    loop, truth = load_loop("robust"), NOMINAL._replace(gain=gain_percent)
    before, after = (run_steps(rig_bench(tuned, truth)) for tuned in (loop, replace_rows(loop, new)))
    error_percent = 100 * (measured["value"] / (1 + gain_percent / 100) - 1)
    passed = keep_limits(after) and abs(error_percent) <= GAIN_STDS * 100 * measured["std"]
    print(
        f"gain {gain_percent:+g} %: {measured['value']:.4f} ± {measured['std']:.4f} ({error_percent:+.3f} %); "
        f"steps from 10 µm on, between ticks too: "
        f"{describe_steps(before)} -> {describe_steps(after)}{'' if passed else '  BAD'}",
        flush=True,
    )
    return passed


def check_drift(percent: float, times: int) -> bool:
    """Return whether scheduled retuning follows a gain that drifts by `percent` between retunings; print lines.

    Each retuning has a rig of constant gain: drift during the seconds of a measurement is neglected.
    """
    loop, passed = load_loop("robust"), True
    for gain_percent in percent * np.arange(1, times + 1):
        truth = NOMINAL._replace(gain=float(gain_percent))
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            text = shifted_configuration(folder, 0.0, float(gain_percent), ADAPT)
            with Bench(folder, board=False, text=text) as bench:
                bench.await_state("running")
                rows = {key: list(getattr(loop.axes[0].prefilter, key)) for key in ("taps", "command_taps")}
                bench.client.post("/tune", {"axis": "x", "section": "prefilter", "values": rows}, 60.0)
                wait_for(lambda bench=bench: bool(OUTCOME.search(bench.log())), "a retuning", RETUNED_S)
                outcome, new = OUTCOME.findall(bench.log())[0], current_taps(bench)
        before, loop = run_steps(rig_bench(loop, truth)), replace_rows(loop, new)
        after = run_steps(rig_bench(loop, truth))
        in_limits = keep_limits(after)
        print(
            f"drift to {gain_percent:+.2f} %: {outcome}: "
            f"{describe_steps(before)} -> {describe_steps(after)}{'' if in_limits else '  BAD'}",
            flush=True,
        )
        passed = passed and in_limits
    return passed


def replace_rows(loop: Configuration, rows: dict[str, Any]) -> Configuration:
    """Return a loop with the rows of taps that a service reports."""
    return replace_taps(loop, Taps(np.array(rows["taps"]), np.array(rows["command_taps"]), 0.0))


def keep_limits(steps: Steps) -> bool:
    """Return whether all eight steps keep the limits after a retuning."""
    return steps.settling_ms <= SETTLING_MS and steps.overshoot() <= OVERSHOOT_PERCENT


def describe_steps(steps: Steps) -> str:
    """Return the longest settling time and the largest overshoot of the steps, as text."""
    return f"{steps.settling_ms:.2f} ms, {steps.overshoot():.3f} %"


def main() -> int:
    """Check every gain, then both drifts; return 1 if one fails."""
    passed = [check_gain(percent) for percent in GAINS_PERCENT]
    passed += [check_drift(*drift) for drift in DRIFTS]
    return int(not all(passed))


if __name__ == "__main__":
    sys.exit(main())
