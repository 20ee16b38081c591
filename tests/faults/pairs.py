"""Two faults at once, at random. The board judges every write, and where the output is in the end.

Each sequence begins with a service that drives. Two faults come within 50 ms of each other, what can be undone is
undone half a second later, whoever is left is told to end, and `rtloop park` is called as the unit would, twice. No
write may be further from the one before than one step of the ramp, the output must be safe in time, and must not move
once it is.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from rtloop.errors import RtloopError
from rtloop.hil import board
from tests.faults.bench import Bench
from tests.faults.evidence import TIMEOUT_S, wait_for

WITHIN_S, UNDONE_S = 0.05, 0.5
SAFE_MS = 8000.0
"""At the worst: a heartbeat, a start of `park`, and its patience with a loop that stands still."""


class Stroke(NamedTuple):
    """A fault, and what takes it back."""

    name: str
    strike: Callable[[Bench], object]
    undo: Callable[[Bench], object] = lambda bench: None


def to(role: str, number: signal.Signals) -> Callable[[Bench], None]:
    """A signal to one of the bench's processes, if it still lives."""

    def send(bench: Bench) -> None:
        with suppress(ProcessLookupError):
            if pid := bench.pid(role):
                os.kill(pid, number)

    return send


def ask(path: str, body: dict) -> Callable[[Bench], None]:
    """A request that may be refused, or not answered at all; nobody waits for it."""

    def post(bench: Bench) -> None:
        with suppress(RtloopError):
            bench.client.post(path, body)

    return lambda bench: threading.Thread(target=post, args=(bench,), daemon=True).start()


def taps(count: int) -> Callable[[Bench], None]:
    """Another pre-filter."""
    return ask("/tune", {"axis": "x", "section": "prefilter", "values": {"taps": [1 / count] * count}})


def board_fault(fault: int) -> Callable[[Bench], None]:
    """A fault of the board."""
    return lambda bench: bench.ask_for(fault)


STROKES = (
    *(Stroke(f"{role} SIGKILL", to(role, signal.SIGKILL)) for role in ("rt", "service", "recorder")),
    *(Stroke(f"{role} SIGSTOP", to(role, signal.SIGSTOP), to(role, signal.SIGCONT))
      for role in ("rt", "service", "recorder")),
    Stroke("SIGTERM", to("service", signal.SIGTERM)),
    Stroke("SIGHUP", to("service", signal.SIGHUP)),
    Stroke("park", lambda bench: bench.rtloop("park", bench.config)),
    Stroke("input frozen", board_fault(board.FROZEN_INPUT), board_fault(board.NO_FAULT)),
    Stroke("output stuck", board_fault(board.STUCK_OUTPUT), board_fault(board.NO_FAULT)),
    Stroke("128 taps", taps(128)),
    Stroke("3 taps", taps(3)),
    Stroke("mode raw", ask("/mode", {"mode": "raw"})),
    Stroke("setpoint", ask("/setpoint", {"axis": "x", "value": -20.0})),
    Stroke("trip", ask("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 5.0}})),
    Stroke("stop", ask("/stop", {})),
    Stroke("reset", ask("/reset", {})),
)  # fmt: skip


def sequence(bench: Bench, chance: random.Random) -> tuple[str, float]:
    """Two strokes and their end; what they were, and ms until the output was safe. Raises AssertionError."""
    first, second = chance.sample(STROKES, 2)
    delay_s = chance.uniform(0.0, WITHIN_S)
    bench.strike(lambda: first.strike(bench))
    time.sleep(delay_s)
    second.strike(bench)
    time.sleep(UNDONE_S)
    for stroke in (first, second):
        stroke.undo(bench)
    bench.strike()
    assert bench.service is not None
    if bench.service.poll() is None:
        bench.service.terminate()
        wait_for(lambda: bench.service is None or bench.service.poll() is not None, "the service's end")
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0, bench.log()[-600:]
    took_ms = bench.await_safe(SAFE_MS) if bench.seen().moved_ns > bench.struck_ns else 0.0
    moved_ns = bench.seen().moved_ns
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0
    assert bench.seen().moved_ns == moved_ns, "it moved again"
    assert bench.seen().last_v == 0.0, f"the output is at {bench.seen().last_v} V"
    return f"{first.name}, after {1000 * delay_s:.0f} ms {second.name}", took_ms


def main() -> int:
    """Exit code 0 if every sequence holds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sequences", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    chance, failed = random.Random(given.seed), 0
    with tempfile.TemporaryDirectory(prefix="rtloop-pairs-") as name, Bench(Path(name), strict=True) as bench:
        largest_v = 0.0
        for number in range(given.sequences):
            if number:
                bench.start_service()
            bench.await_drive()
            try:
                said, took_ms = sequence(bench, chance)
                problems = bench.seen().problems(bench.bounds)
                assert not problems, "; ".join(problems)
                verdict = f"safe after {took_ms:.0f} ms"
            except AssertionError as error:
                said, verdict, failed = "?", f"FAILS: {error}", failed + 1
                for name in ("largest_step_v", "largest_window_v"):
                    bench.memory.evidence[name] = 0.0
            largest_v = max(largest_v, bench.seen().largest_window_v)
            print(f"{number + 1:4} {said}: {verdict}", flush=True)
        steps = f"at most {largest_v:.3f} V within 1 ms of {bench.bounds.window_v:.3f}"
        print(f"seed {given.seed}: {given.sequences} sequences, {failed} failed; {steps}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
