"""Verdicts on recordings, in a worker: one recording is replayed or summarised, and any error becomes a verdict."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from rtloop.campaigns.archive_files import UNFINISHED_SUFFIX
from rtloop.errors import RtloopError, UnavailableError, one_line_error
from rtloop.foundation.trusted import open_user_file
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.conversion import forget_copies
from rtloop.recording.file.recover import is_being_written
from rtloop.recording.file.run_readers import missing_parts, open_run
from rtloop.recording.load import load
from rtloop.recording.replay.laws import recorded_laws
from rtloop.recording.replay.replay import Replay
from rtloop.recording.replay.verdict import ReplayReport
from rtloop.recording.views.summary import Summary, summarise
from rtloop.version import __version__

Row = dict[str, Any]
IDENTICAL, READABLE = "identical", "readable"
DIFFERS, DAMAGED, NOT_VERIFIED, UNFINISHED = "differs", "damaged", "not verified", "unfinished"
OTHER_VERSION, NO_LAW, UNREADABLE = "other version", "no law", "cannot be read"
CRASHED = "crashed its worker"
NEWER_FORMAT = "is newer than this version reads"
"""Part of the reader's message about a recording of a later format."""
NO_END = "the recording has no recorded end: the file is cut off"
NO_TICK = "the recording has no tick"
MAX_REASONS = 3
"""Largest number of faults that a reason lists."""


class Examination(NamedTuple):
    """Examination of a recording: the worker's function, the columns of its rows, and the verdict of a good recording.

    Rows of a call with a folder are stored in the file `file_name`.
    """

    function: Callable[[Sequence[str], str, str | None], Row]
    columns: tuple[str, ...]
    good_verdict: str
    file_name: str


def replay_files(paths: Sequence[str], version: str, stored_sha256: str | None = None) -> Row:
    """Replay the files of a recording in this process. Returns {sha256, verdict, tick, column, reason}.

    `sha256` is that of all bytes of the files; if it is `stored_sha256`, there is no replay, and only {sha256}.
    `verdict` is a text such as "identical", `reason` a text, "" without one. `tick` and `column` name the first
    difference; without one, they are left out. An error, as for an unreadable file, becomes a verdict. Raises
    UnavailableError alone, if this worker's version of rtloop is not `version`.
    """
    return _examine(paths, version, stored_sha256, _replay)


def summarise_files(paths: Sequence[str], version: str, stored_sha256: str | None = None) -> Row:
    """Summarise the files of a recording. Returns {sha256, verdict, ticks, duration_s, lost, trips, reason}.

    `sha256` is that of all bytes of the files; if it is `stored_sha256`, there is no summary, and only {sha256}.
    `verdict` is a text such as "readable", `reason` a text, "" without one; `ticks` and `lost` are numbers of ticks,
    `trips` a list of {tick, causes, reason}. An error becomes a verdict: of a recording that cannot be read, sha256,
    verdict and reason alone are returned. Raises UnavailableError alone, if this worker's version of rtloop is not
    `version`.
    """
    return _examine(paths, version, stored_sha256, _summarise)


REPLAY = Examination(replay_files, ("tick", "column"), IDENTICAL, "verdicts.jsonl")
INFO = Examination(summarise_files, ("ticks", "duration_s", "lost", "trips"), READABLE, "info.jsonl")


def _examine(paths: Sequence[str], version: str, stored_sha256: str | None, judge: Callable[[list[Path]], Row]) -> Row:
    """Return the row that `judge` makes of a recording, with its `sha256`; any error that it raises becomes a verdict.

    The row has `sha256` alone if that is `stored_sha256`; a file that cannot be read has None.
    In its reason, the paths of the files are left out, and characters that cannot be printed become "?". Raises
    UnavailableError if this worker's version of rtloop is not `version`.
    """
    if version != __version__:
        raise UnavailableError(
            f"a worker process has rtloop {__version__}; allowed: {version}, the version of this command; "
            "install equal versions on all workers"
        )
    sha256 = _content_sha256(paths)
    if sha256 is not None and sha256 == stored_sha256:
        return {"sha256": sha256}
    try:
        row = judge([Path(path) for path in paths])
    except RtloopError as error:
        row = _row(OTHER_VERSION if NEWER_FORMAT in str(error) else UNREADABLE, str(error))
    except Exception as error:  # A file may hold anything; the other recordings of the archive get their verdicts.
        row = _row(UNREADABLE, one_line_error(error))
    finally:
        forget_copies()  # an archive may hold more rewritten recordings than a process may have open files
    for path in paths:
        row["reason"] = row["reason"].replace(f"{path}: ", "")
    row["reason"] = "".join(letter if letter.isprintable() else "?" for letter in row["reason"])
    return {"sha256": sha256, **row}


def _content_sha256(paths: Sequence[str]) -> str | None:
    """Return the SHA-256 (hexadecimal) over those of the files, in their order; None if one cannot be read."""
    digest = hashlib.sha256()
    try:
        for path in paths:
            with os.fdopen(open_user_file(Path(path)), "rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
    except OSError:
        return None
    return digest.hexdigest()


def _row(verdict: str, reason: str = "", **values: object) -> Row:
    """Return the row {verdict, **values, reason}; `values` are columns of the examination."""
    return {"verdict": verdict, **values, "reason": reason}


def _replay(paths: list[Path]) -> Row:
    """Return the row of a recording from its replay in this process.

    Without a replay, an unfinished recording gets UNFINISHED, and one whose laws cannot be loaded NO_LAW or
    OTHER_VERSION. Raises RecordingError if the recording cannot be read.
    """
    if _is_unfinished(paths):
        return _row(UNFINISHED, _unfinished_reason(paths[0]))
    recording = load(paths)
    try:
        laws = recorded_laws(recording)
    except RecordingError as error:
        return _row(NO_LAW if "imported" in recording.header else OTHER_VERSION, str(error))
    try:
        with closing(recording.snapshots()) as snapshots:
            report = Replay(recording, laws, snapshots, None).run()
    except RecordingError:
        if not recording.left_out:
            raise
        return _row(
            DAMAGED, _reasons([*recording.left_out[: MAX_REASONS - 1], "no tick can be compared with its replay"])
        )
    return _judge_report(report, _missing_files(paths), recording.extents[-1].totals is None)


def _judge_report(report: ReplayReport, missing: Sequence[str], is_cut_off: bool) -> Row:
    """Return the row of a replay: differs, damaged, identical or not verified, the first of these that applies.

    `missing` are the messages about missing files of the run, which do not count as damage; `is_cut_off` says that the
    recording has no recorded end, which does.
    """
    if difference := report.first_difference:
        values = f"recorded {difference['recorded']!r}, replayed {difference['replayed']!r}"
        return _row(DIFFERS, values, tick=difference["tick"], column=difference["signal"])
    faults = [problem for problem in report.problems if problem not in missing] + [NO_END] * is_cut_off
    if faults:
        return _row(DAMAGED, _reasons([*faults, *(["all ticks are identical"] if report.identical else [])]))
    if report.identical:
        return _row(IDENTICAL, _reasons(missing))
    empty = [] if report.ticks or report.not_verified else [NO_TICK]
    return _row(NOT_VERIFIED, _reasons([*missing, *empty, *(entry["why"] for entry in report.not_verified)]))


def _summarise(paths: list[Path]) -> Row:
    """Return the row of a recording with its figures: unfinished, damaged or readable.

    Raises RecordingError if it cannot be read.
    """
    summary, missing = summarise(paths), _missing_files(paths)
    figures = _figures(summary)
    if _is_unfinished(paths):
        return _row(UNFINISHED, _unfinished_reason(paths[0]), **figures)
    faults = [problem for problem in summary.problems if problem not in missing]
    if summary.result is None:
        faults.append(NO_END)
    if not summary.ticks_logged:
        faults.append(NO_TICK)
    return _row(DAMAGED, _reasons(faults), **figures) if faults else _row(READABLE, _reasons(missing), **figures)


def _figures(summary: Summary) -> Row:
    """Return the figures of a summary: {ticks, duration_s, lost, trips}, a trip as {tick, causes, reason}."""
    trips = [asdict(trip) for trip in summary.trips]
    figures = (summary.ticks_logged, summary.duration_s, summary.ticks_lost, trips)
    return dict(zip(INFO.columns, figures, strict=True))


def _is_unfinished(paths: Sequence[Path]) -> bool:
    """Whether the first of a recording's files has the name of an unfinished file; the names of the others do not
    count.
    """
    return paths[0].name.endswith(UNFINISHED_SUFFIX)


def _unfinished_reason(path: Path) -> str:
    """Return in words whether a recorder still writes an unfinished file, or a run left it behind.

    Raises RecordingError if its lock cannot be tested.
    """
    if is_being_written(path):
        return "a recorder is writing this file"
    return "an unfinished run left this file; complete it with `rtloop recover`"


def _missing_files(paths: Sequence[Path]) -> list[str]:
    """Return a message for each missing file of a rotated run; [] if none is missing, and for a single path.

    Raises RecordingError if a file cannot be opened.
    """
    with open_run(paths) as readers:
        return missing_parts(readers)


def _reasons(messages: Sequence[str]) -> str:
    """Return the first MAX_REASONS different messages as one text, separated by "; "; "" for none."""
    return "; ".join(list(dict.fromkeys(messages))[:MAX_REASONS])
