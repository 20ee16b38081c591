"""Messages that wait to be written in front of the next ticks, stamped with the times of their ticks."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from rtloop.recording.capture.buffer import TickBuffer, TickTime
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import RECORDER, Event, recorder_event

MAX_PENDING_EVENTS = 4096
"""From a time in which nothing can be written, for the file that follows."""


class PendingEntry(NamedTuple):
    """`from_loop`: whether it is an event that the loop published."""

    tick: int
    message: Message
    from_loop: bool


class PendingMessages:
    """`start_unix_ns` says when the run began; the times since then are those of the ticks in `buffer`."""

    def __init__(self, buffer: TickBuffer, start_unix_ns: Callable[[], int]) -> None:
        self._buffer, self._start_unix_ns = buffer, start_unix_ns
        self._entries: list[PendingEntry] = []
        self.dropped = 0

    def waiting_count(self, channel: int) -> int:
        """Messages of a topic that were taken from the rings and wait; of events those of the loop."""
        return count_waiting(self._entries, channel)

    def add_event(self, event: Event) -> None:
        """An event behind all others."""
        self._entries.append(self.make_entry(event))

    def make_entry(self, event: Event) -> PendingEntry:
        """An event that is to wait elsewhere."""
        message = Message(format.EVENTS, self._start_unix_ns() + event["time_ns"], json.dumps(event).encode())
        return PendingEntry(event["tick"], message, from_loop=event["who"] != RECORDER)

    def add_snapshot(self, data: bytes) -> None:
        """A snapshot of the law, with its digest."""
        tick = snapshot_tick(data)
        message = Message(format.LAW, self.log_time(tick), hashlib.sha256(data).digest() + data)
        self._entries.append(PendingEntry(tick, message, from_loop=False))

    def recorder_message(self, kind: str, place: TickTime, details: dict[str, Any]) -> Message:
        """An event of the recorder's, which does not wait."""
        event = recorder_event(kind, *place, details)
        return Message(format.EVENTS, self._start_unix_ns() + place.time_ns, json.dumps(event).encode())

    def log_time(self, tick: int) -> int:
        """When `tick` was due, in UNIX ns."""
        return self._start_unix_ns() + self._buffer.time_ns(tick)

    def take_entries(self, before: float = float("inf")) -> list[PendingEntry]:
        """Those that belong to ticks before `before`, and wait no longer."""
        entries = [entry for entry in self._entries if entry.tick < before]
        self._entries = [entry for entry in self._entries if entry.tick >= before]
        return entries

    def requeue_events(self, entries: list[PendingEntry]) -> None:
        """Put back what could not be written: events only, and of these the first KEPT_EVENTS."""
        events = [entry for entry in entries + self._entries if entry.message.channel == format.EVENTS]
        events.sort(key=lambda entry: entry.message.log_time)
        self._entries = events[:MAX_PENDING_EVENTS]
        self.count_dropped(events[MAX_PENDING_EVENTS:])

    def count_dropped(self, entries: list[PendingEntry]) -> None:
        """Count events of the loop that will never be written."""
        self.dropped += sum(entry.from_loop for entry in entries)


def count_waiting(entries: Iterable[PendingEntry], channel: int) -> int:
    """Messages of a topic among entries; of events those of the loop."""
    return sum(entry.message.channel == channel and (entry.from_loop or channel != format.EVENTS) for entry in entries)


def snapshot_tick(snapshot: bytes) -> int:
    """The tick that a snapshot was taken at."""
    return int.from_bytes(snapshot[:8], "little")
