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
from rtloop.panel.reader import MOST_TICKS, Reader
from rtloop.panel.stretch import Stretch
from rtloop.panel.views.events import Events
from rtloop.panel.views.link import Description, Service
from rtloop.panel.views.past import Past, ticks_kept
from rtloop.panel.views.timing import Timing

POLL_S = 1 / 60
IDLE_S = 0.2
"""Between reads while nobody looks; the ring holds ten seconds."""
AGAIN_S = 0.5
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

    def end_run(self, past: Past) -> None:
        """The run is over."""
        ...


class Feed:
    """Reads in a thread of its own from `start` on, and hands every tick to the viewers. `lock` guards them and it."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self.lock = threading.Lock()
        self.loop: Description | None = None
        """That is read; None before there was one."""
        self.past: Past | None = None
        self.timing: Timing | None = None
        self.events = Events(service)
        self.fault: str | None = "nothing is read yet"
        """Why nothing can be read; None while it can."""
        self._reader: Reader | None = None
        self._viewers: list[Follower] = []
        self._caught_up = -1
        """The run of which nothing was left to read."""
        self._early: Messages = np.zeros(0, MESSAGE)
        """Events whose ticks have not been read yet."""
        self._moved_s: float | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work, name="feed", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def end(self) -> None:
        """Read no longer."""
        self._ending.set()
        self._thread.join()

    @property
    def run(self) -> int:
        """Number of the run that is read; −1 before there is one."""
        return -1 if self._reader is None else self._reader.run

    @property
    def lost(self) -> int:
        """Ticks that were overwritten before they could be read."""
        return 0 if self._reader is None else self._reader.lost

    @property
    def age_s(self) -> float | None:
        """Since the newest tick came; None before one did."""
        return None if self._moved_s is None else time.monotonic() - self._moved_s

    def join(self, viewer: Follower) -> None:
        """Hand it every tick from now on."""
        with self.lock:
            self._viewers.append(viewer)
            if self.loop is not None:
                viewer.begin(self.loop)

    def leave(self, viewer: Follower) -> None:
        """It has gone."""
        with self.lock:
            self._viewers.remove(viewer)

    def _work(self) -> None:
        while not self._ending.wait(self._pause_s()):
            try:
                self._read_all()
                self.fault = None
            except (RtloopError, ValueError) as error:
                if str(error) != self.fault:
                    log.info("%s", error)
                self.fault = str(error)

    def _pause_s(self) -> float:
        if self.fault is not None:
            return AGAIN_S
        return POLL_S if self._viewers else IDLE_S

    def _read_all(self) -> None:
        """The ticks that are there, without waiting for those that come meanwhile. Raises RtloopError, ValueError."""
        if self._reader is None:
            block = self._service.describe().block
            self._reader = Reader(block, lambda: self._service.describe_anew().names)
        reader = self._reader
        while (stretch := reader.read()) is not None:
            if stretch.run == self._caught_up:
                self._moved_s = time.monotonic()
            messages = reader.messages()
            if self.past is None or stretch.run != self.past.run:
                loop = self._service.describe()
                with self.lock:
                    self._begin(loop)
            else:
                messages = np.concatenate([self._early, messages])
            with self.lock:
                self._take(stretch, messages)
            self._tell_events(messages)
            self._early = messages[:0]
            if len(stretch) < MOST_TICKS:
                break
        self._early = np.concatenate([self._early, reader.messages()])
        self._caught_up = self.run

    def _tell_events(self, messages: Messages) -> None:
        """Who asked is asked of the service before the lock is taken."""
        if self.loop is not None:
            self.events.take(messages, self.loop, self.run)

    def _begin(self, loop: Description) -> None:
        """Another run."""
        previous_loop = self.loop
        if self.past is not None:
            for viewer in self._viewers:
                viewer.end_run(self.past)
        if self.past is None or previous_loop is None or (previous_loop.names, previous_loop.rate_hz) != (loop.names, loop.rate_hz):
            self.past = Past(loop.names, ticks_kept(len(loop.names), loop.rate_hz))
        self.loop, self.timing = loop, Timing(loop)
        for viewer in self._viewers:
            viewer.begin(loop)

    def _take(self, stretch: Stretch, messages: Messages) -> None:
        assert self.past is not None
        assert self.timing is not None
        commands = messages["tick"][messages["kind"] < Kind.REFUSED].tolist()
        self.past.take(stretch)
        self.timing.feed(stretch)
        for viewer in self._viewers:
            viewer.feed(stretch, commands)
