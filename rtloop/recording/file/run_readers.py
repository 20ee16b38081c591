"""The files of one run: found by name or pattern, opened together, in the order of the run."""

from __future__ import annotations

import glob
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path

from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.topics.events import ROTATED
from rtloop.recording.file.topics.header import RUN_KEYS

ReportTicks = Callable[[int], None]
"""Progress callback that receives the number of ticks processed so far."""
RecordingPaths = Path | str | Sequence[Path | str]
"""A file, a pattern such as `NAME-*.mcap`, or the files of one rotated run in any order."""


def find_files(files: RecordingPaths) -> list[Path]:
    """Paths of the given files and patterns, those of a pattern sorted; whether a named file exists is not checked.

    A text with wildcards is a pattern unless a file has this name. Raises RecordingError if a pattern matches no file,
    or `files` is empty.
    """
    items = [files] if isinstance(files, str | Path) else list(files)
    paths: list[Path] = []
    for item in items:
        if glob.has_magic(str(item)) and not Path(item).exists():
            matches = sorted(glob.glob(str(item)))
            if not matches:
                raise RecordingError(f"{item}: no such file")
            paths += map(Path, matches)
        else:
            paths.append(Path(item))
    if not paths:
        raise RecordingError("no recording is given")
    return paths


def run_files(path: Path, suffix: str) -> list[Path]:
    """Existing files of the run recorded as `path` (NAME.mcap) whose names end in `suffix`, such as .mcap.part.

    NAME comes first, then NAME-0001, …; [] if there is none.
    """
    folder, stem = path.parent, glob.escape(path.stem)
    return [*folder.glob(f"{stem}{suffix}"), *sorted(folder.glob(f"{stem}-[0-9][0-9][0-9][0-9]{suffix}"))]


@contextmanager
def open_run(paths: Sequence[Path]) -> Iterator[list[Reader]]:
    """Yield readers of the files of one run, in the order of the run; close them at the end of the block.

    The readers skip damaged data and list the faults. Data that two files hold is read from one of them. Raises
    RecordingError if a file cannot be read, is given twice or belongs to another run.
    """
    with ExitStack() as stack:
        readers = [stack.enter_context(Reader(path, tolerant=True)) for path in paths]
        readers.sort(key=_sequence)
        _require_one_run(readers)
        _assign_ticks(readers)
        yield readers


def missing_parts(readers: Sequence[Reader]) -> list[str]:
    """Return a message for each missing file before, between or after the files of `readers`; [] for a single file.

    `readers` are in the order of the run. A file after the last one is missing if a rotation ended the last one.
    """
    if len(readers) == 1:
        return []
    numbers, last = [_sequence(reader) for reader in readers], readers[-1].totals
    is_continued = last is not None and last["result"] == ROTATED
    expected = range(1, numbers[-1] + 1 + is_continued)
    return [f"file {number} of the run is missing" for number in expected if number not in numbers]


def _sequence(reader: Reader) -> int:
    """Number of the file in its run, from 1."""
    return int(reader.header.get("sequence", 1))


def _assign_ticks(readers: Sequence[Reader]) -> None:
    """Let each file of a run begin where the earlier files end, so that each tick, event and snapshot is read once.

    `readers` are in the order of the run. An unfinished file ends at `repeats_before` of the next file's header.
    """
    end_tick = 0
    for number, (previous, reader) in enumerate(pairwise(readers), start=1):
        is_next = _sequence(reader) == _sequence(previous) + 1
        repeats_before = reader.header.get("repeats_before") if is_next else None
        end_tick = max(end_tick, previous.totals["ticks_executed"] if previous.totals else repeats_before or 0)
        reader.restrict_begin(end_tick)
        if repeats_before is not None and (reader.totals is None or reader.totals["ticks_executed"] > end_tick):
            for earlier_reader in readers[:number]:
                earlier_reader.restrict_end(min(repeats_before, end_tick))


def _require_one_run(readers: Sequence[Reader]) -> None:
    """Raise RecordingError for a file of another run, or two files of one number; `readers` are sorted by number."""
    first, numbers = readers[0], [_sequence(reader) for reader in readers]
    for reader in readers[1:]:
        if any(reader.header.get(key) != first.header.get(key) for key in RUN_KEYS):
            raise RecordingError(f"{reader.path}: not of the same run as {first.path}; give only files of one run")
    for reader, number, next_number in zip(readers[1:], numbers, numbers[1:], strict=False):
        if number == next_number:
            raise RecordingError(f"{reader.path}: file {number} of the run is given twice; give only one of the two")
