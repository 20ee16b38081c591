"""What the backends cost a tick: their read and their write, called as the loop calls them."""

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
from tests.benchmarks.board import board, on_a_board, served
from tests.benchmarks.configurations import RIG, SINE, STEPS, at_rate, changed, write
from tests.benchmarks.measure import Effort, in_turn, spread
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
    """An open one. `gap_s` between two ticks, where the other end needs the time to answer."""

    pointers: Pointers
    values: int
    outputs: int
    gap_s: float = 0.0


@contextmanager
def _opened(driver: Driver, gap_s: float = 0.0) -> Iterator[Backend]:
    pointers, facts = driver.open(), driver.facts
    try:
        yield Backend(pointers, len(facts.inputs) + 1 + len(facts.observed), len(facts.outputs), gap_s)
    finally:
        driver.close()


@contextmanager
def _configured(text: str, gap_s: float = 0.0) -> Iterator[Backend]:
    with tempfile.TemporaryDirectory() as name:
        plan = prepare(load(write(Path(name), text))).plan
    with _opened(plan.driver(), gap_s) as backend:
        yield backend


@contextmanager
def _shm() -> Iterator[Backend]:
    with board() as file, _configured(on_a_board(file)) as backend:
        yield backend


@contextmanager
def _can() -> Iterator[Backend]:
    text = changed((RIG, CAN), (STEPS, SINE), at_rate(2000))
    with tempfile.TemporaryDirectory() as name:
        node = "hil", "serve", write(Path(name), text), "--can"
        with served(node), _configured(text, GAP_S) as backend:
            yield backend


@contextmanager
def _playback() -> Iterator[Backend]:
    playback, inputs = Playback(), 5
    rows = np.zeros((PAIRS * 64, TIMING_COLUMNS + 1 + inputs))
    playback.load(rows)
    yield Backend(playback.pointers(), inputs, 1)


@contextmanager
def _comedi() -> Iterator[Backend]:
    kind = driver_class("comedi")
    with _opened(kind(kind.options_model(), {"x": Wiring("ai0", "ao0")}, 10_000.0)) as backend:
        yield backend


BACKENDS = {
    "sim": lambda: _configured(changed()),
    "python": lambda: _opened(LagDriver(LagDriver.options_model(), {"x": Wiring("in", "out")}, 10_000.0)),
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
    found: dict[str, Any] = {}
    with ExitStack() as opened:
        measured = {}
        for name, backend in BACKENDS.items():
            try:
                measured[name] = opened.enter_context(backend())
            except (DriverError, RtloopError, RuntimeError, ValueError) as error:
                found[name] = f"not measured: {error}"
        actions = {name: partial(_ns_per_pair, backend) for name, backend in measured.items()}
        in_turn(actions, 1)
        found |= {f"{name}_ns": spread(values) for name, values in in_turn(actions, effort.pairs).items()}
    return found


def _ns_per_pair(backend: Backend) -> float:
    """Mean of pairs in a row, or median of pairs apart. Raises RuntimeError where one failed."""
    inputs, outputs = np.zeros(backend.values), np.zeros(backend.outputs)
    pairs = partial(driver_calls, tuple(backend.pointers)[:3], inputs, outputs)
    taken_ns = []
    for _ in range(SPACED_PAIRS if backend.gap_s else 1):
        time.sleep(backend.gap_s)
        begin_ns = time.perf_counter_ns()
        worst = pairs(1 if backend.gap_s else PAIRS)
        taken_ns.append((time.perf_counter_ns() - begin_ns) / (1 if backend.gap_s else PAIRS))
        if worst < 0:
            raise RuntimeError(f"backends: a read or a write returned {worst}")
    return float(np.median(taken_ns))
