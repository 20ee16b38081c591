"""What one client sees: its wishes, fed with every tick, and the frames that are due when it can take them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from rtloop.panel.stretch import Stretch
from rtloop.panel.views.feed import Feed
from rtloop.panel.views.frames import pack
from rtloop.panel.views.link import Description
from rtloop.panel.views.past import Past
from rtloop.panel.views.scope import Scope
from rtloop.panel.views.spectra import Analyser
from rtloop.panel.views.state import State
from rtloop.panel.views.wishes import SpectrumWish, ViewWish, XyWish, read_wishes, wish_of
from rtloop.panel.views.xy import Drawn

FRAME_S = 1 / 30
PERIODS_S = {"state": 1 / 20, "sweep": FRAME_S, "spectrum": 1 / 4, "xy": 1 / 10, "timing": 1 / 2, "events": FRAME_S}
"""At least, between two frames of a kind."""
MOST_REFUSALS = 16


class Viewer:
    """One client."""

    def __init__(self, feed: Feed, state: State) -> None:
        self._feed, self._state = feed, state
        self._wishes: dict[str, Any] = dict.fromkeys(("view", "spectrum", "xy"))
        """Those that are judged anew where another loop begins."""
        self._scope: Scope | None = None
        self._analyser: Analyser | None = None
        self._drawn: Drawn | None = None
        self._held = self._timed = False
        self._told = 0
        self._refusals: list[bytes] = []
        self._due_s = dict.fromkeys(PERIODS_S, 0.0)
        self._makers: dict[str, Callable[[], bytes | None]] = {
            "state": self._state_frame,
            "sweep": self._sweep_frame,
            "spectrum": lambda: None if self._analyser is None else self._analyser.frame(),
            "xy": self._xy_frame,
            "timing": lambda: self._feed.timing.frame() if self._timed and self._feed.timing else None,
            "events": self._events_frame,
        }

    # what the feed calls, under its lock

    def begin(self, loop: Description) -> None:
        """A run of a loop begins: what was wished is judged for it."""
        for name, subscription in self._wishes.items():
            if name == "view" and self._scope is not None and self._scope.suits(loop):
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

    def end_run(self, past: Past) -> None:
        """The run is over."""
        if self._scope is not None:
            self._scope.end_run(past)

    # what the client's task calls

    def wish(self, text: str) -> None:
        """Take over what a message wishes; what cannot be granted is refused by a frame, and the old one goes on."""
        try:
            fields = read_wishes(text)
        except ValueError as error:
            self._refuse("message", str(error))
            return
        for name, value in fields.items():
            try:
                subscription = wish_of(name, value)
                with self._feed.lock:
                    self._grant(name, subscription)
            except ValueError as error:
                self._refuse(name, str(error))

    def due(self) -> list[bytes]:
        """The frames that are to be sent now."""
        now_s = time.monotonic()
        frames, self._refusals = self._refusals, []
        for kind, make_frame in self._makers.items():
            if now_s < self._due_s[kind]:
                continue
            with self._feed.lock:
                frame = make_frame()
            if frame is not None:
                frames.append(frame)
                self._due_s[kind] = max(self._due_s[kind] + PERIODS_S[kind], now_s - FRAME_S)
        return frames

    def _grant(self, name: str, wish: Any) -> None:
        """Raises ValueError for what the loop does not have."""
        match name:
            case "view" | "spectrum" | "xy":
                if self._feed.loop is not None:
                    self._build(name, wish, self._feed.loop)
                self._wishes[name] = wish
            case "hold":
                self._held = wish
            case "timing":
                self._timed = wish
            case "arm" if self._scope is not None and wish:
                self._scope.arm()
            case "force" if self._scope is not None and wish:
                self._scope.force()
            case "reset_spectrum" if self._analyser is not None and wish:
                self._analyser.reset()

    def _build(self, name: str, wish: ViewWish | SpectrumWish | XyWish | None, loop: Description) -> None:
        """What shows `wish`, or nothing; raises ValueError, and the old one goes on."""
        match wish:
            case ViewWish():
                scope = Scope(wish, loop)
                if self._scope is None or not self._scope.redrawn(wish, loop):
                    self._scope = scope
            case SpectrumWish():
                if self._analyser is None or not self._analyser.rewished(wish, loop):
                    self._analyser = Analyser(wish, loop)
            case XyWish():
                self._drawn = Drawn(wish, loop)
            case None:
                setattr(self, {"view": "_scope", "spectrum": "_analyser", "xy": "_drawn"}[name], None)

    def _state_frame(self) -> bytes:
        feed = self._feed
        feed_fields = {"unix_s": time.time(), "age_s": feed.age_s, "lost": feed.lost, "run": feed.run, "fault": feed.fault}
        return pack("state", self._state.now | feed_fields)

    def _sweep_frame(self) -> bytes | None:
        past = self._feed.past
        if self._scope is None or self._held or past is None:
            return None
        return self._scope.frame(past)

    def _xy_frame(self) -> bytes | None:
        past = self._feed.past
        return None if self._drawn is None or past is None else self._drawn.frame(past)

    def _events_frame(self) -> bytes | None:
        events = self._feed.events.after(self._told)
        if not events:
            return None
        self._told = max(number for number, _ in events)
        return pack("events", {"events": [event for _, event in events]})

    def _refuse(self, name: str, error: str) -> None:
        frame = pack("refused", {"wish": name[:100], "error": error[:2000]})
        if len(self._refusals) < MOST_REFUSALS:  # the list as it is now: it is taken away by another thread
            self._refusals.append(frame)
