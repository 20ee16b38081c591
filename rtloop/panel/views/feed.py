"""The one reader of the loop for all clients: a thread that looks at every tick and keeps the last minute of them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from rtloop.engine.messages import MESSAGE, Kind
from rtloop.errors import RtloopError
from rtloop.panel.reader import MAX_TICKS, Reader
from rtloop.panel.stretch import Stretch
from rtloop.panel.views.events import Events
from rtloop.panel.views.service import Description, Service
from rtloop.panel.views.tick_history import TickHistory, history_ticks
from rtloop.panel.views.timing import Timing

POLL_S = 1 / 60
IDLE_S = 0.2
"""Between reads while nobody looks; the ring holds ten seconds."""
RETRY_S = 0.5
"""Before a service that did not answer is asked again."""
Messages = npt.NDArray[Any]
log = logging.getLogger(__name__)


class Follower(Protocol):
    """Who is handed every tick, under the feed's lock."""

    def begin(self, loop: Description) -> None:
        """A run of a loop begins."""
        ...

    def feed(self, stretch: Stretch, commands: Sequence[int]) -> None:
        """Ticks came; `commands` are those at which one took effect."""
        ...

    def end_run(self, past: TickHistory) -> None:
        """The run is over."""
        ...


class Feed:
    """Reads in a thread of its own from `start` on, and hands every tick to the viewers. `lock` guards them and it."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self.lock = threading.Lock()
        self.loop: Description | None = None
        """That is read; None before there was one."""
        self.past: TickHistory | None = None
        self.timing: Timing | None = None
        self.events = Events(service)
        self.fault: str | None = "nothing is read yet"
        """Why nothing can be read; None while it can."""
        self._reader: Reader | None = None
        self._viewers: list[Follower] = []
        self._caught_up_run = -1
        """The run of which nothing was left to read."""
        self._early_messages: Messages = np.zeros(0, MESSAGE)
        """Events whose ticks have not been read yet."""
        self._newest_tick_s: float | None = None
        self._end_event = threading.Event()
        self._thread = threading.Thread(target=self._read_until_ended, name="feed", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def stop(self) -> None:
        """Read no longer."""
        self._end_event.set()
        self._thread.join()

    @property
    def run(self) -> int:
        """Number of the run that is read; −1 before there is one."""
        return -1 if self._reader is None else self._reader.run

    @property
    def lost_ticks(self) -> int:
        """Ticks that were overwritten before they could be read."""
        return 0 if self._reader is None else self._reader.lost_ticks

    @property
    def age_s(self) -> float | None:
        """Since the newest tick came; None before one did."""
        return None if self._newest_tick_s is None else time.monotonic() - self._newest_tick_s

    def add_viewer(self, viewer: Follower) -> None:
        """Hand it every tick from now on."""
        with self.lock:
            self._viewers.append(viewer)
            if self.loop is not None:
                viewer.begin(self.loop)

    def remove_viewer(self, viewer: Follower) -> None:
        """It has gone."""
        with self.lock:
            self._viewers.remove(viewer)

    def _read_until_ended(self) -> None:
        while not self._end_event.wait(self._pause_s()):
            try:
                self._read_all()
                self.fault = None
            except (RtloopError, ValueError) as error:
                if str(error) != self.fault:
                    log.info("%s", error)
                self.fault = str(error)

    def _pause_s(self) -> float:
        if self.fault is not None:
            return RETRY_S
        return POLL_S if self._viewers else IDLE_S

    def _read_all(self) -> None:
        """The ticks that are there, without waiting for those that come meanwhile. Raises RtloopError, ValueError."""
        if self._reader is None:
            block = self._service.describe().block
            self._reader = Reader(block, lambda: self._service.refresh_description().names)
        reader = self._reader
        while (stretch := reader.read()) is not None:
            if stretch.run == self._caught_up_run:
                self._newest_tick_s = time.monotonic()
            messages = reader.read_messages()
            if self.past is None or stretch.run != self.past.run:
                loop = self._service.describe()
                with self.lock:
                    self._begin_run(loop)
            else:
                messages = np.concatenate([self._early_messages, messages])
            with self.lock:
                self._distribute(stretch, messages)
            self._record_events(messages)
            self._early_messages = messages[:0]
            if len(stretch) < MAX_TICKS:
                break
        self._early_messages = np.concatenate([self._early_messages, reader.read_messages()])
        self._caught_up_run = self.run

    def _record_events(self, messages: Messages) -> None:
        """Who asked is asked of the service before the lock is taken."""
        if self.loop is not None:
            self.events.append(messages, self.loop, self.run)

    def _begin_run(self, loop: Description) -> None:
        """Another run."""
        previous_loop = self.loop
        if self.past is not None:
            for viewer in self._viewers:
                viewer.end_run(self.past)
        if (
            self.past is None
            or previous_loop is None
            or (previous_loop.names, previous_loop.rate_hz) != (loop.names, loop.rate_hz)
        ):
            self.past = TickHistory(loop.names, history_ticks(len(loop.names), loop.rate_hz))
        self.loop, self.timing = loop, Timing(loop)
        for viewer in self._viewers:
            viewer.begin(loop)

    def _distribute(self, stretch: Stretch, messages: Messages) -> None:
        assert self.past is not None
        assert self.timing is not None
        commands = messages["tick"][messages["kind"] < Kind.REFUSED].tolist()
        self.past.append(stretch)
        self.timing.feed(stretch)
        for viewer in self._viewers:
            viewer.feed(stretch, commands)
