"""`rtloop.load`: a recording's signals as numpy arrays by name, read when they are first asked for."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rtloop.recording.file.parts import RecordingPaths, RunReaders, find_files, missing_parts
from rtloop.recording.file.reader import Reader, Rows, Snapshot
from rtloop.recording.file.topics.events import Event
from rtloop.recording.file.topics.overview import Overview, Range
from rtloop.signals import AXIS_SIGNALS, COMMON_SIGNALS, DEADLINE
from rtloop.signals import Signal as Column

if TYPE_CHECKING:
    import pandas
    import xarray

Signal = np.ndarray[Any, Any]
SUFFIX_UNITS = {"um": "µm", "v": "V", "us": "µs", "ns": "ns", "s": "s", "hz": "Hz"}


class Extent(NamedTuple):
    """What a file says of its ticks: the first one, and what was counted at its end; None where it has none.

    `repeated` ticks in front of the first one stand in an earlier file too, and are taken from there.
    """

    first_tick: int
    totals: dict[str, Any] | None
    repeated: int


class Recording:
    """One run: `recording["x_position_um"]` is an array of shape (ticks,), read from the files and then kept.

    Ticks that are missing from the recording are missing from every array alike; `tick` says which are there.
    `problems` says what is wrong with the files, as far as they were read; what is damaged is left out, and those of
    the problems that leave something out are `left_out` as well. `extents` is what each file says of its ticks.
    `skipped` are the ticks, (first, how many), that a recording around events leaves out; `overview` tells of them.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._signals: dict[str, Signal] = {}
        self.problems: list[str] = []
        self.left_out: list[str] = []
        with RunReaders(paths) as readers:
            self.paths = tuple(reader.path for reader in readers)
            self.header: dict[str, Any] = readers[0].header
            self.columns: tuple[str, ...] = readers[0].columns
            self.events: list[Event] = [event for reader in readers for event in reader.events]
            self.extents = tuple(Extent(reader.first_tick, reader.totals, reader.repeated_ticks) for reader in readers)
            self.skipped: list[Range] = [tick_range for reader in readers for tick_range in reader.skipped_ranges]
            self.problems += missing_parts(readers)
            self._collect_problems(readers)

    @property
    def configuration(self) -> str:
        """The text of the configuration that the run was made with."""
        return self.header.get("configuration", "")

    @cached_property
    def overview(self) -> Overview:
        """What is left of the ticks that were left out by intention."""
        with self._open_readers() as readers:
            return Overview(self.columns, np.concatenate([reader.overview for reader in readers]))

    @property
    def units(self) -> dict[str, str]:
        """Unit of each signal."""
        imported = self.header.get("imported", {}).get("units", {})
        return {name: imported.get(name) or signal_unit(name) for name in self.columns}

    @property
    def time_s(self) -> Signal:
        """When each tick was due, in s since the start of the run."""
        return self["deadline_ns"] * 1e-9

    def __getitem__(self, name: str) -> Signal:
        return self.read(name)[0]

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        """Ticks in the recording."""
        return len(self["tick"])

    def read(self, *names: str) -> list[Signal]:
        """Several signals in one pass over the files."""
        missing = [name for name in dict.fromkeys(names) if name not in self._signals]
        if missing:
            blocks = list(self.blocks(missing))
            for index, name in enumerate(missing):
                parts = [rows[:, index] for rows in blocks]
                signal = np.concatenate(parts) if parts else np.empty(0)
                signal.flags.writeable = False
                self._signals[name] = signal
        return [self._signals[name] for name in names]

    def blocks(self, names: Sequence[str] | None = None) -> Generator[Rows]:
        """Arrays (n, names) of consecutive ticks, for what does not fit into memory."""
        with self._open_readers() as readers:
            for reader in readers:
                yield from reader.blocks(names)

    def between(self, names: Sequence[str], start_s: float, end_s: float) -> Generator[Rows]:
        """Arrays (n, names) of the ticks that were due between two times; chunks outside are not read."""
        with self._open_readers() as readers:
            for reader in readers:
                entries = reader.chunks_between(start_s, end_s)
                for rows in reader.blocks([self.columns[DEADLINE], *names], entries):
                    in_interval = (rows[:, 0] >= start_s * 1e9) & (rows[:, 0] <= end_s * 1e9)
                    if in_interval.all():
                        yield rows[:, 1:]
                    elif in_interval.any():
                        yield rows[in_interval, 1:]

    def to_pandas(
        self, signals: Sequence[str] = (), start_s: float = 0.0, end_s: float = math.inf, every: int = 1
    ) -> pandas.DataFrame:
        """Signals (names or patterns, all by default) between two times as a DataFrame over the time in s.

        Its `attrs` hold `units` and `events`. Raises RecordingError, MissingExtra.
        """
        from rtloop.recording.views import frames, selection

        return frames.to_pandas(self, selection.Selection(tuple(signals), start_s, end_s, every))

    def to_xarray(
        self, signals: Sequence[str] = (), start_s: float = 0.0, end_s: float = math.inf, every: int = 1
    ) -> xarray.Dataset:
        """The same as a Dataset, with the units in each variable's `attrs` and the events, as JSON, in its own."""
        from rtloop.recording.views import frames, selection

        return frames.to_xarray(self, selection.Selection(tuple(signals), start_s, end_s, every))

    def snapshots(self) -> Generator[Snapshot]:
        """The recorded states of the law, in order."""
        before = -1
        with self._open_readers() as readers:
            for reader in readers:
                for snapshot in reader.snapshots(before):
                    before = snapshot.tick
                    yield snapshot

    @contextmanager
    def _open_readers(self) -> Iterator[list[Reader]]:
        """The files, opened once more; what turns out to be wrong with them is noted, however far they are read."""
        with RunReaders(self.paths) as readers:
            try:
                yield readers
            finally:
                self._collect_problems(readers)

    def _collect_problems(self, readers: Sequence[Reader]) -> None:
        for reader in readers:
            for collected, reader_problems in ((self.problems, reader.problems), (self.left_out, reader.left_out)):
                collected += [problem for problem in reader_problems if problem not in collected]


def load(path: RecordingPaths) -> Recording:
    """Open a recording: a file, a pattern such as `NAME-*.mcap`, or the files of one rotated run in any order.

    Raises RecordingError.
    """
    return Recording(find_files(path))


def signal_unit(name: str) -> str:
    """Unit of a signal by its definition, or by the end of its name where the driver defined it."""
    return describe_signal(name).unit


def describe_signal(name: str) -> Column:
    """A signal of a record: its unit, and its meaning where it is one that every loop has."""
    for signal in COMMON_SIGNALS:
        if name == signal.name:
            return signal
    for signal in AXIS_SIGNALS:
        if name.endswith(f"_{signal.name}"):
            return Column(name, signal.unit, f"{name.removesuffix(f'_{signal.name}')}: {signal.meaning}")
    return Column(name, SUFFIX_UNITS.get(name.rpartition("_")[2], ""), "")
