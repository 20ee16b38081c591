"""Scope screen of one client: its trigger, evaluated at every tick, and the newest sweep as a frame."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from rtloop.client.capture.conditions import (
    CommandCondition,
    Condition,
    Edge,
    Late,
    ModeChanged,
    Stepped,
    Tripped,
    Window,
)
from rtloop.client.capture.trigger import Cause, Mode, Settings, Sweep, Trigger
from rtloop.client.ticks.tick_stretch import Stretch, column_index
from rtloop.panel.feed.tick_history import TickHistory, longest_view_s
from rtloop.panel.protocol.frames import pack_envelopes, pack_frame
from rtloop.panel.protocol.subscriptions import TriggerOptions, ViewSubscription
from rtloop.panel.service.service import Description

AUTO_S = 0.1
"""Time without a trigger after which mode auto begins a sweep."""
GROWING_S = 0.5
"""Duration of a sweep above which it is shown while it grows."""
ROLL = "roll"


class Scope:
    """Scope screen of a subscription: finds its sweeps and makes their messages.

    The constructor raises ValueError for signals, durations and triggers that the loop does not allow.
    """

    def __init__(self, subscription: ViewSubscription, loop: Description) -> None:
        """Make the screen and, except in mode roll, its trigger. Raises ValueError as the class says."""
        limit_s = longest_view_s(len(loop.columns), loop.rate_hz)
        if subscription.seconds > limit_s:
            raise ValueError(
                f"view.seconds: {subscription.seconds:g} s; allowed at {loop.rate_hz:g} Hz: at most {limit_s:g} s"
            )
        for name in subscription.signals:
            column_index(name, loop.names)
        self.subscription, self._loop = subscription, loop
        self._ticks = max(round(subscription.seconds * loop.rate_hz), 1)
        self._commands: deque[int] = deque(maxlen=1 << 16)
        self._trigger: Trigger | None = None
        if (options := subscription.trigger).mode != ROLL:
            settings = Settings(
                self._ticks,
                Mode(options.mode),
                options.pre_percent,
                round(options.holdoff_s * loop.rate_hz),
                max(round(AUTO_S * loop.rate_hz), 1),
            )
            column_index(make_condition(options, self._commands).source, loop.names)
            self._trigger = Trigger(settings, lambda: make_condition(options, self._commands))
        self.sweep_count = 0
        """Number of sweeps that have ended."""
        self._newest_sweep: Sweep | None = None
        self._ready_frame: bytes | None = None
        self._shown: object = None

    def arm(self) -> None:
        """Allow one more sweep in mode single; no effect in the other modes."""
        if self._trigger is not None:
            self._trigger.arm()

    def force(self) -> None:
        """Begin a sweep at the next tick, or at the end of the open sweep, armed or not; no effect in mode roll."""
        if self._trigger is not None:
            self._trigger.force()

    def is_compatible(self, loop: Description) -> bool:
        """Return whether the screen can show `loop`: it has the signals and the rate of the screen's loop."""
        return self._loop.has_signals_of(loop)

    def update(self, subscription: ViewSubscription, loop: Description) -> bool:
        """Take a subscription that differs in signals and pixels alone, without effect on the trigger, and return True.

        `frame` then makes the newest message anew. The signals must be the loop's, which is not checked. Returns False,
        unchanged, for any other subscription and for a loop with other signals or another rate.
        """
        current = self.subscription
        if (subscription.seconds, subscription.trigger) != (current.seconds, current.trigger):
            return False
        if not self.is_compatible(loop):
            return False
        self.subscription, self._shown = subscription, None
        return True

    def feed(self, stretch: Stretch, commands: Iterable[int]) -> list[Sweep]:
        """Process the next ticks, and the ticks `commands` at which commands took effect.

        Returns the sweeps that ended, oldest first; always [] in mode roll. `frame` shows the newest one.
        """
        if self._trigger is None:
            return []
        self._commands.extend(commands)
        sweeps = self._trigger.feed(stretch)
        if sweeps:
            self.sweep_count += len(sweeps)
            self._newest_sweep = sweeps[-1]
        return sweeps

    def end_run(self, past: TickHistory) -> None:
        """End the run: close the open sweep, and make the newest sweep's message now, before `past` holds another run.

        The next call of `frame` returns this message, unless an earlier call returned it already.
        """
        self._commands.clear()
        if self._trigger is not None and (sweep := self._trigger.close()) is not None and sweep.end > sweep.trigger:
            self.sweep_count += 1
            self._newest_sweep = sweep
        self._ready_frame = self.frame(past)
        self._newest_sweep = self._shown = None

    def frame(self, past: TickHistory) -> bytes | None:
        """Return the binary message "sweep" of the newest sweep, or of an open one that lasts longer than GROWING_S.

        The ticks are taken from `past`; in mode roll they are its last ones. The message that `end_run` made comes
        first. None without a sweep of the run in `past`, and if nothing has changed since the message before.
        """
        if self._ready_frame is not None:
            frame, self._ready_frame = self._ready_frame, None
            return frame
        trigger, sweep, is_complete = self._trigger, self._newest_sweep, True
        if trigger is None:
            sweep = Sweep(past.run, past.end - self._ticks, past.end, past.end, Cause.AUTO) if past.end > 0 else None
        elif trigger.open_sweep is not None and self._ticks > GROWING_S * self._loop.rate_hz:
            sweep, is_complete = trigger.open_sweep, False
        version = sweep, self.sweep_count, None if is_complete else past.end
        if sweep is None or sweep.run != past.run or version == self._shown:
            return None
        self._shown = version
        return self._pack_sweep(sweep, past, is_complete)

    def _pack_sweep(self, sweep: Sweep, past: TickHistory, is_complete: bool) -> bytes:
        """Return the binary message "sweep": arrays NAME:low and NAME:high, the extremes of each signal at each point
        of the screen, and `offset`, each point's first tick, counted from the trigger, negative before the trigger.

        The header has the fields of `sweep` (`cause` is "roll" in mode roll), `mode`, `number` (of sweeps that ended),
        `complete`, `rate_hz` and `signals`. `is_complete` is False for a sweep that still grows.
        """
        signals = self.subscription.signals
        points = past.points(signals, sweep.first, sweep.end, self.subscription.pixels)
        return pack_frame(
            "sweep",
            {
                **sweep._asdict(),
                "cause": ROLL if self._trigger is None else sweep.cause,
                "mode": self.subscription.trigger.mode,
                "number": self.sweep_count,
                "complete": is_complete,
                "rate_hz": self._loop.rate_hz,
                "signals": signals,
            },
            {"offset": points.tick - np.int64(sweep.trigger), **pack_envelopes(signals, points.low, points.high)},
        )


def make_condition(options: TriggerOptions, commands: deque[int]) -> Condition:
    """Return the condition of trigger options; one on commands takes its ticks from the queue `commands`.

    Raises ValueError for a missing source or an invalid value.
    """
    match options.kind:
        case "trip":
            return Tripped()
        case "mode":
            return ModeChanged()
        case "late":
            return Late()
        case "command":
            return CommandCondition(commands)
    source = options.source
    if source is None:
        raise ValueError(f"view.trigger.source: missing; a trigger of kind {options.kind!r} needs a signal")
    match options.kind:
        case "edge":
            return Edge(source, options.level, options.slope, options.hysteresis)
        case "window":
            return Window(source, options.low, options.high)
        case _:
            return Stepped(source, options.threshold)
