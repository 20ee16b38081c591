"""Completes a recording that was killed, cut off or damaged: a new file with everything that is provably right.

The original is never changed. A chunk is taken whole or not at all, by its checksum; what is left out is said.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rtloop.errors import output_errors
from rtloop.foundation.trusted import close_descriptor, is_own, open_user_file
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.mcap.chunks import Opener
from rtloop.recording.file.reader import Reader, Rows
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import FINAL, FINISHED, RECOVERED, recorder_event
from rtloop.recording.file.topics.overview import MAXIMUM, tick_ranges
from rtloop.recording.file.topics.ticks import missing_ranges
from rtloop.recording.file.writer import Writer
from rtloop.signals import DEADLINE, TICK

UNFINISHED_SUFFIX = ".recovering"
ReportTicks = Callable[[int], None]


def recovered_path(path: Path) -> Path:
    """The recovered file's name: NAME.mcap for NAME.mcap.part, NAME-recovered.mcap for a damaged NAME.mcap."""
    return path.with_suffix("") if path.suffix == ".part" else path.with_name(f"{path.stem}-recovered.mcap")


def find_leftovers(folder: Path) -> list[Path]:
    """Our own unfinished recordings in `folder` that nobody writes any more and nobody recovered yet."""
    parts = [part for part in sorted(folder.glob("*.mcap.part")) if not os.path.lexists(recovered_path(part))]
    return [part for part in parts if _is_leftover(part)]


def _is_leftover(part: Path) -> bool:
    """Whether a file is ours and nobody writes it; False where either cannot be told."""
    try:
        return is_own(part) and not is_being_written(part)
    except (OSError, RecordingError):
        return False


class RecoveryCopy:
    """Copies what `reader` still finds into `writer`, and keeps account."""

    def __init__(self, reader: Reader, writer: Writer) -> None:
        self._reader, self._writer = reader, writer
        self.next_tick = reader.first_tick
        self.gaps: list[tuple[int, int]] = []
        self._end_ns = 0.0
        self._original_final: Message | None = None

    def copy(self, progress: ReportTicks | None = None) -> None:
        """All chunks, in order."""
        messages: list[Message]
        for rows, messages in self._reader.chunks():
            if rows is not None:
                self._account_ticks(rows)
                self._writer.write_ticks(rows)
            else:
                copied = [message for message in messages if self._is_content(message)]
                self._account_skipped(copied)
                self._writer.write_messages(copied)
            if progress:
                progress(self._writer.ticks)

    def final_message(self, ticks_logged: int) -> Message:
        """The event that ends the recovered file: the original one if nothing is missing, else what is."""
        if self._original_final and not self._reader.problems and not self.gaps:
            return self._original_final
        details = {
            "ticks_executed": self.next_tick,
            "ticks_logged": ticks_logged,
            "ticks_lost": sum(count for _, count in self.gaps),
            **({"ticks_skipped": self._writer.ticks_skipped} if self._reader.header.get("around") else {}),
            "events_lost": 0,
            "result": RECOVERED,
            "complete": False,
            "gaps": self.gaps,
            "problems": self._reader.problems,
        }
        event = recorder_event(RECOVERED, self.next_tick, round(self._end_ns), details)
        return Message(format.EVENTS, self._writer.start_unix_ns + round(self._end_ns), json.dumps(event).encode())

    def _is_content(self, message: Message) -> bool:
        """Whether to copy a message: the header is written already, and the end will be."""
        if message.channel == format.EVENTS and json.loads(message.payload)["kind"] in FINAL:
            self._original_final = message
            return False
        return message.channel != format.CONFIGURATION

    def _account_skipped(self, messages: list[Message]) -> None:
        """What is left out by intention is no gap."""
        intervals = self._reader.overview_intervals(messages)
        for first, count in tick_ranges(intervals):
            if first > self.next_tick:
                self.gaps.append((self.next_tick, first - self.next_tick))
            self.next_tick = first + count
        if len(intervals):
            self._end_ns = float(intervals[-1, DEADLINE, MAXIMUM]) + 1e9 / self._reader.header["rate_hz"]

    def _account_ticks(self, rows: Rows) -> None:
        self.gaps += missing_ranges(rows[:, TICK], self.next_tick)
        self.next_tick = int(rows[-1, TICK]) + 1
        self._end_ns = float(rows[-1, DEADLINE]) + 1e9 / self._reader.header["rate_hz"]


def recover(
    path: Path | str,
    output: Path | str | None = None,
    progress: ReportTicks | None = None,
    opener: Opener = open_user_file,
) -> dict[str, Any]:
    """Write a complete file from `path`, opened by `opener`; `progress` is told the ticks so far.

    Returns {recording, output, ticks, gaps [(first tick, count)], problems, complete}. Raises RecordingError,
    OutputError where not all of it can be written; nothing of the output is left then.
    """
    path = Path(path)
    output = recovered_path(path) if output is None else Path(output)
    if is_being_written(path):
        raise RecordingError(f"{path}: is being written by a recorder right now")
    with Reader(path, tolerant=True, opener=opener) as reader:
        header = {key: value for key, value in reader.header.items() if key != "configuration_sha256"}
        with output_errors(output):
            output.with_name(output.name + UNFINISHED_SUFFIX).unlink(missing_ok=True)
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
            "gaps": recovery.gaps,
            "problems": reader.problems,
            "complete": final_event["kind"] == FINISHED and final_event["what"]["complete"],
        }


def is_being_written(path: Path) -> bool:
    """Whether a recorder holds its lock on the file. Raises RecordingError where the system does not say it."""
    try:
        fd = open_user_file(path)
    except OSError:
        return False  # the reader says it better
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError as error:
        reason = f"cannot be locked ({error.strerror}), so a recorder may be writing it"
        raise RecordingError(f"{path}: {reason}") from None
    finally:
        close_descriptor(fd)
    return False
