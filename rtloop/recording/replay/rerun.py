"""The compiled loop on recorded references and commands, with recorded inputs or a simulated rig, not hardware."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rtloop import signals
from rtloop.drivers.base import Channel, Driver, Facts, Pointers, Wiring
from rtloop.drivers.playback import TIMING_COLUMNS, Playback
from rtloop.engine.assembly import Assembly
from rtloop.engine.clock import clock_context, unpaced_clock
from rtloop.engine.memory import SharedBlock, Word
from rtloop.engine.plan import Pacing, Plan
from rtloop.foundation.arrays import Real
from rtloop.kernel.memory import LawMemory
from rtloop.kernel.reference import GENERATOR, Generator
from rtloop.laws.registry import LawReference
from rtloop.recording.file.topics.format import Header
from rtloop.recording.file.topics.validation import header_extra_channels, header_extras
from rtloop.recording.replay.kernels import fill_tape
from rtloop.signals import Mode

SLICE_TICKS = 4096
SMALLEST_RING_HZ = 1.0
"""Rate that makes the smallest ring: it holds a slice and fits the processor's cache."""
UNLIMITED_SLACK = NEVER = 1 << 62
TICK_BYTES = 8
Rows = Real


class RecordedInputs:
    """Recorded inputs, times, driver status and observed signals, through the playback driver."""

    enable_input = "enable"

    def __init__(self, header: Header) -> None:
        """Prepare the playback driver for a recording with this header; `load` gives it the ticks."""
        axes, observed = header["axes"], tuple(header["observed"])
        channels = [tuple(Channel(f"{axis} {way}") for axis in axes) for way in ("in", "out")]
        self._extras = header_extras(header)
        self.extra_channels = {name: f"extra {name}" for name in header_extra_channels(header)}
        input_channels = tuple(Channel(self.extra_channels[name]) for name in self._extras.inputs)
        output_channels = tuple(Channel(self.extra_channels[output.name]) for output in self._extras.outputs)
        inputs = (*channels[0], Channel("enable"), *input_channels)
        self.facts = Facts(inputs, (*channels[1], *output_channels), observed, real=False)
        self.wiring = {axis: Wiring(f"{axis} in", f"{axis} out") for axis in axes}
        tape_columns = TIMING_COLUMNS + 1 + len(inputs) + 1 + len(observed)
        self._tape = np.full((SLICE_TICKS, tape_columns), np.nan)
        self._refused_writes = np.zeros(SLICE_TICKS, np.bool_)
        first_extra = signals.axis_column(len(axes), 0)
        recorded_columns = [
            signals.DRIVER_STATUS,
            *(signals.axis_column(axis, signals.ADC) for axis in range(len(axes))),
            signals.ENABLE,
            *range(first_extra, first_extra + len(input_channels)),
            signals.SAMPLE_AGE,
            *range(len(header["columns"]) - len(observed), len(header["columns"])),
        ]
        self._pairs = np.array([[TIMING_COLUMNS + i, column] for i, column in enumerate(recorded_columns)], np.int64)
        self._playback = Playback()

    def pointers(self) -> Pointers:
        """Return the addresses of the playback driver's functions and context."""
        return self._playback.pointers()

    def load(self, rows: Rows) -> None:
        """Load at most SLICE_TICKS rows (n, columns) into the playback driver, in place of the former ones."""
        fill_tape(rows, self._pairs, self._tape, self._refused_writes)
        self._playback.load(self._tape[: len(rows)], self._refused_writes[: len(rows)])


class SimulatedInputs:
    """Simulated rig as a source of inputs: it responds to the drive of the law, not to the recording."""

    enable_input = None

    def __init__(self, driver: Driver, extra_channels: dict[str, str]) -> None:
        """Take `driver`, a simulated rig that is not open yet.

        `extra_channels` {name: channel} are the recording's inputs and outputs besides sensors and drives.
        """
        self.extra_channels = extra_channels
        self.facts, self.wiring, self._driver = driver.facts, driver.wiring, driver

    def pointers(self) -> Pointers:
        """Open the simulated rig. Returns the addresses of its functions and context.

        The owner of the rig closes it; this class does not. Raises DriverError if the rig cannot be opened.
        """
        return self._driver.open()

    def load(self, rows: Rows) -> None:
        """Ignore the recorded rows: a rig does not use them."""


InputSource = RecordedInputs | SimulatedInputs
"""Source of the inputs of a rerun: `pointers` gives the driver, `load` prepares for at most SLICE_TICKS rows."""


class Rerun:
    """Loop with the law `law`, ready to execute `first_tick`, with the `commands` from then on."""

    def __init__(
        self,
        header: Header,
        source: InputSource,
        laws: Sequence[LawReference],
        law: LawMemory,
        commands: npt.NDArray[np.void],
        first_tick: int,
    ) -> None:
        """Build the loop; this opens a simulated rig of `source`, and executes no tick.

        Raises DriverError if the rig cannot be opened.
        `laws` name the code of the laws, `law` is their memory before `first_tick`, which the rerun advances.
        `commands` (n,) are recorded commands to the loop, records of MESSAGE due at `first_tick` or later.
        """
        self.law, self._source = law, source
        plan = _make_rerun_plan(header, source, laws, law, commands)
        self._block = SharedBlock.create_private(plan.sizes._replace(rate_hz=SMALLEST_RING_HZ))
        self._slots = self._block["ticks_slots"]
        self._context = clock_context(header["rate_hz"])
        self._context.index = first_tick
        head, words = self._block.ring("ticks").head, self._block["words"]
        clock = unpaced_clock(self._context, head, words, Word.RECORDER_CURSOR, UNLIMITED_SLACK)
        self._assembly = Assembly(plan, self._block, source.facts, source.pointers(), clock, law)
        self._assembly.loop.next_snapshot = self._assembly.loop.snapshot_ticks = NEVER

    def max_ticks(self, tick: int) -> int:
        """Number of ticks from `tick` on that one call of `execute` can execute."""
        return min(SLICE_TICKS, len(self._slots) - tick % len(self._slots))

    def execute(self, rows: Rows) -> Rows:
        """Execute the consecutive ticks of `rows` (n, columns), 0 < n ≤ `max_ticks`. Returns its records (m, columns).

        m < n if the loop ended. The records are a view, valid until the next call. Missing ticks before `rows` are
        skipped.
        """
        first = int(rows[0, signals.TICK])
        self._assembly.loop.tick = first
        self._source.load(rows)
        self._load_references(rows, first)
        self._assembly.run(first + len(rows))
        start = first % len(self._slots)
        return self._slots[start : start + int(self._assembly.loop.tick) - first]

    def expect_snapshot(self, recorded: bytes) -> None:
        """Let the next tick take a snapshot, and provide coefficients to a command that loads new ones.

        The coefficients are from `recorded`, the recorded snapshot of that tick, which begins with the tick's number.
        """
        size = self.law.coefficients.nbytes
        self._block["staged"][:size] = np.frombuffer(recorded, np.uint8, size, TICK_BYTES)
        self._assembly.loop.next_snapshot = 0

    def newest_snapshot(self) -> bytes:
        """Bytes of the newest snapshot that the rerun took; the first eight are its tick. There must be one."""
        ring = self._block.ring("snapshots")
        return ring.slots[(int(ring.head[0]) - 1) % len(ring.marks)].tobytes()

    def _load_references(self, rows: Rows, first_tick: int) -> None:
        """Let every axis follow the recorded reference and feed of `rows`, in a table that no command can change."""
        table, generators = self._block["table"], self._assembly.generators
        for axis in range(len(self.law.axes)):
            start, count = 2 * axis * SLICE_TICKS, len(rows)
            table[start : start + count] = rows[:, signals.axis_column(axis, signals.REFERENCE)]
            table[start + count : start + 2 * count] = rows[:, signals.axis_column(axis, signals.FEED)]
            generators["kind"][axis] = Generator.TABLE
            generators["parameters"][axis, :5] = start, count, 1, 0, 1
            generators["start_tick"][axis] = generators["held_until"][axis] = first_tick


def _make_rerun_plan(
    header: Header,
    source: InputSource,
    laws: Sequence[LawReference],
    law: LawMemory,
    commands: npt.NDArray[np.void],
) -> Plan:
    """Make the plan of an unpaced loop that executes recorded ticks again, on the channels of `source`.

    `laws` name the code of the recorded laws, `law` has their memory with the coefficients. `commands` (n,) are records
    of MESSAGE, due at their ticks. The references come from a table.
    """
    axes = tuple(header["axes"])
    return Plan(
        name="rerun",
        axes=axes,
        pacing=Pacing(header["rate_hz"], paced=False),
        ticks=None,
        driver_kind="playback",
        driver_options={},
        wiring=source.wiring,
        laws=tuple(laws),
        coefficients=law.coefficients,
        mode=Mode.OFF,
        generators=np.zeros(len(axes), GENERATOR),
        table=np.zeros(2 * SLICE_TICKS * len(axes)),
        schedule=commands,
        observed=source.facts.observed,
        extras=header_extras(header),
        extra_channels=source.extra_channels,
        enable_input=source.enable_input,
    )
