"""A running service is told of a gain that has moved, by `rtloop ctl retune` and on a schedule.

deploy/robust.toml on rigs whose gain is elsewhere, and on one whose gain drifts by 1 % an hour and is followed by the
scheduled retuning, every quarter of an hour and every hour. Eight steps of 10 to 40 µm, between ticks too, before and
after. Ends with 1 where they, or the gain that was measured, are not as they should be.
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
from tests.soak.flagship.stage import NOMINAL, RATE_HZ, Steps, steps, with_taps
from tests.soak.flagship.stage import bench as on_rig
from tests.soak.flagship.stage import loop as configured
from tests.soak.retune import REST_S, ctl, taps_of, text_of

GAINS_PERCENT, GAIN_STDS = (-5.0, -2.0, 2.0, 5.0), 3.0
DRIFTS = ((0.25, 8), (1.0, 3))
"""Percent from one scheduled retuning to the next, and how many: every quarter of an hour, every hour."""
SETTLING_MS, OVERSHOOT_PERCENT, RETUNED_S = 3.1, 0.2, 120.0
ADAPT = "[axis.adapt]\nevery_s = 10.0\ngain_um = 10.0\n\n"
OUTCOME = re.compile(r"axis x (.+)")


def regained(gain_percent: float) -> bool:
    """Whether steps from 10 µm on are as they should be after a retuning with a gain so far away; a line."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Bench(folder, board=False, text=text_of(folder, 0.0, gain_percent)) as bench:
            bench.await_state("running")
            wait_for(lambda: bench.status()["tick"] > REST_S * RATE_HZ, "a loop at rest")
            found = ctl(bench, "retune", "x", "--yes", "--json")
            measured, new = bench.status()["measured"]["x"]["gain"], taps_of(bench)
            assert measured == found["gain"], measured
    loop, truth = configured("robust"), NOMINAL._replace(gain=gain_percent)
    before, after = (steps(on_rig(one, truth)) for one in (loop, with_rows(loop, new)))
    off = 100 * (measured["value"] / (1 + gain_percent / 100) - 1)
    good = are_good(after) and abs(off) <= GAIN_STDS * 100 * measured["std"]
    print(
        f"gain {gain_percent:+g} %: {measured['value']:.4f} ± {measured['std']:.4f} ({off:+.3f} %); steps from 10 µm "
        f"on, between ticks too: {said(before)} -> {said(after)}{'' if good else '  BAD'}",
        flush=True,
    )
    return good


def drifted(percent: float, times: int) -> bool:
    """Whether the scheduled retuning follows a gain that drifts by `percent` from one time to the next; a line each.

    The rig of each time has its own constant gain: what drifts during the seconds of a measurement is not seen.
    """
    loop, good = configured("robust"), True
    for gain_percent in percent * np.arange(1, times + 1):
        truth = NOMINAL._replace(gain=float(gain_percent))
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            text = text_of(folder, 0.0, float(gain_percent), ADAPT)
            with Bench(folder, board=False, text=text) as bench:
                bench.await_state("running")
                rows = {key: list(getattr(loop.axes[0].prefilter, key)) for key in ("taps", "command_taps")}
                bench.client.post("/tune", {"axis": "x", "section": "prefilter", "values": rows}, 60.0)
                wait_for(lambda bench=bench: bool(OUTCOME.search(bench.log())), "a retuning", RETUNED_S)
                outcome, new = OUTCOME.findall(bench.log())[0], taps_of(bench)
        before, loop = steps(on_rig(loop, truth)), with_rows(loop, new)
        after = steps(on_rig(loop, truth))
        fine = are_good(after)
        print(
            f"drift to {gain_percent:+.2f} %: {outcome}: {said(before)} -> {said(after)}{'' if fine else '  BAD'}",
            flush=True,
        )
        good = good and fine
    return good


def with_rows(loop: Configuration, rows: dict[str, Any]) -> Configuration:
    """A loop with the rows of taps that a service told."""
    return with_taps(loop, Taps(np.array(rows["taps"]), np.array(rows["command_taps"]), 0.0))


def are_good(found: Steps) -> bool:
    """Whether all eight steps are within what a retuning promises."""
    return found.settling_ms <= SETTLING_MS and found.overshoot() <= OVERSHOOT_PERCENT


def said(found: Steps) -> str:
    """The slowest and the largest of eight steps."""
    return f"{found.settling_ms:.2f} ms, {found.overshoot():.3f} %"


def main() -> int:
    """Every gain, and both drifts."""
    good = [regained(percent) for percent in GAINS_PERCENT]
    good += [drifted(*drift) for drift in DRIFTS]
    return int(not all(good))


if __name__ == "__main__":
    sys.exit(main())
