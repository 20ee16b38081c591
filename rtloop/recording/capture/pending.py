"""Messages that wait to be written before the next ticks, with the log times of their ticks."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from rtloop.recording.capture.buffer import TickBuffer, TickTime
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message, event_message
from rtloop.recording.file.topics.events import RECORDER, Event, recorder_event

MAX_PENDING_EVENTS = 4096
"""Maximum number of events stored while no file can be written."""


class PendingEntry(NamedTuple):
    """A waiting message and its tick; `from_loop` marks an event that the loop published."""

    tick: int
    message: Message
    from_loop: bool


class PendingMessages:
    """Queue of waiting messages. Log time = `start_unix_ns()` + deadline of the message's tick by `buffer`.

    `dropped` counts the loop's events that no file will contain.
    """

    def __init__(self, buffer: TickBuffer, start_unix_ns: Callable[[], int]) -> None:
        """Make an empty queue; `buffer` gives deadlines, and `start_unix_ns()` the start of the run in UNIX ns."""
        self._buffer, self._start_unix_ns = buffer, start_unix_ns
        self._entries: list[PendingEntry] = []
        self.dropped = 0

    def count_pending(self, channel: int) -> int:
        """Count the waiting messages with channel id `channel`, without events that the recorder itself made."""
        return count_pending(self._entries, channel)

    def add_event(self, event: Event) -> None:
        """Append an event to the queue."""
        self._entries.append(self.make_entry(event))

    def make_entry(self, event: Event) -> PendingEntry:
        """Return an event as an entry of the queue, without appending it.

        `from_loop` of the entry is False if the recorder itself made the event.
        """
        return PendingEntry(
            event["tick"], event_message(event, self._start_unix_ns()), from_loop=event["who"] != RECORDER
        )

    def add_snapshot(self, data: bytes) -> None:
        """Append one message for a snapshot of the law: SHA-256 of `data`, then `data`, which begins with its tick."""
        tick = snapshot_tick(data)
        message = Message(format.LAW, self.log_time(tick), hashlib.sha256(data).digest() + data)
        self._entries.append(PendingEntry(tick, message, from_loop=False))

    def recorder_message(self, kind: str, place: TickTime, details: Mapping[str, object]) -> Message:
        """Return an event `kind` of the recorder, at tick and time of `place`, as a message, without appending it.

        `details` becomes the field `what` of the event.
        """
        return event_message(recorder_event(kind, *place, details), self._start_unix_ns())

    def log_time(self, tick: int) -> int:
        """Deadline of `tick`, in ns since the UNIX epoch."""
        return self._start_unix_ns() + self._buffer.tick_time(tick).time_ns

    def take_entries(self, before: float = float("inf")) -> list[PendingEntry]:
        """Remove and return the entries of ticks before `before`, in the order of their arrival."""
        entries = [entry for entry in self._entries if entry.tick < before]
        self._entries = [entry for entry in self._entries if entry.tick >= before]
        return entries

    def requeue_events(self, entries: list[PendingEntry]) -> None:
        """Put back the events among the unwritten `entries`; discard their snapshots and all waiting snapshots.

        The oldest MAX_PENDING_EVENTS events stay; events of the loop beyond them count as dropped.
        """
        events = [entry for entry in entries + self._entries if entry.message.channel == format.EVENTS]
        events.sort(key=lambda entry: entry.message.log_time)
        self._entries = events[:MAX_PENDING_EVENTS]
        self.count_dropped(events[MAX_PENDING_EVENTS:])

    def count_dropped(self, entries: list[PendingEntry]) -> None:
        """Add the loop's events among `entries`, which will never be written, to `dropped`."""
        self.dropped += sum(entry.from_loop for entry in entries)


def count_pending(entries: Iterable[PendingEntry], channel: int) -> int:
    """Count the messages with channel id `channel` among `entries`, without events that the recorder itself made."""
    return sum(entry.message.channel == channel and (entry.from_loop or channel != format.EVENTS) for entry in entries)


def snapshot_tick(snapshot: bytes) -> int:
    """Tick at which the law's snapshot was taken: its first eight bytes, little-endian and unsigned."""
    return int.from_bytes(snapshot[:8], "little")
