"""Complete control loop in the test's process, from a configuration's text to records, in virtual or scripted time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.drivers.base import Driver
from rtloop.engine.assembly import Assembly, law_at_rest
from rtloop.engine.clock import Clock, clock_context, unpaced_clock
from rtloop.engine.commands import send
from rtloop.engine.loop import Outcome
from rtloop.engine.memory import SharedBlock, Word
from rtloop.engine.messages import Kind, Origin, message
from rtloop.engine.plan import Plan
from rtloop.engine.ring import drain
from rtloop.foundation.native.compiled import cfunc
from rtloop.foundation.native.pointers import SIGNATURE, address_pointer, carray
from rtloop.recording.file.topics.events import event_from_message

FOR_EVER = 1 << 40

HEAD = """
[loop]
rate_hz = {rate_hz}
mode = "{mode}"
[driver]
kind = "sim"
seed = {seed}
latency_ticks = {latency}
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
"""
IDEAL = """
[driver.plant.hysteresis]
truth = "nominal"
[driver.plant.sensor]
noise_um = 0.0
resolution_um = 0.0
[driver.plant.adc]
bits = 0
[driver.plant.dac]
bits = 0
"""
AXIS = """
[[axis]]
name = "x"
[axis.feedforward]
thresholds_v = [0.095, 0.38, 0.84, 1.46, 2.21, 3.07, 4.01, 4.98, 5.96, 6.89, 7.76, 8.52, 9.14, 9.61, 9.9]
weights_um_per_v = [
    2.55, 0.57, 1.3, -1.57, 1.25, -0.054, -0.032, 0.66, 0.16, -0.77, 2.02, -1.63, -0.15, 2.99, -1.09,
]
"""
EXACT = """
dead_band = "exact"
dead_band_threshold_v = 1e-12
"""
CONTROLLER = """
[axis.controller]
form = "factors"
gain = 0.016
numerator = [[1.0, 7.9e6], [1.0, 971.0, 4.6e5], [1.0, 43.0, 1.4e7]]
denominator = [[1.0, 8.8e4], [1.0, 974.0], [1.0, 1.0], [1.0, 1153.0, 1.6e7]]
"""
MATCHED = 'method = "matched"\n'
TUSTIN = 'method = "tustin"\nprewarp_hz = 595.5\n'


def text(*parts: str, mode: str = "closed_loop", rate_hz: float = 10_000, seed: int = 1, latency: int = 0) -> str:
    """Return a configuration: the head, then `parts` in order."""
    return HEAD.format(mode=mode, rate_hz=rate_hz, seed=seed, latency=latency) + "".join(parts)


def prepare_text(configuration: str, folder: Path = Path()) -> Prepared:
    """Return a prepared, unpaced run without end; its files are relative to `folder`."""
    return prepare(parse(configuration, "test", folder, "test"), paced=False)


def make_plan(configuration: str, folder: Path = Path()) -> Plan:
    """Return the plan of an unpaced run without end."""
    return prepare_text(configuration, folder).plan


class LoopBench:
    """Control loop that a test runs in virtual time or by a scripted `clock`; methods return its records and events."""

    def __init__(self, plan: str | Plan, driver: Driver | None = None, clock: ScriptedClock | None = None) -> None:
        self.plan = make_plan(plan) if isinstance(plan, str) else plan
        self.driver = driver or self.plan.driver()
        self.block = SharedBlock.create(self.plan.sizes)
        self._context = clock_context(self.plan.pacing.rate_hz)
        ticks = self.block.ring("ticks")
        self._chunk = ticks.marks.size // 2
        virtual_clock = unpaced_clock(self._context, ticks.head, self.block["words"], Word.RECORDER_CURSOR, self._chunk)
        self.law = law_at_rest(self.plan)
        self._script = clock
        facts = self.driver.facts
        self.assembly = Assembly(
            self.plan, self.block, facts, self.driver.open(), clock.clock if clock else virtual_clock, self.law
        )
        self.outcome = Outcome.DONE
        self._cursors = {"ticks": 0, "events": 0, "snapshots": 0}

    def run(self, ticks: int) -> npt.NDArray[np.float64]:
        """Run at most `ticks` more ticks and return their records (n, columns); `outcome` is the reason for fewer."""
        end, rows = int(self.assembly.loop.tick) + ticks, []
        self.outcome = Outcome.DONE
        while self.assembly.loop.tick < end and self.outcome is Outcome.DONE:
            self.outcome = self.assembly.run(min(end, int(self.assembly.loop.tick) + self._chunk))
            rows.append(self.drain("ticks"))
            self.block.store(Word.RECORDER_CURSOR, self._cursors["ticks"])
        return np.concatenate(rows)

    def drain(self, name: str) -> npt.NDArray[Any]:
        """Return the new slots of ring `name` since the last call; a lost slot fails the test."""
        ring = self.block.ring(name)
        out = np.empty((ring.marks.size, *ring.slots.shape[1:]), ring.slots.dtype)
        copied, _, lost = drain(ring, self._cursors[name], out)
        assert lost == 0
        self._cursors[name] += int(copied)
        return out[: int(copied)]

    def events(self, values: int = 2) -> list[tuple[Any, ...]]:
        """Return tick, kind and the first `values` values of each new event."""
        return [(int(e["tick"]), Kind(int(e["kind"])), *e["values"][:values].tolist()) for e in self.drain("events")]

    def kinds(self) -> list[Kind]:
        """Return the kind of each new event."""
        return [kind for _, kind, *_ in self.events()]

    def trips(self, laws: Sequence[str] = ()) -> list[dict[str, Any]]:
        """Return the new trips as recorded events."""
        messages = [message for message in self.drain("events") if message["kind"] == Kind.TRIPPED]
        return [event_from_message(message, self.plan.axes, 0, laws) for message in messages]

    def load_law(self, configuration: str) -> None:
        """Send the command that replaces the running law by the law of another configuration."""
        law = make_plan(configuration).coefficients.tobytes()
        self.block["staged"][: len(law)] = np.frombuffer(law, np.uint8)
        self.send(Kind.LOAD_LAW, 1.0, axis=0)

    def send(self, kind: Kind, *values: float, axis: int = -1, origin: Origin = Origin.OPERATOR) -> None:
        """Put a command into the queue."""
        send(self.block, message(kind, axis=axis, origin=origin, values=values))

    def column(self, rows: npt.NDArray[np.float64], name: str) -> npt.NDArray[np.float64]:
        """Return the signal `name` (n,) of the records `rows` (n, columns)."""
        return rows[:, self.plan.columns.index(name)]


SCRIPT = np.dtype(
    [("rows", np.int64), ("row", np.int64), ("address", np.int64), ("readings", np.int64), ("now_ns", np.float64)]
)


@cfunc(SIGNATURE)
def scripted_wait(context, timing):
    """Set `timing` to the next row of the script: deadline, wake, periods missed, CLOCK_MONOTONIC."""
    script = carray(context, 1, SCRIPT)[0]
    if script.row >= script.rows:
        return -1
    data = carray(address_pointer(script.address), (script.rows, 4), np.float64)
    out = carray(timing, 4)
    for i in range(4):
        out[i] = data[script.row, i]
    script.now_ns, script.readings = out[1], 0
    script.row += 1
    return 0


@cfunc(SIGNATURE)
def scripted_now(context, timing):
    """Advance by 4 µs before the first reading of the clock in a tick, by 8 µs before the second, and so on."""
    script = carray(context, 1, SCRIPT)[0]
    script.readings += 1
    script.now_ns += 4_000.0 * script.readings
    carray(timing, 4)[0] = script.now_ns
    return 0


class ScriptedClock:
    """Clock with scripted times: rows of deadline_ns, wake_ns, missed, monotonic_ns."""

    def __init__(self, rows: Sequence[Sequence[float]] | npt.NDArray[np.float64]) -> None:
        self._rows = np.ascontiguousarray(rows, dtype=float)
        self._context = np.zeros(1, SCRIPT)
        self._context["rows"], self._context["address"] = len(self._rows), self._rows.ctypes.data
        self.clock = Clock(scripted_wait.address, scripted_now.address, self._context.ctypes.data)
