"""How fast the loop can be paced before ticks overrun."""

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
from tests.benchmarks.board import board, on_a_board
from tests.benchmarks.configurations import RIG, SINE, STEPS, at_rate, changed, last_cpu, pinned, write
from tests.benchmarks.lateness import PRIORITY, cycles_beyond
from tests.benchmarks.measure import Effort, NotMeasured, say
from tests.benchmarks.processes import Failed
from tests.benchmarks.processes import rtloop as command

RATES_HZ = (5_000, 10_000, 20_000, 30_000, 50_000, 70_000, 100_000, 140_000, 200_000)
WINDOW_NS = 1e9
WINDOWS = 7
ALLOWED = 0.001
SPIN_US = 60.0
WHOLE = "sim", "spinning"
"""The loop that is measured at every rate of the ladder, beside what the host leaves."""
GENTLE = ("gain = 0.016", "gain = 0.004")
"""The paper's controller has hardly any margin: with another plant, or a board's delay, it would trip."""
PLAIN = f"""[driver]
kind = "{plain_driver.LagDriver.kind}"
[driver.channels.x]
input = "in"
output = "out"
um_per_v = {plain_driver.SENSOR_UM_PER_V}

"""

Signal = np.ndarray[Any, Any]
Configure = Callable[[list[tuple[str, str]]], str]


class Late(NamedTuple):
    """Shares in the median one-second window: ticks that overran, and periods that were overrun or skipped."""

    overrun: float
    lost: float


NOT_KEPT = Late(1.0, 1.0)


def late_shares(deadline_ns: Signal, flags: Signal, missed: Signal) -> Late:
    """Of the signals of a recording, its last window, which is not whole, left out."""
    window = (deadline_ns / WINDOW_NS).astype(np.int64)
    overrun = (flags.astype(np.int64) & int(Flag.OVERRUN)) != 0
    ticks, late, skipped = (np.bincount(window, weights)[:-1] for weights in (None, overrun, missed))
    due = ticks + skipped
    shares = (late[due > 0] / np.maximum(ticks, 1)[due > 0], (late + skipped)[due > 0] / due[due > 0])
    return Late(*(float(np.median(share)) for share in shares))


def highest_rates(late_at: Callable[[float], Late], *, whole: bool = False) -> dict[str, Any]:
    """Hz, for each share: the last rate of the ladder before the first one that is not kept; 0 where none is.

    `late_at` returns the shares at a rate in Hz. `whole`: the ladder does not end there, and the share of overruns at
    each rate is returned too, in %.
    """
    highest, kept = dict.fromkeys(Late._fields, 0.0), set(Late._fields)
    percent: dict[str, float] = {}
    for rate_hz in RATES_HZ:
        late = late_at(rate_hz)
        say(f"{rate_hz} Hz: overrun {late.overrun:.3%}, overrun or skipped {late.lost:.3%}")
        percent[f"overrun_percent_at_{rate_hz // 1000}_khz"] = 100 * late.overrun
        kept &= {name for name, share in late._asdict().items() if share < ALLOWED}
        highest |= dict.fromkeys(kept, float(rate_hz))
        if not kept and not whole:
            break
    return {f"{name}_hz": rate_hz for name, rate_hz in highest.items()} | (percent if whole else {})


def _run(text: str, duration_s: float) -> Late:
    """The shares of a run; all of it where ticks were lost to the recording, or an interlock ended the run."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plain_driver.install(folder)
        arguments = "run", write(folder, text), "--duration", str(duration_s), "--out", folder
        try:
            summary, _ = command(*arguments, environment={"PYTHONPATH": str(folder)})
        except Failed as error:
            if error.code != LoopFault.exit_code:
                raise
            say(str(error))
            return NOT_KEPT
        if summary["realtime"]["scheduler"] != "SCHED_FIFO":
            raise NotMeasured(f"the host refused {'; '.join(summary['realtime']['refused'])}")
        if summary["ticks_lost"]:
            return NOT_KEPT
        signals = rtloop.load(summary["recording"]).read("deadline_ns", "flags", "periods_missed")
    return late_shares(*signals)


def _bare_spin(rate_hz: float, duration_s: float) -> Late:
    """The shares of a loop in C that does nothing, in a process with the loop's processor, scheduling and priority."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_spin_here, rate_hz, duration_s).result()


def _spin_here(rate_hz: float, duration_s: float) -> Late:
    """Spin in this process, as the loop's process would. Raises PermissionError where the host refuses SCHED_FIFO."""
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
    yield lambda changes: changed(*changes)


@contextmanager
def _plain() -> Iterator[Configure]:
    yield lambda changes: changed((RIG, PLAIN), *changes)


@contextmanager
def _shm() -> Iterator[Configure]:
    with board() as file:
        yield lambda changes: on_a_board(file, *changes)


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
    duration_s = max(round(effort.seconds(WINDOWS)), 2) + 0.5
    found: dict[str, Any] = {
        "host": {"spinning": highest_rates(partial(_bare_spin, duration_s=duration_s), whole=True)},
        "cyclictest": {"sleeping": highest_rates(partial(_cyclictest, duration_s=duration_s), whole=True)},
    }
    for name, kind in {"sim": _sim, "python": _plain, "shm": _shm}.items():
        with kind() as configure:
            found[name] = {
                way: highest_rates(partial(_loop, configure, spin_us, duration_s), whole=(name, way) == WHOLE)
                for way, spin_us in {"sleeping": 0.0, "spinning": SPIN_US}.items()
            }
    return found


def _cyclictest(rate_hz: float, duration_s: float) -> Late:
    """The share of cyclictest's cycles that woke later than a period; it tells nothing of windows and skipped cycles.

    Raises NotMeasured without cyclictest.
    """
    share = cycles_beyond(last_cpu(), round(rate_hz * duration_s), 1e6 / rate_hz)
    return Late(share, share)


def _loop(configure: Configure, spin_us: float, duration_s: float, rate_hz: float) -> Late:
    """The shares of a run of the loop at a rate."""
    return _run(configure([at_rate(rate_hz), (STEPS, SINE), GENTLE, *pinned(last_cpu(), spin_us)]), duration_s)
