"""Messages that wait to be written in front of the next ticks, stamped with the times of their ticks."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from rtloop.recording.capture.buffer import Place, TickBuffer
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import RECORDER, Event, recorder_event

KEPT_EVENTS = 4096
"""From a time in which nothing can be written, for the file that follows."""


class Entry(NamedTuple):
    """`of_loop`: whether it is an event that the loop published."""

    tick: int
    message: Message
    of_loop: bool


class Pending:
    """`start_unix_ns` says when the run began; the times since then are those of the ticks in `buffer`."""

    def __init__(self, buffer: TickBuffer, start_unix_ns: Callable[[], int]) -> None:
        self._buffer, self._start_unix_ns = buffer, start_unix_ns
        self._entries: list[Entry] = []
        self.dropped = 0

    def waiting(self, channel: int) -> int:
        """Messages of a topic that were taken from the rings and wait; of events those of the loop."""
        return waiting(self._entries, channel)

    def add_event(self, event: Event) -> None:
        """An event behind all others."""
        self._entries.append(self.entry(event))

    def entry(self, event: Event) -> Entry:
        """An event that is to wait elsewhere."""
        message = Message(format.EVENTS, self._start_unix_ns() + event["time_ns"], json.dumps(event).encode())
        return Entry(event["tick"], message, of_loop=event["who"] != RECORDER)

    def add_snapshot(self, data: bytes) -> None:
        """A snapshot of the law, with its digest."""
        tick = tick_of(data)
        message = Message(format.LAW, self.log_time(tick), hashlib.sha256(data).digest() + data)
        self._entries.append(Entry(tick, message, of_loop=False))

    def own(self, kind: str, place: Place, what: dict[str, Any]) -> Message:
        """An event of the recorder's, which does not wait."""
        event = recorder_event(kind, *place, what)
        return Message(format.EVENTS, self._start_unix_ns() + place.time_ns, json.dumps(event).encode())

    def log_time(self, tick: int) -> int:
        """When `tick` was due, in UNIX ns."""
        return self._start_unix_ns() + self._buffer.time_ns(tick)

    def take(self, before: float = float("inf")) -> list[Entry]:
        """Those that belong to ticks before `before`, and wait no longer."""
        entries = [entry for entry in self._entries if entry.tick < before]
        self._entries = [entry for entry in self._entries if entry.tick >= before]
        return entries

    def keep_events(self, entries: list[Entry]) -> None:
        """Put back what could not be written: events only, and of these the first KEPT_EVENTS."""
        events = [entry for entry in entries + self._entries if entry.message.channel == format.EVENTS]
        events.sort(key=lambda entry: entry.message.log_time)
        self._entries = events[:KEPT_EVENTS]
        self.drop(events[KEPT_EVENTS:])

    def drop(self, entries: list[Entry]) -> None:
        """Count events of the loop that will never be written."""
        self.dropped += sum(entry.of_loop for entry in entries)


def waiting(entries: Iterable[Entry], channel: int) -> int:
    """Messages of a topic among entries; of events those of the loop."""
    return sum(entry.message.channel == channel and (entry.of_loop or channel != format.EVENTS) for entry in entries)


def tick_of(snapshot: bytes) -> int:
    """The tick that a snapshot was taken at."""
    return int.from_bytes(snapshot[:8], "little")
