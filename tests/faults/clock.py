"""The wall clock is set forward and back while the loop runs.

The host's own clock stays as it is: a small library put in front of libc steps CLOCK_REALTIME for these processes
alone, by an hour, ten times a second.
"""

from __future__ import annotations

from pathlib import Path

from rtloop.engine.memory import Word
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.faults.fault import Fault, Measured
from tests.faults.preload import preloaded

RATE_HZ, HOST_MAY_TAKE = 4000.0, 0.2
"""A stall of the host loses periods; a rate by the stepping clock would be wrong by thousands."""


def stepping_clock(folder: Path) -> dict[str, str]:
    """The environment that makes the wall clock step. Raises NotPossible without a compiler."""
    return preloaded(folder, "stepping_clock")


def steps(bench: Bench) -> Measured:
    first = bench.blocks[-1].load(Word.START_UNIX_NS)
    ticks = bench.ticks
    bench.strike()
    wait_for(lambda: bench.ticks > ticks + 12_000, "three seconds")
    report = bench.status()
    assert report["state"] == "running", report
    assert abs(report["rate_hz"] - RATE_HZ) < HOST_MAY_TAKE * RATE_HZ, report
    return Measured(note=f"started at {first / 1e9:.0f} s of a stepping clock")


FAULTS = (Fault("clock steps ±1 h", "nothing notices", steps, environment=stepping_clock),)
