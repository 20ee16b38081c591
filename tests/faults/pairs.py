"""Two random disturbances at once. The board's record shows every write and the last output.

Each sequence begins with a service that drives. Two disturbances come within 50 ms of each other and are reverted half
a second later, where possible. Then the service gets SIGTERM, and `rtloop park` is called twice, as the systemd unit
does. No write may differ from the one before by more than a step of the ramp; the output must be safe in time, and must
not move afterwards.
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

WITHIN_S, REVERTED_S = 0.05, 0.5
SAFE_MS = 8000.0
"""Bound from the second disturbance's end to 0 V: heartbeat time-out, start of `park`, its wait for a stopped loop."""


class Disturbance(NamedTuple):
    """A fault or a request, and its reversal where there is one."""

    name: str
    apply: Callable[[Bench], object]
    revert: Callable[[Bench], object] = lambda bench: None


def send_signal(role: str, number: signal.Signals) -> Callable[[Bench], None]:
    """Return a function that sends a signal to the bench's process `role`, if it still lives."""

    def send(bench: Bench) -> None:
        with suppress(ProcessLookupError):
            if pid := bench.pid(role):
                os.kill(pid, number)

    return send


def post(path: str, body: dict) -> Callable[[Bench], None]:
    """Return a function that posts a request in a thread; the request may be refused or stay unanswered."""

    def send(bench: Bench) -> None:
        with suppress(RtloopError):
            bench.client.post(path, body)

    return lambda bench: threading.Thread(target=send, args=(bench,), daemon=True).start()


def change_filter(count: int) -> Callable[[Bench], None]:
    """Return a function that posts a pre-filter of `count` taps."""
    return post("/tune", {"axis": "x", "section": "prefilter", "values": {"taps": [1 / count] * count}})


def board_fault(fault: int) -> Callable[[Bench], None]:
    """Return a function that sets a fault of the board."""
    return lambda bench: bench.cause_fault(fault)


DISTURBANCES = (
    *(Disturbance(f"{role} SIGKILL", send_signal(role, signal.SIGKILL)) for role in ("rt", "service", "recorder")),
    *(Disturbance(f"{role} SIGSTOP", send_signal(role, signal.SIGSTOP), send_signal(role, signal.SIGCONT))
      for role in ("rt", "service", "recorder")),
    Disturbance("SIGTERM", send_signal("service", signal.SIGTERM)),
    Disturbance("SIGHUP", send_signal("service", signal.SIGHUP)),
    Disturbance("park", lambda bench: bench.rtloop("park", bench.config)),
    Disturbance("input frozen", board_fault(board.FROZEN_INPUT), board_fault(board.NO_FAULT)),
    Disturbance("output stuck", board_fault(board.STUCK_OUTPUT), board_fault(board.NO_FAULT)),
    Disturbance("128 taps", change_filter(128)),
    Disturbance("3 taps", change_filter(3)),
    Disturbance("mode raw", post("/mode", {"mode": "raw"})),
    Disturbance("setpoint", post("/setpoint", {"axis": "x", "value": -20.0})),
    Disturbance("trip", post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 5.0}})),
    Disturbance("stop", post("/stop", {})),
    Disturbance("reset", post("/reset", {})),
)  # fmt: skip


def sequence(bench: Bench, chance: random.Random) -> tuple[str, float]:
    """Apply two random disturbances and end the service.

    Return the names of the disturbances and the ms until the output was safe. Raises AssertionError for a broken bound.
    """
    first, second = chance.sample(DISTURBANCES, 2)
    delay_s = chance.uniform(0.0, WITHIN_S)
    bench.strike(lambda: first.apply(bench))
    time.sleep(delay_s)
    second.apply(bench)
    time.sleep(REVERTED_S)
    for disturbance in (first, second):
        disturbance.revert(bench)
    bench.strike()
    assert bench.service is not None
    if bench.service.poll() is None:
        bench.service.terminate()
        wait_for(lambda: bench.service is None or bench.service.poll() is not None, "the service's end")
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0, bench.log()[-600:]
    took_ms = bench.await_safe(SAFE_MS) if bench.output_record().moved_ns > bench.struck_ns else 0.0
    moved_ns = bench.output_record().moved_ns
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0
    assert bench.output_record().moved_ns == moved_ns, "the output moved again"
    assert bench.output_record().last_v == 0.0, f"the output is at {bench.output_record().last_v} V"
    return f"{first.name}, after {1000 * delay_s:.0f} ms {second.name}", took_ms


def main() -> int:
    """Run the sequences and print a line for each; return exit code 0 if none failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sequences", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    chance, failed = random.Random(arguments.seed), 0
    with tempfile.TemporaryDirectory(prefix="rtloop-pairs-") as name, Bench(Path(name), strict=True) as bench:
        largest_v = 0.0
        for number in range(arguments.sequences):
            if number:
                bench.start_service()
            bench.await_drive()
            try:
                description, took_ms = sequence(bench, chance)
                problems = bench.output_record().problems(bench.bounds)
                assert not problems, "; ".join(problems)
                verdict = f"safe after {took_ms:.0f} ms"
            except AssertionError as error:
                description, verdict, failed = "?", f"FAILS: {error}", failed + 1
                for name in ("largest_step_v", "largest_window_v"):
                    bench.memory.evidence[name] = 0.0
            largest_v = max(largest_v, bench.output_record().largest_window_v)
            print(f"{number + 1:4} {description}: {verdict}", flush=True)
        steps = f"at most {largest_v:.3f} V within 1 ms of {bench.bounds.window_v:.3f}"
        print(f"seed {arguments.seed}: {arguments.sequences} sequences, {failed} failed; {steps}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
