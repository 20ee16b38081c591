"""Fault of the wall clock: it steps forward and back while the loop runs.

The host's clock is not changed. A small library put in front of libc steps CLOCK_REALTIME by an hour, ten times a
second, for the processes of the bench alone.
"""

from __future__ import annotations

from pathlib import Path

from rtloop.engine.memory import Word
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.faults.fault import Fault, Outcome
from tests.faults.preload import preload

RATE_HZ, HOST_MAY_TAKE = 4000.0, 0.2
"""HOST_MAY_TAKE: share of the rate that stalls of the host may cost; the stepping clock would cost far more."""


def stepping_clock(folder: Path) -> dict[str, str]:
    """Return the environment that makes the wall clock step. Raises NotPossible without a C compiler."""
    return preload(folder, "stepping_clock")


def clock_steps(bench: Bench) -> Outcome:
    """Run 12,000 ticks on a stepping clock: the loop runs on, and its rate is still right."""
    first = bench.blocks[-1].load(Word.START_UNIX_NS)
    ticks = bench.ticks
    bench.strike()
    wait_for(lambda: bench.ticks > ticks + 12_000, "three seconds")
    report = bench.status()
    assert report["state"] == "running", report
    assert abs(report["rate_hz"] - RATE_HZ) < HOST_MAY_TAKE * RATE_HZ, report
    return Outcome(note=f"started at {first / 1e9:.0f} s of a stepping clock")


FAULTS = (Fault("clock steps ±1 h", "the loop keeps its rate", clock_steps, environment=stepping_clock),)
