"""One client's screen: its trigger, evaluated at every tick, and the newest sweep when the client can take it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np

from rtloop.panel.conditions import Commanded, Condition, Edge, Late, ModeChanged, Stepped, Tripped, Window
from rtloop.panel.stretch import Stretch, index_of
from rtloop.panel.trigger import Cause, Mode, Settings, Sweep, Trigger
from rtloop.panel.views.frames import pack
from rtloop.panel.views.link import Description
from rtloop.panel.views.past import Past, longest_s
from rtloop.panel.views.wishes import TriggerWish, ViewWish

AUTO_S = 0.1
"""Without a trigger for so long, a sweep is taken all the same, where that is wished."""
GROWING_S = 0.5
"""A sweep of more than that is shown while it is taken."""
ROLL = "roll"


class Scope:
    """What `wish` shows of the loop that is described. Raises ValueError for signals and times that it cannot show."""

    def __init__(self, wish: ViewWish, loop: Description) -> None:
        limit_s = longest_s(len(loop.columns), loop.rate_hz)
        if wish.seconds > limit_s:
            raise ValueError(f"view.seconds: {wish.seconds:g}; at most {limit_s:g} s are kept at {loop.rate_hz:g} Hz")
        for name in wish.signals:
            index_of(name, loop.names)
        self.wish, self._names, self._rate_hz = wish, loop.names, loop.rate_hz
        self._ticks = max(round(wish.seconds * loop.rate_hz), 1)
        self._commands: deque[int] = deque(maxlen=1 << 16)
        self._trigger: Trigger | None = None
        if wish.trigger.mode != ROLL:
            settings = Settings(
                self._ticks,
                Mode(wish.trigger.mode),
                wish.trigger.pre_percent,
                round(wish.trigger.holdoff_s * loop.rate_hz),
                max(round(AUTO_S * loop.rate_hz), 1),
            )
            index_of(condition_of(wish.trigger, self._commands).source, loop.names)
            self._trigger = Trigger(settings, lambda: condition_of(wish.trigger, self._commands))
        self.number = 0
        """Sweeps that have ended."""
        self._newest: Sweep | None = None
        self._ready: bytes | None = None
        self._shown: Any = None

    def arm(self) -> None:
        """Allow a single sweep more."""
        if self._trigger is not None:
            self._trigger.arm()

    def force(self) -> None:
        """Begin a sweep now."""
        if self._trigger is not None:
            self._trigger.force()

    def suits(self, loop: Description) -> bool:
        """Whether it can go on with that loop."""
        return (loop.names, loop.rate_hz) == (self._names, self._rate_hz)

    def redrawn(self, wish: ViewWish, loop: Description) -> bool:
        """Take over `wish` where it differs by signals and pixels alone, which the trigger does not know of."""
        if (wish.seconds, wish.trigger) != (self.wish.seconds, self.wish.trigger) or not self.suits(loop):
            return False
        self.wish, self._shown = wish, None
        return True

    def feed(self, stretch: Stretch, commands: Iterable[int]) -> list[Sweep]:
        """Look at every tick of it; `commands` are the ticks of those that took effect. The sweeps that ended."""
        if self._trigger is None:
            return []
        self._commands.extend(commands)
        sweeps = self._trigger.feed(stretch)
        if sweeps:
            self.number += len(sweeps)
            self._newest = sweeps[-1]
        return sweeps

    def end_run(self, past: Past) -> None:
        """The run is over: keep what is still to be shown of it, before the past is of another one."""
        self._commands.clear()
        if self._trigger is not None and (sweep := self._trigger.close()) is not None and sweep.end > sweep.trigger:
            self.number += 1
            self._newest = sweep
        self._ready = self.frame(past)
        self._newest = self._shown = None

    def frame(self, past: Past) -> bytes | None:
        """What has not been shown yet; None where there is nothing."""
        if self._ready is not None:
            frame, self._ready = self._ready, None
            return frame
        sweep, is_complete = self._newest, True
        if self._trigger is None and past.end > 0:
            sweep = Sweep(past.run, past.end - self._ticks, past.end, past.end, Cause.AUTO)
        elif (growing_sweep := self._growing) is not None:
            sweep, is_complete = growing_sweep, False
        shown = sweep, self.number, None if is_complete else past.end
        if sweep is None or sweep.run != past.run or shown == self._shown:
            return None
        self._shown = shown
        return self._packed(sweep, past, is_complete)

    @property
    def _growing(self) -> Sweep | None:
        """The sweep that is being taken, where that takes long."""
        return self._trigger.open if self._trigger is not None and self._ticks > GROWING_S * self._rate_hz else None

    def _packed(self, sweep: Sweep, past: Past, complete: bool) -> bytes:
        signals = self.wish.signals
        points = past.points(signals, sweep.first, sweep.end, self.wish.pixels)
        arrays: dict[str, Any] = {"offset": points.tick - np.int64(sweep.trigger)}
        for name, low, high in zip(signals, points.low, points.high, strict=True):
            arrays |= {f"{name}:low": low, f"{name}:high": high}
        return pack(
            "sweep",
            {
                **sweep._asdict(),
                "cause": ROLL if self._trigger is None else sweep.cause,
                "mode": self.wish.trigger.mode,
                "number": self.number,
                "complete": complete,
                "rate_hz": self._rate_hz,
                "signals": signals,
            },
            arrays,
        )


def condition_of(wish: TriggerWish, commands: deque[int]) -> Condition:
    """What the trigger looks for. Raises ValueError."""
    source = wish.source
    match wish.kind:
        case "trip":
            return Tripped()
        case "mode":
            return ModeChanged()
        case "late":
            return Late()
        case "command":
            return Commanded(commands)
    if source is None:
        raise ValueError(f"view.trigger.source: missing; a trigger of kind {wish.kind!r} needs a signal")
    match wish.kind:
        case "edge":
            return Edge(source, wish.level, wish.slope, wish.hysteresis)
        case "window":
            return Window(source, wish.low, wish.high)
        case _:
            return Stepped(source, wish.threshold)
