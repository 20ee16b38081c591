"""Highest rates at which the loop can be paced before ticks overrun."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rtloop
from rtloop.errors import LoopFault
from rtloop.signals import Flag
from tests.benchmarks import native, plain_driver
from tests.benchmarks.board import board, board_configuration
from tests.benchmarks.configurations import RIG, SINE, STEPS, at_rate, changed, last_cpu, pinned, write
from tests.benchmarks.lateness import PRIORITY, late_cycle_share
from tests.benchmarks.measure import Effort, MeasurementUnavailable, show_progress
from tests.benchmarks.processes import CommandFailed
from tests.benchmarks.processes import rtloop as command

RATES_HZ = (5_000, 10_000, 20_000, 30_000, 50_000, 70_000, 100_000, 140_000, 200_000)
WINDOW_NS = 1e9
WINDOWS = 7
ALLOWED_SHARE = 0.001
SPIN_US = 60.0
ALL_RATES_LOOP = "sim", "spinning"
"""Driver and pacing of the loop that is measured at every rate of the ladder, for comparison with the host."""
LOW_GAIN = ("gain = 0.016", "gain = 0.004")
"""Change to a quarter of the gain: with another plant, or a board's delay, the paper's controller would trip."""
PYTHON_DRIVER = f"""[driver]
kind = "{plain_driver.LagDriver.kind}"
[driver.channels.x]
input = "in"
output = "out"
um_per_v = {plain_driver.SENSOR_UM_PER_V}

"""

Signal = np.ndarray[Any, Any]
Configure = Callable[[list[tuple[str, str]]], str]


class LateShares(NamedTuple):
    """Shares in the median one-second window: ticks that overran, and periods that were overrun or skipped."""

    overrun: float
    lost: float


ALL_LATE = LateShares(1.0, 1.0)


def late_shares(deadline_ns: Signal, flags: Signal, missed: Signal) -> LateShares:
    """Return the shares from three signals of a recording; its last window is incomplete and does not count."""
    window = (deadline_ns / WINDOW_NS).astype(np.int64)
    overrun = (flags.astype(np.int64) & int(Flag.OVERRUN)) != 0
    ticks, late, skipped = (np.bincount(window, weights)[:-1] for weights in (None, overrun, missed))
    due = ticks + skipped
    shares = (late[due > 0] / np.maximum(ticks, 1)[due > 0], (late + skipped)[due > 0] / due[due > 0])
    return LateShares(*(float(np.median(share)) for share in shares))


def highest_rates(measure_shares: Callable[[float], LateShares], *, all_rates: bool = False) -> dict[str, Any]:
    """Return for each share the last rate (Hz) of the ladder before the first with too large a share; 0 without one.

    `measure_shares` returns the shares at a rate in Hz. With `all_rates` all rates are measured, and the share of
    overruns at each rate (%) is returned too.
    """
    highest, kept_shares = dict.fromkeys(LateShares._fields, 0.0), set(LateShares._fields)
    percent: dict[str, float] = {}
    for rate_hz in RATES_HZ:
        shares = measure_shares(rate_hz)
        show_progress(f"{rate_hz} Hz: overrun {shares.overrun:.3%}, overrun or skipped {shares.lost:.3%}")
        percent[f"overrun_percent_at_{rate_hz // 1000}_khz"] = 100 * shares.overrun
        kept_shares &= {name for name, share in shares._asdict().items() if share < ALLOWED_SHARE}
        highest |= dict.fromkeys(kept_shares, float(rate_hz))
        if not kept_shares and not all_rates:
            break
    return {f"{name}_hz": rate_hz for name, rate_hz in highest.items()} | (percent if all_rates else {})


def _run_shares(text: str, duration_s: float) -> LateShares:
    """Return the shares of a run; ALL_LATE if the recording lost ticks or an interlock ended the run."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plain_driver.install(folder)
        arguments = "run", write(folder, text), "--duration", str(duration_s), "--out", folder
        try:
            summary, _ = command(*arguments, environment={"PYTHONPATH": str(folder)})
        except CommandFailed as error:
            if error.code != LoopFault.exit_code:
                raise
            show_progress(str(error))
            return ALL_LATE
        if summary["realtime"]["scheduler"] != "SCHED_FIFO":
            raise MeasurementUnavailable(f"the host refused {'; '.join(summary['realtime']['refused'])}")
        if summary["ticks_lost"]:
            return ALL_LATE
        signals = rtloop.load(summary["recording"]).read("deadline_ns", "flags", "periods_missed")
    return late_shares(*signals)


def _host_shares(rate_hz: float, duration_s: float) -> LateShares:
    """Return the shares of an empty loop in C, in a process with the loop's processor, scheduling and priority."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_spin_in_this_process, rate_hz, duration_s).result()


def _spin_in_this_process(rate_hz: float, duration_s: float) -> LateShares:
    """Run the empty loop in this process; return its shares. Raises PermissionError if the host refuses SCHED_FIFO."""
    native.library()
    os.sched_setaffinity(0, {last_cpu()})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    try:
        deadline_ns, late, skipped = native.spin(1e9 / rate_hz, round(rate_hz * duration_s))
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return late_shares(deadline_ns, late * int(Flag.OVERRUN), skipped)


@contextmanager
def _sim() -> Iterator[Configure]:
    """Yield the function that configures the simulated rig."""
    yield lambda changes: changed(*changes)


@contextmanager
def _python() -> Iterator[Configure]:
    """Yield the function that configures the driver in plain Python."""
    yield lambda changes: changed((RIG, PYTHON_DRIVER), *changes)


@contextmanager
def _shm() -> Iterator[Configure]:
    """Run a board in shared memory; yield the function that configures a loop on it."""
    with board() as file:
        yield lambda changes: board_configuration(file, *changes)


def rates(effort: Effort) -> dict[str, Any]:
    """The highest rate in Hz, of a ladder from 5 kHz to 200 kHz, with a share below 0.1 % in the median one-second
    window.

    - `overrun`: share of the ticks with the record's flag `overrun`: the tick ended after its period.
    - `lost`: share of the periods that were overrun or skipped. A tick that a stall delays by many periods is one
      overrun, but all these periods are lost.

    `rtloop run` runs the paper's law (a quarter of its gain) with recording: on the simulated rig, on a driver in
    plain Python, and on a board in shared memory with a separate clock at 10 kHz. The loop sleeps, or spins for
    the last 60 µs. Above 16 kHz it spins all the time; the kernel then gives 5 % of this processor to other
    waiting tasks.

    Beside it, at every rate: `host`, a loop in C that spins for its deadlines and does nothing else, and cyclictest.
    They show what the machine leaves: where they are late too, no program on it is in time.
    """
    duration_s = max(round(effort.duration_s(WINDOWS)), 2) + 0.5
    results: dict[str, Any] = {
        "host": {"spinning": highest_rates(partial(_host_shares, duration_s=duration_s), all_rates=True)},
        "cyclictest": {"sleeping": highest_rates(partial(_cyclictest_shares, duration_s=duration_s), all_rates=True)},
    }
    for name, kind in {"sim": _sim, "python": _python, "shm": _shm}.items():
        with kind() as configure:
            results[name] = {
                pacing: highest_rates(
                    partial(_loop_shares, configure, spin_us, duration_s), all_rates=(name, pacing) == ALL_RATES_LOOP
                )
                for pacing, spin_us in {"sleeping": 0.0, "spinning": SPIN_US}.items()
            }
    return results


def _cyclictest_shares(rate_hz: float, duration_s: float) -> LateShares:
    """Return the share of cyclictest's cycles that woke later than a period, as both shares: cyclictest reports neither
    windows nor skipped cycles. Raises MeasurementUnavailable without cyclictest.
    """
    share = late_cycle_share(last_cpu(), round(rate_hz * duration_s), 1e6 / rate_hz)
    return LateShares(share, share)


def _loop_shares(configure: Configure, spin_us: float, duration_s: float, rate_hz: float) -> LateShares:
    """Run the loop at a rate; return the shares."""
    return _run_shares(configure([at_rate(rate_hz), (STEPS, SINE), LOW_GAIN, *pinned(last_cpu(), spin_us)]), duration_s)
