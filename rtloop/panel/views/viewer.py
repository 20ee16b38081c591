"""What one client sees: its wishes, fed with every tick, and the frames that are due when it can take them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from rtloop.panel.stretch import Stretch
from rtloop.panel.views.feed import Feed
from rtloop.panel.views.frames import pack_frame
from rtloop.panel.views.scope import Scope
from rtloop.panel.views.service import Description
from rtloop.panel.views.spectra import Analyser
from rtloop.panel.views.state import StateListener
from rtloop.panel.views.subscriptions import (
    SpectrumSubscription,
    ViewSubscription,
    XySubscription,
    read_message,
    validate_field,
)
from rtloop.panel.views.tick_history import TickHistory
from rtloop.panel.views.xy import XyPlot

FRAME_S = 1 / 30
PERIODS_S = {"state": 1 / 20, "sweep": FRAME_S, "spectrum": 1 / 4, "xy": 1 / 10, "timing": 1 / 2, "events": FRAME_S}
"""At least, between two frames of a kind."""
MAX_REFUSALS = 16


class Viewer:
    """One client."""

    def __init__(self, feed: Feed, state: StateListener) -> None:
        self._feed, self._state = feed, state
        self._subscriptions: dict[str, Any] = dict.fromkeys(("view", "spectrum", "xy"))
        """Those that are judged anew where another loop begins."""
        self._scope: Scope | None = None
        self._analyser: Analyser | None = None
        self._drawn: XyPlot | None = None
        self._is_held = self._shows_timing = False
        self._sent_number = 0
        self._refusals: list[bytes] = []
        self._due_s = dict.fromkeys(PERIODS_S, 0.0)
        self._frame_makers: dict[str, Callable[[], bytes | None]] = {
            "state": self._state_frame,
            "sweep": self._sweep_frame,
            "spectrum": lambda: None if self._analyser is None else self._analyser.frame(),
            "xy": self._xy_frame,
            "timing": lambda: self._feed.timing.frame() if self._shows_timing and self._feed.timing else None,
            "events": self._events_frame,
        }

    # what the feed calls, under its lock

    def begin(self, loop: Description) -> None:
        """A run of a loop begins: what was wished is judged for it."""
        for name, subscription in self._subscriptions.items():
            if name == "view" and self._scope is not None and self._scope.is_compatible(loop):
                continue  # its trigger goes on
            try:
                self._build(name, subscription, loop)
            except ValueError as error:
                self._build(name, None, loop)
                self._refuse(name, str(error))

    def feed(self, stretch: Stretch, commands: Sequence[int]) -> None:
        """Ticks came; `commands` are those at which one took effect."""
        if self._scope is not None:
            self._scope.feed(stretch, commands)
        if self._analyser is not None:
            self._analyser.feed(stretch)

    def end_run(self, past: TickHistory) -> None:
        """The run is over."""
        if self._scope is not None:
            self._scope.end_run(past)

    # what the client's task calls

    def handle_message(self, text: str) -> None:
        """Take over what a message wishes; what cannot be granted is refused by a frame, and the old one goes on."""
        try:
            fields = read_message(text)
        except ValueError as error:
            self._refuse("message", str(error))
            return
        for name, value in fields.items():
            try:
                subscription = validate_field(name, value)
                with self._feed.lock:
                    self._apply(name, subscription)
            except ValueError as error:
                self._refuse(name, str(error))

    def due_frames(self) -> list[bytes]:
        """The frames that are to be sent now."""
        now_s = time.monotonic()
        frames, self._refusals = self._refusals, []
        for kind, make_frame in self._frame_makers.items():
            if now_s < self._due_s[kind]:
                continue
            with self._feed.lock:
                frame = make_frame()
            if frame is not None:
                frames.append(frame)
                self._due_s[kind] = max(self._due_s[kind] + PERIODS_S[kind], now_s - FRAME_S)
        return frames

    def _apply(self, name: str, value: Any) -> None:
        """Raises ValueError for what the loop does not have."""
        match name:
            case "view" | "spectrum" | "xy":
                if self._feed.loop is not None:
                    self._build(name, value, self._feed.loop)
                self._subscriptions[name] = value
            case "hold":
                self._is_held = value
            case "timing":
                self._shows_timing = value
            case "arm" if self._scope is not None and value:
                self._scope.arm()
            case "force" if self._scope is not None and value:
                self._scope.force()
            case "reset_spectrum" if self._analyser is not None and value:
                self._analyser.reset()

    def _build(
        self,
        name: str,
        subscription: ViewSubscription | SpectrumSubscription | XySubscription | None,
        loop: Description,
    ) -> None:
        """What shows `wish`, or nothing; raises ValueError, and the old one goes on."""
        match subscription:
            case ViewSubscription():
                scope = Scope(subscription, loop)
                if self._scope is None or not self._scope.update(subscription, loop):
                    self._scope = scope
            case SpectrumSubscription():
                if self._analyser is None or not self._analyser.update(subscription, loop):
                    self._analyser = Analyser(subscription, loop)
            case XySubscription():
                self._drawn = XyPlot(subscription, loop)
            case None:
                setattr(self, {"view": "_scope", "spectrum": "_analyser", "xy": "_drawn"}[name], None)

    def _state_frame(self) -> bytes:
        feed = self._feed
        feed_fields = {
            "unix_s": time.time(),
            "age_s": feed.age_s,
            "lost": feed.lost_ticks,
            "run": feed.run,
            "fault": feed.fault,
        }
        return pack_frame("state", self._state.status | feed_fields)

    def _sweep_frame(self) -> bytes | None:
        past = self._feed.past
        if self._scope is None or self._is_held or past is None:
            return None
        return self._scope.frame(past)

    def _xy_frame(self) -> bytes | None:
        past = self._feed.past
        return None if self._drawn is None or past is None else self._drawn.frame(past)

    def _events_frame(self) -> bytes | None:
        events = self._feed.events.events_after(self._sent_number)
        if not events:
            return None
        self._sent_number = max(number for number, _ in events)
        return pack_frame("events", {"events": [event for _, event in events]})

    def _refuse(self, name: str, error: str) -> None:
        frame = pack_frame("refused", {"wish": name[:100], "error": error[:2000]})
        if len(self._refusals) < MAX_REFUSALS:  # the list as it is now: it is taken away by another thread
            self._refusals.append(frame)
