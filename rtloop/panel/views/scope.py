"""One client's screen: its trigger, evaluated at every tick, and the newest sweep when the client can take it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np

from rtloop.panel.conditions import CommandCondition, Condition, Edge, Late, ModeChanged, Stepped, Tripped, Window
from rtloop.panel.stretch import Stretch, column_index
from rtloop.panel.trigger import Cause, Mode, Settings, Sweep, Trigger
from rtloop.panel.views.frames import pack_frame
from rtloop.panel.views.service import Description
from rtloop.panel.views.subscriptions import TriggerOptions, ViewSubscription
from rtloop.panel.views.tick_history import TickHistory, longest_view_s

AUTO_S = 0.1
"""Without a trigger for so long, a sweep is taken all the same, where that is wished."""
GROWING_S = 0.5
"""A sweep of more than that is shown while it is taken."""
ROLL = "roll"


class Scope:
    """What `wish` shows of the loop that is described. Raises ValueError for signals and times that it cannot show."""

    def __init__(self, subscription: ViewSubscription, loop: Description) -> None:
        limit_s = longest_view_s(len(loop.columns), loop.rate_hz)
        if subscription.seconds > limit_s:
            raise ValueError(
                f"view.seconds: {subscription.seconds:g}; at most {limit_s:g} s are kept at {loop.rate_hz:g} Hz"
            )
        for name in subscription.signals:
            column_index(name, loop.names)
        self.subscription, self._names, self._rate_hz = subscription, loop.names, loop.rate_hz
        self._ticks = max(round(subscription.seconds * loop.rate_hz), 1)
        self._commands: deque[int] = deque(maxlen=1 << 16)
        self._trigger: Trigger | None = None
        if subscription.trigger.mode != ROLL:
            settings = Settings(
                self._ticks,
                Mode(subscription.trigger.mode),
                subscription.trigger.pre_percent,
                round(subscription.trigger.holdoff_s * loop.rate_hz),
                max(round(AUTO_S * loop.rate_hz), 1),
            )
            column_index(make_condition(subscription.trigger, self._commands).source, loop.names)
            self._trigger = Trigger(settings, lambda: make_condition(subscription.trigger, self._commands))
        self.sweep_count = 0
        """Sweeps that have ended."""
        self._newest_sweep: Sweep | None = None
        self._ready_frame: bytes | None = None
        self._shown: Any = None

    def arm(self) -> None:
        """Allow a single sweep more."""
        if self._trigger is not None:
            self._trigger.arm()

    def force(self) -> None:
        """Begin a sweep now."""
        if self._trigger is not None:
            self._trigger.force()

    def is_compatible(self, loop: Description) -> bool:
        """Whether it can go on with that loop."""
        return (loop.names, loop.rate_hz) == (self._names, self._rate_hz)

    def update(self, subscription: ViewSubscription, loop: Description) -> bool:
        """Take over `wish` where it differs by signals and pixels alone, which the trigger does not know of."""
        if (subscription.seconds, subscription.trigger) != (
            self.subscription.seconds,
            self.subscription.trigger,
        ) or not self.is_compatible(loop):
            return False
        self.subscription, self._shown = subscription, None
        return True

    def feed(self, stretch: Stretch, commands: Iterable[int]) -> list[Sweep]:
        """Look at every tick of it; `commands` are the ticks of those that took effect. The sweeps that ended."""
        if self._trigger is None:
            return []
        self._commands.extend(commands)
        sweeps = self._trigger.feed(stretch)
        if sweeps:
            self.sweep_count += len(sweeps)
            self._newest_sweep = sweeps[-1]
        return sweeps

    def end_run(self, past: TickHistory) -> None:
        """The run is over: keep what is still to be shown of it, before the past is of another one."""
        self._commands.clear()
        if self._trigger is not None and (sweep := self._trigger.close()) is not None and sweep.end > sweep.trigger:
            self.sweep_count += 1
            self._newest_sweep = sweep
        self._ready_frame = self.frame(past)
        self._newest_sweep = self._shown = None

    def frame(self, past: TickHistory) -> bytes | None:
        """What has not been shown yet; None where there is nothing."""
        if self._ready_frame is not None:
            frame, self._ready_frame = self._ready_frame, None
            return frame
        sweep, is_complete = self._newest_sweep, True
        if self._trigger is None and past.end > 0:
            sweep = Sweep(past.run, past.end - self._ticks, past.end, past.end, Cause.AUTO)
        elif (growing_sweep := self._growing_sweep) is not None:
            sweep, is_complete = growing_sweep, False
        shown = sweep, self.sweep_count, None if is_complete else past.end
        if sweep is None or sweep.run != past.run or shown == self._shown:
            return None
        self._shown = shown
        return self._pack_sweep(sweep, past, is_complete)

    @property
    def _growing_sweep(self) -> Sweep | None:
        """The sweep that is being taken, where that takes long."""
        return (
            self._trigger.open_sweep if self._trigger is not None and self._ticks > GROWING_S * self._rate_hz else None
        )

    def _pack_sweep(self, sweep: Sweep, past: TickHistory, is_complete: bool) -> bytes:
        signals = self.subscription.signals
        points = past.points(signals, sweep.first, sweep.end, self.subscription.pixels)
        arrays: dict[str, Any] = {"offset": points.tick - np.int64(sweep.trigger)}
        for name, low, high in zip(signals, points.low, points.high, strict=True):
            arrays |= {f"{name}:low": low, f"{name}:high": high}
        return pack_frame(
            "sweep",
            {
                **sweep._asdict(),
                "cause": ROLL if self._trigger is None else sweep.cause,
                "mode": self.subscription.trigger.mode,
                "number": self.sweep_count,
                "complete": is_complete,
                "rate_hz": self._rate_hz,
                "signals": signals,
            },
            arrays,
        )


def make_condition(options: TriggerOptions, commands: deque[int]) -> Condition:
    """What the trigger looks for. Raises ValueError."""
    source = options.source
    match options.kind:
        case "trip":
            return Tripped()
        case "mode":
            return ModeChanged()
        case "late":
            return Late()
        case "command":
            return CommandCondition(commands)
    if source is None:
        raise ValueError(f"view.trigger.source: missing; a trigger of kind {options.kind!r} needs a signal")
    match options.kind:
        case "edge":
            return Edge(source, options.level, options.slope, options.hysteresis)
        case "window":
            return Window(source, options.low, options.high)
        case _:
            return Stepped(source, options.threshold)
