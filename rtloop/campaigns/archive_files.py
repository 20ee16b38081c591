"""Recordings of an archive: found by patterns, files and folders, with the files of a rotated run as one recording."""

from __future__ import annotations

import glob
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rtloop.foundation.trusted import close_descriptor, open_user_file
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.recover import recovered_path
from rtloop.recording.file.run_readers import open_run

FINISHED_SUFFIX, UNFINISHED_SUFFIX = ".mcap", ".mcap.part"
NUMBERED = re.compile(r"(.+?)(-\d{4,})?\.mcap")
"""Name of a finished file: the name of its run, and its number if the run was rotated."""


class ArchivedRecording(NamedTuple):
    """Absolute paths of a recording's files, their total size, and the time of the latest change (ns, UNIX)."""

    paths: tuple[str, ...]
    size: int
    mtime_ns: int


def find_recordings(patterns: Iterable[Path]) -> list[ArchivedRecording]:
    """Return the recordings that patterns, files and folders name, sorted by path, each once; the files of a rotated
    run are one recording.

    In a pattern, ** stands for any number of folders; a folder stands for all recordings below it. A folder that cannot
    be read is returned like a recording. An unfinished file whose recovered file exists is left out, unless `patterns`
    has its own path. Raises RecordingError for a path in `patterns` that cannot be opened, and for a pattern or a
    folder without a match; a file that a pattern or a folder leads to raises no error, readable or not.
    """
    paths = {os.path.abspath(path) for pattern in patterns for path in _expand(pattern)}
    return [_read_status(run) for run in sorted(_group_runs(sorted(paths)))]


def _expand(pattern: Path) -> Iterator[str]:
    """Yield the paths of the files that a pattern, a file or a folder names, and of unreadable folders.

    A path may come twice. Raises as `find_recordings`.
    """
    if glob.has_magic(str(pattern)) and not os.path.exists(pattern):
        matches = glob.glob(str(pattern), recursive=True)
        if not matches:
            raise RecordingError(f"{pattern}: no such file")
        if "**" in pattern.parts:
            fixed_parts = pattern.parts[: [*map(glob.has_magic, pattern.parts)].index(True)]
            yield from _files_below(Path(*fixed_parts), ())
        for match in matches:
            if os.path.isdir(match):
                yield from _files_below(Path(match))
            elif not _is_recovered(match):
                yield match
    elif os.path.isdir(pattern):
        paths = list(_files_below(pattern))
        if not paths:
            raise RecordingError(
                f"{pattern}: no recording in or below this folder; allowed: a folder with *.mcap files"
            )
        yield from paths
    else:
        try:
            close_descriptor(open_user_file(pattern))
        except OSError as error:
            raise RecordingError(f"{pattern}: {error.strerror}") from None
        yield str(pattern)


def _files_below(folder: Path, suffixes: tuple[str, ...] = (FINISHED_SUFFIX, UNFINISHED_SUFFIX)) -> Iterator[str]:
    """Yield the files below a folder whose names end in `suffixes`, then the folders that cannot be read.

    An unfinished file whose recovered file exists is left out.
    """
    unreadable: list[str] = []
    for parent, _, names in os.walk(folder, onerror=lambda error: unreadable.append(error.filename)):
        paths = (os.path.join(parent, name) for name in names if name.endswith(suffixes))
        yield from (path for path in paths if not _is_recovered(path))
    yield from unreadable


def _is_recovered(path: str) -> bool:
    """Whether a path is an unfinished recording whose recovered file exists."""
    return path.endswith(UNFINISHED_SUFFIX) and os.path.lexists(recovered_path(Path(path)))


def _group_runs(paths: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Yield the files of each run; `paths` must be sorted, and the runs come in the order of their first files.

    Files are of one run if their paths differ in the number alone, and if `open_run` accepts them together. If it does
    not, each of them is yielded as a run of one file.
    """
    candidates: defaultdict[str, list[str]] = defaultdict(list)
    for path in paths:
        match = NUMBERED.fullmatch(path)
        candidates[match[1] if match else path].append(path)
    for run in candidates.values():
        if len(run) == 1 or _is_one_run(run):
            yield tuple(run)
        else:
            yield from ((path,) for path in run)


def _is_one_run(paths: Sequence[str]) -> bool:
    """Whether all files can be opened together, as files of one run."""
    try:
        with open_run([Path(path) for path in paths]):
            return True
    except RecordingError:
        return False


def _read_status(paths: tuple[str, ...]) -> ArchivedRecording:
    """Return the recording of the files `paths`, with their total size and the time of their latest change.

    A missing file counts with size 0 and time 0.
    """
    sizes, times_ns = [], []
    for path in paths:
        try:
            status = os.stat(path)
        except OSError:
            continue
        sizes.append(status.st_size)
        times_ns.append(status.st_mtime_ns)
    return ArchivedRecording(paths, sum(sizes), max(times_ns, default=0))
