"""Recover an unfinished or damaged recording: write a new file of all data whose checksums are right.

The original is never changed. A chunk is copied whole or not at all, by its checksum; omitted data is reported.
"""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from typing import Any

from rtloop.errors import OutputError, output_errors
from rtloop.foundation.trusted import close_descriptor, is_own, open_user_file
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.copy_account import CopyAccount
from rtloop.recording.file.mcap.chunks import Opener
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.run_readers import ReportTicks
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import FINAL, FINISHED, RECOVERED
from rtloop.recording.file.writer import Writer

UNFINISHED_SUFFIX = ".recovering"


def recovered_path(path: Path) -> Path:
    """Path of the recovered file: NAME.mcap for NAME.mcap.part, NAME-recovered.mcap for a damaged NAME.mcap."""
    return path.with_suffix("") if path.suffix == ".part" else path.with_name(f"{path.stem}-recovered.mcap")


def find_leftovers(folder: Path) -> list[Path]:
    """Return the unfinished recordings (*.mcap.part) of this user or root in `folder`, sorted.

    Files that a recorder writes, or whose recovered file exists, are left out.
    """
    parts = [part for part in sorted(folder.glob("*.mcap.part")) if not os.path.lexists(recovered_path(part))]
    return [part for part in parts if _is_leftover(part)]


def _is_leftover(part: Path) -> bool:
    """Whether a file belongs to this user or root and no recorder writes it; False if either is unknown."""
    try:
        return is_own(part) and not is_being_written(part)
    except (OSError, RecordingError):
        return False


class RecoveryCopy:
    """Copy of the readable data of `reader` into `writer`."""

    def __init__(self, reader: Reader, writer: Writer) -> None:
        """Prepare to copy from `reader`, which must be tolerant, to `writer`, which has written its header."""
        self._reader, self._writer = reader, writer
        self.account = CopyAccount(reader.first_tick, reader.header["rate_hz"])
        self._original_final: Message | None = None

    def copy(self, progress: ReportTicks | None = None) -> None:
        """Copy all readable ticks and messages in the order of the file, without its header and its final event.

        `progress` receives the number of copied ticks. Raises OutputError if a write fails, RecordingError if the
        original cannot be read.
        """
        for rows, messages in self._reader.chunks():
            if rows is not None:
                self.account.add_rows(rows)
                self._writer.write_ticks(rows)
            else:
                copied = [message for message in messages if self._is_content(message)]
                self.account.add_intervals(self._reader.overview_intervals(copied))
                self._writer.write_messages(copied)
            if progress:
                progress(self._writer.ticks)

    def final_message(self, ticks_logged: int) -> Message:
        """Return the event that ends the recovered file with its `ticks_logged` ticks, as a message.

        The event is the original one if there is one and no fault and no gap was found. Otherwise it is a new event
        RECOVERED with totals, gaps and faults.
        """
        account, problems = self.account, self._reader.problems
        if self._original_final and not problems and not account.gaps:
            return self._original_final
        details = {
            "ticks_executed": account.next_tick,
            "ticks_logged": ticks_logged,
            "ticks_lost": sum(count for _, count in account.gaps),
            **({"ticks_skipped": self._writer.ticks_skipped} if self._reader.header.get("around") else {}),
            "events_lost": 0,
            "result": RECOVERED,
            "complete": False,
            "gaps": account.gaps,
            "problems": problems,
        }
        return account.end_message(RECOVERED, account.next_tick, details, self._writer.start_unix_ns)

    def _is_content(self, message: Message) -> bool:
        """Whether to copy a message: not the header and not the event that ends a file, which are written separately.

        Stores the event that ends the file for `final_message`.
        """
        if message.channel == format.EVENTS and json.loads(message.payload)["kind"] in FINAL:
            self._original_final = message
            return False
        return message.channel != format.CONFIGURATION


def recover(
    path: Path | str,
    output: Path | str | None = None,
    progress: ReportTicks | None = None,
    opener: Opener = open_user_file,
) -> dict[str, Any]:
    """Write a finished recording of the readable data in `path`, which stays unchanged.

    `opener` opens `path`, `progress` receives the number of copied ticks. `output` is by default `recovered_path`; an
    unfinished output of an earlier attempt is removed. Returns {recording, output, ticks, gaps [(first tick, count)],
    problems, complete}: `complete` is True if the file ends a finished run and shows no loss. Raises RecordingError if
    a recorder is writing `path` or it cannot be read, OutputError if the output exists, another process is writing it
    or it cannot be written completely; an incomplete output is removed.
    """
    path = Path(path)
    output = recovered_path(path) if output is None else Path(output)
    if is_being_written(path):
        raise RecordingError(f"{path}: a recorder is writing this file; recover it after the run")
    with Reader(path, tolerant=True, opener=opener) as reader:
        header: dict[str, Any] = {key: value for key, value in reader.header.items() if key != "configuration_sha256"}
        remove_leftover(output, UNFINISHED_SUFFIX)
        log_time = header["created_unix_ns"] if header["paced"] else 0
        writer = Writer(output, header, log_time, message_index=True, suffix=UNFINISHED_SUFFIX)
        try:
            writer.start_unix_ns = reader.start_unix_ns
            recovery = RecoveryCopy(reader, writer)
            recovery.copy(progress)
            final_message = recovery.final_message(writer.ticks)
            writer.finish(recovery.final_message, require_all=True)
        except BaseException:
            writer.discard()
            raise
        final_event = json.loads(final_message.payload)
        return {
            "recording": str(path),
            "output": str(output),
            "ticks": writer.ticks,
            "gaps": recovery.account.gaps,
            "problems": reader.problems,
            "complete": final_event["kind"] == FINISHED and final_event["what"]["complete"],
        }


def remove_leftover(output: Path, suffix: str) -> None:
    """Remove the unfinished file, `output` plus `suffix`, of an earlier attempt to write `output`, if there is one.

    A process that writes such a file holds a lock on the file. Raises OutputError if another process does, or if the
    file cannot be removed, RecordingError if the lock cannot be tested.
    """
    leftover = output.with_name(output.name + suffix)
    if is_being_written(leftover):
        raise OutputError(f"{leftover}: another process writes the same recording", errno.EWOULDBLOCK)
    with output_errors(output):
        leftover.unlink(missing_ok=True)


def is_being_written(path: Path) -> bool:
    """Whether a process that writes the file holds its lock; False on Windows, and if the file cannot be opened.

    Raises RecordingError if the lock cannot be tested.
    """
    try:
        import fcntl
    except ImportError:  # Windows, which has no recorder.
        return False
    try:
        fd = open_user_file(path)
    except OSError:
        return False  # The reader gives the better message.
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError as error:
        reason = (
            f"cannot be locked ({error.strerror}), so a recorder may be writing it; copy it to a local disk, and use "
            "the copy"
        )
        raise RecordingError(f"{path}: {reason}") from None
    finally:
        close_descriptor(fd)
    return False
