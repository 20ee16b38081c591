"""`rtloop.load`: a recording's signals as numpy arrays by name, read when they are first asked for."""

from __future__ import annotations

import glob
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.recording.errors import RecordingError
from rtloop.recording.events import Event
from rtloop.recording.reader import Reader, Rows, Snapshot
from rtloop.signals import COMMON, PER_AXIS

Signal = np.ndarray[Any, Any]
SUFFIX_UNITS = {"um": "µm", "v": "V", "us": "µs", "ns": "ns", "s": "s", "hz": "Hz"}


class Recording:
    """One run: `recording["x_position_um"]` is an array of shape (ticks,), read from the files and then kept.

    Ticks that are missing from the recording are missing from every array alike; `tick` says which are there.
    `problems` says what is wrong with the files; damaged chunks are left out.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = tuple(paths)
        self._signals: dict[str, Signal] = {}
        with self._readers() as readers:
            readers.sort(key=lambda reader: reader.header.get("sequence", 1))
            self.paths = tuple(reader.path for reader in readers)
            self.header: dict[str, Any] = readers[0].header
            self.columns: tuple[str, ...] = readers[0].columns
            self.events: list[Event] = [event for reader in readers for event in reader.events]
            self.problems = [problem for reader in readers for problem in reader.problems]
            self.problems += _check_set(readers)

    @property
    def configuration(self) -> str:
        """The text of the configuration that the run was made with."""
        return self.header.get("configuration", "")

    @property
    def units(self) -> dict[str, str]:
        """Unit of each signal."""
        return {name: unit_of(name) for name in self.columns}

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
        missing = [name for name in names if name not in self._signals]
        if missing:
            with self._readers() as readers:
                blocks = [rows for reader in readers for rows in reader.blocks(missing)]
            for index, name in enumerate(missing):
                parts = [rows[:, index] for rows in blocks]
                signal = np.concatenate(parts) if parts else np.empty(0)
                signal.flags.writeable = False
                self._signals[name] = signal
        return [self._signals[name] for name in names]

    def blocks(self, names: Sequence[str] | None = None) -> Iterator[Rows]:
        """Arrays (n, names) of consecutive ticks, for what does not fit into memory."""
        with self._readers() as readers:
            for reader in readers:
                yield from reader.blocks(names)

    def snapshots(self) -> list[Snapshot]:
        """The recorded states of the law, in order."""
        with self._readers() as readers:
            return [snapshot for reader in readers for snapshot in reader.snapshots()]

    def _readers(self) -> _Readers:
        return _Readers(self.paths)


class _Readers(ExitStack):
    """Readers of several files, closed together."""

    def __init__(self, paths: Sequence[Path]) -> None:
        super().__init__()
        self._paths = paths

    def __enter__(self) -> list[Reader]:  # type: ignore[override]
        try:
            return [self.enter_context(Reader(path, tolerant=True)) for path in self._paths]
        except BaseException:
            self.close()
            raise


def load(path: Path | str | Sequence[Path | str]) -> Recording:
    """Open a recording: a file, a pattern such as `NAME-*.mcap`, or the files of one rotated run in any order.

    Raises RecordingError.
    """
    given = [path] if isinstance(path, str | Path) else list(path)
    paths: list[Path] = []
    for item in given:
        found = sorted(glob.glob(str(item))) if glob.has_magic(str(item)) and not Path(item).exists() else [str(item)]
        paths += map(Path, found)
    if not paths:
        raise RecordingError(f"{path}: no such file")
    return Recording(paths)


def unit_of(name: str) -> str:
    """Unit of a signal by its definition, or by the end of its name where the driver defined it."""
    for signal in (*COMMON, *PER_AXIS):
        if name == signal.name or name.endswith(f"_{signal.name}"):
            return signal.unit
    return SUFFIX_UNITS.get(name.rpartition("_")[2], "")


def _check_set(readers: Sequence[Reader]) -> list[str]:
    """What is missing between the files of one run. Raises RecordingError where they are not of one run."""
    first = readers[0].header
    for reader in readers[1:]:
        if any(reader.header.get(key) != first.get(key) for key in ("created_unix_ns", "name", "columns")):
            raise RecordingError(f"{reader.path}: is not of the same run as {readers[0].path}")
    numbers = [reader.header.get("sequence", 1) for reader in readers]
    if len(set(numbers)) != len(numbers):
        raise RecordingError(f"{readers[0].path}: the same part of the run is given twice")
    absent = sorted(set(range(1, max(numbers) + 1)) - set(numbers))
    return [f"part {number} of the run is missing" for number in absent]
