"""The views of one client: its subscriptions, fed with every tick, and the frames that are due."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.foundation import timing
from rtloop.panel.feed.feed import Feed
from rtloop.panel.feed.tick_history import TickHistory
from rtloop.panel.protocol.frames import pack_frame
from rtloop.panel.protocol.subscriptions import (
    SpectrumSubscription,
    ViewSubscription,
    XySubscription,
    read_message,
    validate_field,
)
from rtloop.panel.service.service import Description
from rtloop.panel.service.state import StateListener
from rtloop.panel.views.analyser import Analyser
from rtloop.panel.views.scope import Scope
from rtloop.panel.views.xy_plot import XyPlot

FRAME_S = 1 / 30
PERIODS_S = {"state": 1 / 20, "sweep": FRAME_S, "spectrum": 1 / 4, "xy": 1 / 10, "timing": 1 / 2, "events": FRAME_S}
"""Least time between two frames of a kind."""
MAX_REFUSALS = 16


class Viewer:
    """The views of one client of the panel."""

    def __init__(self, feed: Feed, state: StateListener) -> None:
        """Begin without subscriptions; ticks and events come from `feed`, the service's state from `state`."""
        self._feed, self._state = feed, state
        self._subscriptions: dict[str, ViewSubscription | SpectrumSubscription | XySubscription | None] = dict.fromkeys(
            ("view", "spectrum", "xy")
        )
        """Subscriptions that are validated again when another loop begins."""
        self._scope: Scope | None = None
        self._analyser: Analyser | None = None
        self._xy_plot: XyPlot | None = None
        self._is_held = self._shows_timing = False
        self._sent_number = 0
        self._refusals: list[bytes] = []
        self._due_s = dict.fromkeys(PERIODS_S, 0.0)
        self._frame_makers: dict[str, Callable[[], bytes | None]] = {
            "state": self._state_frame,
            "sweep": self._sweep_frame,
            "spectrum": lambda: self._analyser.frame() if self._analyser else None,
            "xy": lambda: self._xy_plot.frame(self._feed.past) if self._xy_plot and self._feed.past else None,
            "timing": lambda: self._feed.timing.frame() if self._shows_timing and self._feed.timing else None,
            "events": self._events_frame,
        }

    # The feed calls these methods under its lock.

    def begin(self, loop: Description) -> None:
        """Begin a run of a loop: make the views of all subscriptions for it.

        A scope continues, with its trigger, if the loop has the same signals and rate. The view of a subscription that
        the loop does not allow is removed until another run, and a message "refused" is queued for the client.
        """
        for name, subscription in self._subscriptions.items():
            if name == "view" and self._scope is not None and self._scope.is_compatible(loop):
                continue
            try:
                self._build(name, subscription, loop)
            except ValueError as error:
                self._build(name, None, loop)
                self._refuse(name, str(error))

    def feed(self, stretch: Stretch, commands: Sequence[int]) -> None:
        """Pass the next ticks to scope and analyser; `commands`, the ticks at which commands took effect, can trigger
        the scope.
        """
        if self._scope is not None:
            self._scope.feed(stretch, commands)
        if self._analyser is not None:
            self._analyser.feed(stretch)

    def end_run(self, past: TickHistory) -> None:
        """End the run for the scope, which makes the message of its last sweep from the ticks in `past`."""
        if self._scope is not None:
            self._scope.end_run(past)

    # The client's tasks call these methods.

    def handle_message(self, text: str) -> None:
        """Carry out a JSON message of the client, field by field.

        An invalid field keeps its old value, and a message "refused" is queued for it. A text that is not a JSON object
        has no effect except that a "refused" with the field "message" is queued.
        """
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
        """Return the binary messages that are due now, the queued refusals first; [] if there are none.

        Removes the refusals from the queue. A returned kind of message is due again after its period, PERIODS_S.
        """
        now_s = timing.monotonic_s()
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
        """Apply the validated `value` of a message's field `name`: a subscription (None ends its view), a setting or an
        action.

        Before the first loop, a subscription is only stored. An action with the value False, or without the view that
        it concerns, has no effect. Raises ValueError as `_build`.
        """
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
        """Make or update the view `name` ("view", "spectrum" or "xy") for a subscription; None removes it.

        Raises ValueError for a subscription that the loop does not allow; the old view then stays.
        """
        match subscription:
            case ViewSubscription():
                scope = Scope(subscription, loop)
                if self._scope is None or not self._scope.update(subscription, loop):
                    self._scope = scope
            case SpectrumSubscription():
                if self._analyser is None or not self._analyser.update(subscription, loop):
                    self._analyser = Analyser(subscription, loop)
            case XySubscription():
                self._xy_plot = XyPlot(subscription, loop)
            case None:
                setattr(self, {"view": "_scope", "spectrum": "_analyser", "xy": "_xy_plot"}[name], None)

    def _state_frame(self) -> bytes:
        """Return the binary message "state": the keys of `StateListener.status`, and of the feed `unix_s` (now),
        `age_s` (time since the newest tick, s; None if unknown), `lost` (ticks, in all runs), `run`, `fault` (None if
        there is none) and `references` (`Events.references`).
        """
        feed = self._feed
        feed_fields = {"age_s": feed.age_s, "lost": feed.lost_ticks, "run": feed.run, "fault": feed.fault}
        feed_fields |= {"references": feed.events.references}
        return pack_frame("state", self._state.status | {"unix_s": timing.unix_s()} | feed_fields)

    def _sweep_frame(self) -> bytes | None:
        """Return the scope's binary message "sweep"; None without a scope or a new sweep, and while the client holds
        the screen.
        """
        past = self._feed.past
        return None if self._scope is None or self._is_held or past is None else self._scope.frame(past)

    def _events_frame(self) -> bytes | None:
        """Return the binary message "events" with all rows, `events`, that are new or changed since the last such
        message.

        None without such rows.
        """
        events = self._feed.events.events_after(self._sent_number)
        if not events:
            return None
        self._sent_number = max(number for number, _ in events)
        return pack_frame("events", {"events": [event for _, event in events]})

    def _refuse(self, name: str, error: str) -> None:
        """Queue a binary message "refused", {wish: field `name`, error: the reason}; drop it beyond MAX_REFUSALS."""
        frame = pack_frame("refused", {"wish": name[:100], "error": error[:2000]})
        if len(self._refusals) < MAX_REFUSALS:  # Another thread may have taken the list away meanwhile.
            self._refusals.append(frame)
