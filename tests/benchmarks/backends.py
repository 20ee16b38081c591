"""Cost of each driver backend in a tick: its read and its write, called through pointers as the loop calls them."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.drivers.base import Driver, Pointers, Wiring
from rtloop.drivers.errors import DriverError
from rtloop.drivers.playback import TIMING_COLUMNS, Playback
from rtloop.drivers.registry import driver_class
from rtloop.errors import RtloopError
from tests.benchmarks.board import board, board_configuration, running_rtloop
from tests.benchmarks.configurations import RIG, SINE, STEPS, at_rate, changed, write
from tests.benchmarks.measure import Effort, interleave, spread
from tests.benchmarks.overhead import driver_calls
from tests.benchmarks.plain_driver import LagDriver

PAIRS, SPACED_PAIRS = 100_000, 300
GAP_S = 0.002
CAN = """[driver]
kind = "can"
interface = "udp_multicast"
channel = "239.74.163.78"
settings = { hop_limit = 0 }
wait_s = 30.0
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0

"""


class Backend(NamedTuple):
    """An open backend: pointers, lengths of its two arrays, and the time between two ticks that the other end needs."""

    pointers: Pointers
    values: int
    outputs: int
    gap_s: float = 0.0


@contextmanager
def _open_driver(driver: Driver, gap_s: float = 0.0) -> Iterator[Backend]:
    """Open a driver, yield its backend, and close the driver."""
    pointers, facts = driver.open(), driver.facts
    try:
        yield Backend(pointers, len(facts.inputs) + 1 + len(facts.observed), len(facts.outputs), gap_s)
    finally:
        driver.close()


@contextmanager
def _open_configured(text: str, gap_s: float = 0.0) -> Iterator[Backend]:
    """Yield the backend of a configuration's driver."""
    with tempfile.TemporaryDirectory() as name:
        plan = prepare(load(write(Path(name), text))).plan
    with _open_driver(plan.driver(), gap_s) as backend:
        yield backend


@contextmanager
def _shm() -> Iterator[Backend]:
    """Yield the backend of a board in shared memory, which a separate process serves."""
    with board() as file, _open_configured(board_configuration(file)) as backend:
        yield backend


@contextmanager
def _can() -> Iterator[Backend]:
    """Yield the backend of a CAN node, which a separate process serves by UDP multicast."""
    text = changed((RIG, CAN), (STEPS, SINE), at_rate(2000))
    with tempfile.TemporaryDirectory() as name:
        node = "hil", "serve", write(Path(name), text), "--can"
        with running_rtloop(node), _open_configured(text, GAP_S) as backend:
            yield backend


@contextmanager
def _playback() -> Iterator[Backend]:
    """Yield the backend of a replay, with enough rows for all pairs."""
    playback, inputs = Playback(), 5
    rows = np.zeros((PAIRS * 64, TIMING_COLUMNS + 1 + inputs))
    playback.load(rows)
    yield Backend(playback.pointers(), inputs, 1)


@contextmanager
def _comedi() -> Iterator[Backend]:
    """Yield the backend of a comedi board."""
    kind = driver_class("comedi")
    with _open_driver(kind(kind.options_model(), {"x": Wiring("ai0", "ao0")}, 10_000.0)) as backend:
        yield backend


BACKENDS = {
    "sim": lambda: _open_configured(changed()),
    "python": lambda: _open_driver(LagDriver(LagDriver.options_model(), {"x": Wiring("in", "out")}, 10_000.0)),
    "shm": _shm,
    "can": _can,
    "comedi": _comedi,
    "playback": _playback,
}


def backends(effort: Effort) -> dict[str, Any]:
    """ns a tick of each backend: one read and one write. Compiled code calls them through their pointers as the loop
    does, one pair after the other. A backend that cannot be opened here has the reason in place of a figure.

    - `python`: a first-order lag in plain Python.
    - `shm`: the board is a separate process.
    - `can`: the node is a separate process, over UDP multicast on this machine and not over a wire. Pairs are 2
      ms apart so that the node has answered.
    - `playback`: the source of a replay.
    """
    results: dict[str, Any] = {}
    with ExitStack() as stack:
        available = {}
        for name, backend in BACKENDS.items():
            try:
                available[name] = stack.enter_context(backend())
            except (DriverError, RtloopError, RuntimeError, ValueError) as error:
                results[name] = f"not measured: {error}"
        actions = {name: partial(_ns_per_pair, backend) for name, backend in available.items()}
        interleave(actions, 1)
        results |= {f"{name}_ns": spread(values) for name, values in interleave(actions, effort.pairs).items()}
    return results


def _ns_per_pair(backend: Backend) -> float:
    """Return ns of a read and a write: mean of pairs in a row, or median if they are apart. Raises RuntimeError."""
    inputs, outputs = np.zeros(backend.values), np.zeros(backend.outputs)
    run_pairs = partial(driver_calls, tuple(backend.pointers)[:3], inputs, outputs)
    pair_ns = []
    for _ in range(SPACED_PAIRS if backend.gap_s else 1):
        time.sleep(backend.gap_s)
        begin_ns = time.perf_counter_ns()
        lowest_status = run_pairs(1 if backend.gap_s else PAIRS)
        pair_ns.append((time.perf_counter_ns() - begin_ns) / (1 if backend.gap_s else PAIRS))
        if lowest_status < 0:
            raise RuntimeError(f"backends: a read or a write returned {lowest_status}")
    return float(np.median(pair_ns))
