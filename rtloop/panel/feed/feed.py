"""Reader of the loop for all clients: a thread that reads every tick and keeps the last minute."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from threading import Thread
from typing import Protocol

import numpy as np
import numpy.typing as npt

from rtloop.client.ticks.reader import MAX_TICKS, Reader
from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.engine.messages import MESSAGE, Kind
from rtloop.errors import RtloopError
from rtloop.foundation import timing
from rtloop.panel.events.events import PANEL, Events
from rtloop.panel.feed.tick_history import TickHistory, history_ticks
from rtloop.panel.feed.timing import Timing
from rtloop.panel.service.service import Description, Service
from rtloop.recording.file.topics.events import RECORDER

POLL_S = 1 / 60
IDLE_S = 0.2
"""Pause between reads without clients; the ring holds ten seconds."""
RETRY_S = 0.5
"""Pause before the next request to a service that did not answer."""
LATE_READER = "the panel did not read them within ten seconds; the host is too busy"
LATE_RECORDER = "the recorder did not read them within ten seconds; the host or its disk is too busy"
Messages = npt.NDArray[np.void]
log = logging.getLogger(__name__)


class Follower(Protocol):
    """A receiver of every tick; the feed calls it under its lock."""

    def begin(self, loop: Description) -> None:
        """Begin a run of the described loop."""
        ...

    def feed(self, stretch: Stretch, commands: Sequence[int]) -> None:
        """Take the next ticks; `commands` are the ticks at which commands took effect."""
        ...

    def end_run(self, past: TickHistory) -> None:
        """End the run; `past` holds the last ticks of this run during the call, and of another run later."""
        ...


class Feed:
    """Reads ticks in a thread and hands them to the viewers; `lock` guards viewers, `past` and `timing`."""

    def __init__(self, service: Service) -> None:
        """Prepare the thread that reads the loop of `service`; `start` starts the thread."""
        self._service = service
        self.lock = timing.lock()
        self.loop: Description | None = None
        """Description of the loop that is read; None before the first."""
        self.past: TickHistory | None = None
        self.timing: Timing | None = None
        self.events = Events(service)
        self.fault: str | None = "the panel has not read a tick of the loop yet"
        """Reason why no ticks can be read; None while they can."""
        self._reader: Reader | None = None
        self._viewers: list[Follower] = []
        self._caught_up_run = -1
        """Run whose ticks in the ring were all read; its new ticks are current."""
        self._early_messages: Messages = np.zeros(0, MESSAGE)
        """Events whose ticks were not read yet."""
        self._unrecorded = (-1, 0)
        """Run, and its ticks without a record that the events have."""
        self._newest_tick_s: float | None = None
        self._end_event = timing.event()
        self._thread: Thread | None = None

    def start(self) -> None:
        """Start the thread that reads ticks until `stop`."""
        self._thread = timing.start_thread(self._read_until_ended)

    def stop(self) -> None:
        """Stop the thread and wait for its end."""
        self._end_event.set()
        if self._thread is not None:
            self._thread.join()

    @property
    def run(self) -> int:
        """Number of the loop's run that is read; −1 before the first.

        0 for the first run that this feed saw; one more whenever the loop is started again, also by the same service.
        """
        return -1 if self._reader is None else self._reader.run

    @property
    def lost_ticks(self) -> int:
        """Number of ticks that the loop overwrote before this feed read them, in all runs."""
        return 0 if self._reader is None else self._reader.lost_ticks

    @property
    def age_s(self) -> float | None:
        """Time since the newest tick was read, s; None until the loop adds a tick after the feed's first read."""
        return None if self._newest_tick_s is None else timing.monotonic_s() - self._newest_tick_s

    def add_viewer(self, viewer: Follower) -> None:
        """Hand every tick that is read from now on to a viewer; if a loop is read already, call its `begin` at once."""
        with self.lock:
            self._viewers.append(viewer)
            if self.loop is not None:
                viewer.begin(self.loop)

    def remove_viewer(self, viewer: Follower) -> None:
        """Hand no more ticks to a viewer that `add_viewer` added. Raises ValueError for any other viewer."""
        with self.lock:
            self._viewers.remove(viewer)

    def _read_until_ended(self) -> None:
        """Read ticks until `stop`. The reason why they cannot be read is logged once and stored in `fault`.

        `fault` is None again once they can be read.
        """
        while not self._end_event.wait(self._pause_s()):
            try:
                self._read_all()
                self.fault = None
            except (RtloopError, ValueError) as error:
                if str(error) != self.fault:
                    log.info("%s", error)
                self.fault = str(error)

    def _pause_s(self) -> float:
        """Return the pause before the next read, s: longer after a fault, and without viewers."""
        if self.fault is not None:
            return RETRY_S
        return POLL_S if self._viewers else IDLE_S

    def _read_all(self) -> None:
        """Read the ticks and events that are in the ring now; hand them to `past`, `timing`, `events` and all viewers.

        The first ticks of another run end the old run for the viewers and begin the new one. Raises RtloopError, or
        ValueError if the service or its ring cannot be read.
        """
        if self._reader is None:
            block = self._service.describe().block
            self._reader = Reader(block, lambda: self._service.refresh_description().names)
        reader = self._reader
        while (stretch := reader.read()) is not None:
            if stretch.run == self._caught_up_run:
                self._newest_tick_s = timing.monotonic_s()
            messages = reader.read_messages()
            if (past := self.past) is None or stretch.run != past.run:
                loop = self._service.describe()
                with self.lock:
                    past = self._begin_run(loop)
            else:
                messages = np.concatenate([self._early_messages, messages])
            with self.lock:
                self._distribute(stretch, messages, past)
            self._report_lost_ticks(stretch, reader)
            if self.loop is not None:  # Outside the lock, because it asks the service for the operators' names.
                self.events.append(messages, self.loop, self.run)
            self._early_messages = messages[:0]
            if len(stretch) < MAX_TICKS:
                break
        self._early_messages = np.concatenate([self._early_messages, reader.read_messages()])
        self._caught_up_run = self.run

    def _report_lost_ticks(self, stretch: Stretch, reader: Reader) -> None:
        """Add the ticks that this feed or the recorder has lost since the last call to the events."""
        if self.loop is None or (recording := reader.recording_state) is None:
            return
        if stretch.lost:
            first = stretch.first - stretch.lost
            self.events.add_lost_ticks(PANEL, stretch.lost, LATE_READER, first, self.loop, stretch.run)
        run, unrecorded_ticks = self._unrecorded if self._unrecorded[0] == stretch.run else (stretch.run, 0)
        if (new_ticks := recording["ticks_lost"] - unrecorded_ticks) > 0:
            tick, cause = stretch.first + len(stretch), recording["reason"] or LATE_RECORDER
            self.events.add_lost_ticks(RECORDER, new_ticks, cause, tick, self.loop, run)
        self._unrecorded = run, unrecorded_ticks + max(new_ticks, 0)

    def _begin_run(self, loop: Description) -> TickHistory:
        """End the old run for all viewers and begin a new one; `lock` must be held. Returns the history for its ticks.

        The history is a new one if the loop has other signals or another rate.
        """
        if self.past is not None:
            for viewer in self._viewers:
                viewer.end_run(self.past)
        if self.past is None or self.loop is None or not self.loop.has_signals_of(loop):
            self.past = TickHistory(loop.names, history_ticks(len(loop.names), loop.rate_hz))
        self.loop, self.timing = loop, Timing(loop)
        for viewer in self._viewers:
            viewer.begin(loop)
        return self.past

    def _distribute(self, stretch: Stretch, messages: Messages, past: TickHistory) -> None:
        """Add ticks to `past` and timing, and hand them to all viewers; `lock` must be held.

        The viewers also get the ticks of the commands among `messages`.
        """
        commands = messages["tick"][messages["kind"] < Kind.REFUSED].tolist()
        past.append(stretch)
        if self.timing is not None:
            self.timing.feed(stretch)
        for viewer in self._viewers:
            viewer.feed(stretch, commands)
