"""Measurement of the loop clock's lateness on this host: `python -m rtloop.engine.latency`, pacing as JSON on stdin.

The process has the settings of the loop's process and waits like the loop, without work between two waits and without a
driver. On stdout: a JSON line with the privileges that the host granted, then lateness in µs and missed periods of each
tick, as two arrays of doubles.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.engine.clock import clock_context, paced_clock
from rtloop.engine.plan import Pacing
from rtloop.engine.realtime import freeze_garbage_collection, prepare_realtime
from rtloop.foundation.native.compiled import jit
from rtloop.foundation.native.pointers import call

START_DELAY_NS = 20_000_000


@jit
def measure_waits(wait, context, timing, address, lateness_us, missed):
    """Wait for `lateness_us.size` ticks and set lateness in µs and missed periods of each.

    `wait` and `context` are the addresses of the clock's function and of its context; `timing` (4,) is at `address`. A
    clock that ends the run ends the measurement; the remaining values stay.
    """
    for k in range(lateness_us.size):
        if call(wait, context, address) != 0:
            return
        lateness_us[k] = (timing[1] - timing[0]) / 1000.0
        missed[k] = timing[2]


def measure(pacing: Pacing, ticks: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return lateness in µs and missed periods of each tick, both (ticks,), measured in the calling thread.

    It takes `ticks` periods.
    """
    context, timing = clock_context(pacing.rate_hz), np.zeros(4)
    clock = paced_clock(context, pacing.spin_us)
    lateness_us, missed = np.zeros(ticks), np.zeros(ticks)
    arguments = clock.wait, clock.context, timing, timing.ctypes.data
    measure_waits(*arguments, lateness_us[:0], missed[:0])  # compiles, before the measurement begins
    context.start_ns = time.monotonic_ns() + START_DELAY_NS
    measure_waits(*arguments, lateness_us, missed)
    return lateness_us, missed


def encode_request(pacing: Pacing, ticks: int) -> bytes:
    """Return the input of the process: JSON with `pacing` and `ticks`."""
    return json.dumps({"pacing": asdict(pacing), "ticks": ticks}).encode()


def decode_results(output: bytes) -> tuple[dict[str, Any], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return, from the output of the process, the result of `prepare_realtime`, lateness in µs and missed periods.

    Raises ValueError for an output without a line of JSON or without two arrays of equal length.
    """
    line, _, data = output.partition(b"\n")
    lateness_us, missed = np.frombuffer(data).reshape(2, -1)
    return json.loads(line), lateness_us, missed


def main() -> int:
    """Measure as stdin requests, with real-time privileges where granted; write the results to stdout. Returns 0."""
    request = json.load(sys.stdin)
    pacing = Pacing(**request["pacing"])
    freeze_garbage_collection()
    granted = prepare_realtime(pacing)
    lateness_us, missed = measure(pacing, request["ticks"])
    sys.stdout.buffer.write(json.dumps(granted).encode() + b"\n" + lateness_us.tobytes() + missed.tobytes())
    return 0


if __name__ == "__main__":
    sys.exit(main())
