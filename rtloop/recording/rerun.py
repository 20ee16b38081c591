"""A loop that runs on recorded inputs: the playback driver in place of hardware and clock."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drivers.base import Channel, Facts, Wiring
from drivers.playback import TIMING_COLUMNS, Playback
from rtloop import signals
from rtloop.engine.assembly import Assembly, LawArrays
from rtloop.engine.clock import clock_context, unpaced_clock
from rtloop.engine.memory import SharedBlock, Word
from rtloop.engine.plan import Pacing, Plan
from rtloop.law.reference import GENERATOR, Generator
from rtloop.signals import Flag, Mode

SLICE_TICKS = 2048
UNLIMITED_SLACK = 1 << 62
Law = LawArrays


class Rerun:
    """The compiled loop with the law `law`, about to execute `first_tick`, under the commands of a recording."""

    def __init__(self, header: Mapping[str, Any], law: Law, commands: np.ndarray[Any, Any], first_tick: int) -> None:
        axes: list[str] = header["axes"]
        self._columns = len(header["columns"])
        self._observed = len(header["observed"])
        self._law, self._tape = law, Playback()
        inputs = tuple(Channel(f"{axis} in") for axis in axes)
        outputs = tuple(Channel(f"{axis} out") for axis in axes)
        plan = Plan(
            name="replay",
            axes=tuple(axes),
            pacing=Pacing(header["rate_hz"], paced=False),
            ticks=None,
            driver_kind="playback",
            driver_options={},
            wiring={axis: Wiring(f"{axis} in", f"{axis} out") for axis in axes},
            coefficients=law.coefficients,
            mode=Mode.OFF,
            generators=np.zeros(len(axes), GENERATOR),
            table=np.zeros(SLICE_TICKS * len(axes)),
            schedule=commands[commands["tick"] >= first_tick],
            observed=tuple(header["observed"]),
        )
        facts = Facts(inputs, outputs, plan.observed, real=False)
        self._block, context = SharedBlock.create(plan.sizes), clock_context(header["rate_hz"])
        ring = self._block.ring("ticks")
        clock = unpaced_clock(context, ring.head, self._block.words, Word.RECORDER_CURSOR, UNLIMITED_SLACK)
        self._keep = context
        self._assembly = Assembly(plan, self._block, facts, self._tape.pointers(), clock, law)
        self._assembly.loop.tick = first_tick
        self._assembly.loop.next_snapshot = np.iinfo(np.int64).max

    def execute(self, rows: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Records (m, columns) of re-executing `rows` (n ≤ SLICE_TICKS, columns); m < n where the loop ended."""
        first = self._assembly.loop.tick
        self._tape.load(self._tape_of(rows))
        self._load_references(rows, first)
        self._assembly.run(first + len(rows))
        executed = self._assembly.loop.tick - first
        slots = self._block["ticks_slots"]
        return slots[(first + np.arange(executed)) & (len(slots) - 1)]

    def law_bytes(self) -> bytes:
        """Coefficients and state as a snapshot holds them."""
        return b"".join(part.tobytes() for part in self._law)

    def _tape_of(self, rows: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Times, status, inputs, age and observed signals of each row, as the playback driver hands them out."""
        axes = len(self._law.axes)
        tape = np.full((len(rows), TIMING_COLUMNS + 1 + axes + 1 + self._observed), np.nan)
        tape[:, 0], tape[:, 2] = rows[:, signals.DEADLINE], rows[:, signals.PERIODS_MISSED]
        lost = (rows[:, signals.FLAGS].astype(np.int64) & int(Flag.HEARTBEAT_LOST)) != 0
        tape[lost, 3] = np.inf  # a heartbeat that was found too old is too old again
        tape[:, TIMING_COLUMNS] = rows[:, signals.DRIVER_STATUS]
        first = TIMING_COLUMNS + 1
        for axis in range(axes):
            tape[:, first + axis] = rows[:, signals.axis_column(axis, signals.ADC)]
        tape[:, first + axes] = rows[:, signals.SAMPLE_AGE]
        if self._observed:
            tape[:, first + axes + 1 :] = rows[:, self._columns - self._observed :]
        return tape

    def _load_references(self, rows: np.ndarray[Any, Any], first_tick: int) -> None:
        """Recorded references, as a table that starts with these rows; commands cannot change them."""
        table, generators = self._block["table"], self._assembly.generators
        for axis in range(len(self._law.axes)):
            start = axis * SLICE_TICKS
            table[start : start + len(rows)] = rows[:, signals.axis_column(axis, signals.REFERENCE)]
            generators["kind"][axis] = Generator.TABLE
            generators["parameters"][axis, :4] = start, len(rows), 1, 0
            generators["start_tick"][axis] = generators["held_until"][axis] = first_tick
