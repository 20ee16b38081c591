"""Signals of a recording as numpy arrays by name, read from its files on first use."""

from __future__ import annotations

import copy
import math
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from numbers import Real as RealNumber
from pathlib import Path
from typing import NamedTuple, Self, overload

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.recording.columns import signal_unit
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Reader, Rows, Snapshot
from rtloop.recording.file.run_readers import missing_parts, open_run
from rtloop.recording.file.topics.events import Event
from rtloop.recording.file.topics.format import Header, Totals
from rtloop.recording.file.topics.overview import Overview, Range
from rtloop.signals import DEADLINE


class Extent(NamedTuple):
    """Tick range of one file: its first tick and the totals stored at its end (None for an unfinished file).

    `repeated` counts leading ticks that an earlier file holds too; they are read from the earlier file.
    """

    first_tick: int
    totals: Totals | None
    repeated: int


class RecordedSignals:
    """Recorded signals of one run: `recording["x_position_um"]` is an array (ticks,), read once and then cached.

    `recording[0.5:1.0]` is the part from 0.5 s to 1.0 s since the start of the run, both included, with the same
    methods: its signals and events are those of this time, and `header`, `paths`, `extents`, `skipped`, `overview` and
    `snapshots` those of the whole run. `keys()` and iteration give the names of the signals, `len()` the number of
    ticks.

    All arrays lack the same missing ticks; the signal `tick` holds the numbers of the ticks present. `problems` lists
    the faults found in the files read so far. Damaged parts are skipped; `left_out` lists the faults that removed data.
    `extents` holds the tick range of each file, `repeated_events` the loop's events that are read from another file of
    the run instead. `skipped` holds the ranges (first tick, count) that a recording around events omits by intention;
    `overview` holds their extremes and means.

    >>> run = rtloop.load("run.mcap")
    >>> run.keys()[:3]
    ('tick', 'deadline_ns', 'lateness_us')
    >>> step = run[0.2:0.4]
    >>> step["x_reference_um"][[0, -1]], step.time_s[[0, -1]], len(step)
    (array([ 0., -20.]), array([0.2, 0.4]), 2001)
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        """Open the files of one run, in any order, and read headers, events and totals; signals are read on first use.

        Damage is skipped and added to `problems`. Raises RecordingError if a file is missing or no recording, is given
        twice, or belongs to another run.
        """
        self._signals: dict[str, Real] = {}
        self._start_s, self._end_s = -math.inf, math.inf
        self.problems: list[str] = []
        self.left_out: list[str] = []
        with open_run(paths) as readers:
            self.paths = tuple(reader.path for reader in readers)
            self.header: Header = readers[0].header
            self.columns: tuple[str, ...] = readers[0].columns
            self.events: list[Event] = [event for reader in readers for event in reader.events]
            self.repeated_events: list[Event] = [event for reader in readers for event in reader.repeated_events]
            self.extents = tuple(Extent(reader.first_tick, reader.totals, reader.repeated_ticks) for reader in readers)
            self.skipped: list[Range] = [tick_range for reader in readers for tick_range in reader.skipped_ranges]
            self.problems += missing_parts(readers)
            self._collect_problems(readers)

    @property
    def configuration(self) -> str:
        """TOML text of the configuration of the run; "" if the header has none."""
        return self.header.get("configuration", "")

    @cached_property
    def overview(self) -> Overview:
        """Least, largest and mean values of the ticks omitted by intention, by interval, for the whole run.

        Its length is 0 if no tick was omitted. It is read on first use; damaged intervals are left out and added to
        `problems`. Raises RecordingError for a file that cannot be read.
        """
        with self._open_readers() as readers:
            return Overview(self.columns, np.concatenate([reader.overview for reader in readers]))

    @property
    def units(self) -> dict[str, str]:
        """Units of all signals by name, such as {"x_position_um": "µm"}; "" if a unit is unknown.

        For an imported signal, the imported unit goes before the unit by its name.
        """
        imported = self.header.get("imported", {}).get("units", {})
        return {name: imported.get(name) or signal_unit(name) for name in self.columns}

    @property
    def time_s(self) -> Real:
        """Deadline of each tick (ticks,), in s since the start of the run."""
        return self["deadline_ns"] * 1e-9

    def __repr__(self) -> str:
        """Return type, files, axes, rate and number of signals as text, without reading a signal."""
        axes, rate_hz = ", ".join(map(str, self.header.get("axes", ()))), self.header.get("rate_hz")
        files = self.paths[0].name + (f" and {len(self.paths) - 1} more" if len(self.paths) > 1 else "")
        rate = "" if rate_hz is None else f", {rate_hz:g} Hz"
        signals = f"{rate}, {len(self.columns)} signals"
        if self.is_part:
            signals += f", {self._start_s:g} s to {self._end_s:g} s"
        return f"<{type(self).__name__} {files}: {f'axes {axes}' if axes else 'no axes'}{signals}>"

    @overload
    def __getitem__(self, key: str) -> Real: ...
    @overload
    def __getitem__(self, key: slice) -> Self: ...
    def __getitem__(self, key: str | slice) -> Real | Self:
        """Return the values (ticks,) of a signal, read-only, or the part between two times in s, both included.

        Raises RecordingError for an unknown name, a file that cannot be read, and a slice with a step or with a limit
        that is no number.
        """
        return self._part(key) if isinstance(key, slice) else self.read(key)[0]

    def keys(self) -> tuple[str, ...]:
        """Return the names of the signals, in recorded order."""
        return self.columns

    @property
    def is_part(self) -> bool:
        """Whether this is a part of a recording by time."""
        return (self._start_s, self._end_s) != (-math.inf, math.inf)

    def __contains__(self, name: object) -> bool:
        """Whether the recording has a signal of this name."""
        return name in self.columns

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the signals, in recorded order."""
        return iter(self.columns)

    def __len__(self) -> int:
        """Number of ticks present in the recording, or in the part.

        The signal `tick` is read on first use. Raises RecordingError for a file that cannot be read.
        """
        return len(self["tick"])

    def read(self, *names: str) -> list[Real]:
        """Read several signals in one pass over the files, and cache them.

        Returns read-only arrays (ticks,), ordered as `names`, without the ticks of damaged chunks, which are added to
        `problems`. Raises RecordingError for an unknown name and for a file that cannot be read.
        """
        missing = [name for name in dict.fromkeys(names) if name not in self._signals]
        if missing:
            blocks = list(self.blocks(missing))
            for index, name in enumerate(missing):
                parts = [rows[:, index] for rows in blocks]
                signal = np.concatenate(parts) if parts else np.empty(0)
                signal.flags.writeable = False
                self._signals[name] = signal
        return [self._signals[name] for name in names]

    def blocks(self, names: Sequence[str] | None = None, *, ahead: bool = True) -> Generator[Rows]:
        """Yield arrays (n, names) of the ticks, ascending, for recordings larger than memory; None reads all columns.

        A part of a recording yields its own ticks. No signal is cached. Damaged chunks are skipped and added to
        `problems`. With `ahead`, and always for a part, threads decompress the next chunks. Raises RecordingError for
        an unknown name and for a file that cannot be read.
        """
        if self.is_part:
            yield from self.between(self.columns if names is None else names, self._start_s, self._end_s)
            return
        with self._open_readers() as readers:
            for reader in readers:
                yield from reader.blocks(names, ahead=ahead)

    def between(self, names: Sequence[str], start_s: float, end_s: float) -> Generator[Rows]:
        """Yield arrays (n, names) of the ticks due from `start_s` to `end_s`, both included, in s since the start.

        In a part of a recording, the times are limited to the part's. Chunks outside are not read, damaged ones are
        skipped and added to `problems`. Raises RecordingError for an unknown name and for a file that cannot be read.
        """
        start_s, end_s = max(start_s, self._start_s), min(end_s, self._end_s)
        with self._open_readers() as readers:
            for reader in readers:
                entries = reader.chunks_between(start_s, end_s)
                for rows in reader.blocks([self.columns[DEADLINE], *names], entries):
                    in_interval = (rows[:, 0] >= start_s * 1e9) & (rows[:, 0] <= end_s * 1e9)
                    if in_interval.all():
                        yield rows[:, 1:]
                    elif in_interval.any():
                        yield rows[in_interval, 1:]

    def snapshots(self) -> Generator[Snapshot]:
        """Yield the recorded snapshots of the law in order of their ticks, of the whole run also for a part.

        Damaged snapshots are left out, and their faults added to `problems`. Raises RecordingError for a file that
        cannot be read.
        """
        before = -1
        with self._open_readers() as readers:
            for reader in readers:
                for snapshot in reader.snapshots(before):
                    before = snapshot.tick
                    yield snapshot

    def _part(self, times: slice) -> Self:
        """Return the part of this recording between two times, in s since the start, both included; None: no limit.

        In a part of a recording, the times are limited to the part's. Raises RecordingError for a step and for a limit
        that is no number.
        """
        if times.step is not None:
            raise RecordingError(
                f"{self.paths[0]}: slice: step is {times.step!r}; allowed: no step. To take every nth tick, use "
                "to_pandas(every=n)"
            )
        for limit in (times.start, times.stop):
            is_number = isinstance(limit, RealNumber) and not math.isnan(limit)
            if limit is not None and not is_number:
                raise RecordingError(
                    f"{self.paths[0]}: slice: limit is {limit!r}; allowed: a number, in seconds since the start of the "
                    "run"
                )
        part = copy.copy(self)
        part._signals = {}
        part._start_s = self._start_s if times.start is None else max(self._start_s, float(times.start))
        part._end_s = self._end_s if times.stop is None else min(self._end_s, float(times.stop))
        part.events = [event for event in self.events if part._start_s <= event["time_ns"] * 1e-9 <= part._end_s]
        return part

    @contextmanager
    def _open_readers(self) -> Iterator[list[Reader]]:
        """Open the files again. Yields their readers in the order of the run.

        On exit, the faults found while reading are added to `problems` and `left_out`. Raises RecordingError if a file
        cannot be opened or is now one of another run.
        """
        with open_run(self.paths) as readers:
            try:
                yield readers
            finally:
                self._collect_problems(readers)

    def _collect_problems(self, readers: Sequence[Reader]) -> None:
        """Add the faults that the readers found to `problems` and `left_out`, each once."""
        for reader in readers:
            for collected, reader_problems in ((self.problems, reader.problems), (self.left_out, reader.left_out)):
                collected += [problem for problem in reader_problems if problem not in collected]
