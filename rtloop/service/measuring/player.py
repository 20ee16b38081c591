"""References played on one axis of a loop that runs, and what the loop did, as its ticks come.

What is read is the ring that the recorder reads: it is in the recording as well.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np

from rtloop import signals
from rtloop.engine.ring import drain
from rtloop.errors import RtloopError
from rtloop.foundation.arrays import Real
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Refused
from rtloop.service.measuring.client_presence import require_client
from rtloop.signals import Flag, Mode
from rtloop.supervision.supervisor import Supervisor

REST_S, POLL_S, PATIENCE_S = 0.2, 0.02, 2.0


class Player:
    """Plays on axis `number` about the constant that it holds; `doing` says what for in every refusal.

    Raises Refused where the reference is none that is held, ClientGone where nobody waits for what it would play.
    """

    def __init__(self, supervisor: Supervisor, live: LiveLaw, number: int, doing: str) -> None:
        require_client(doing)
        self._supervisor, self._live, self._number, self._doing = supervisor, live, number, doing
        self.axis = live.prepared.plan.axes[number]
        self.rate_hz = live.prepared.configuration.loop.rate_hz
        self.hold_um = live.references.held(number)
        self._set = live.references.times_set[number]

    @property
    def tick(self) -> int:
        """The next tick."""
        return self._supervisor.ticks

    @property
    def ours(self) -> bool:
        """Whether nobody else has set a reference since."""
        return self._live.references.times_set[self._number] == self._set

    def play(self, samples: Real, *, repeat: bool = False) -> int:
        """Samples (n, 1 or 2), a tick each; the tick of the first one. Raises ConfigError, Refused."""
        tick = self._live.references.set_waveform(self.axis, samples, 1, repeat)
        self._set += 1
        return tick

    def hold(self, value_um: float) -> None:
        """A constant, and a while to come to rest. Raises Refused."""
        self._live.references.set(self.axis, {"kind": "hold", "value": value_um}, restores=True)
        self._set += 1
        time.sleep(REST_S)

    @contextmanager
    def coming_back(self) -> Iterator[None]:
        """At the end hold what was held, unless somebody else has set a reference."""
        try:
            yield
        finally:
            if self.ours:
                with suppress(RtloopError):
                    self.hold(self.hold_um)

    def played(self, samples: Real, judge: Callable[[Real], None] = lambda _: None) -> Real:
        """Records of the ticks in which references (ticks,) were played. Raises as `play` and `read` do."""
        rows = self.read(self.play(samples[:, np.newaxis]), samples.size, judge)
        if not np.array_equal(self.column(rows, signals.REFERENCE), samples):
            raise Refused(f"{self._doing}: the reference was changed meanwhile")
        return rows

    def column(self, rows: Real, signal: int) -> Real:
        """A signal (ticks,) of the axis, such as POSITION, in records that were read."""
        return rows[:, signals.axis_column(self._number, signal)]

    def read(self, first: int, count: int, judge: Callable[[Real], None] = lambda _: None) -> Real:
        """Records of `count` ticks from `first` on, as they come. Raises Refused as soon as one is not fit, and
        ClientGone as soon as nobody waits for them.

        `judge` may refuse, too: it is handed the position of the records that have come.
        """
        ring = self._supervisor.block.ring("ticks")
        rows = np.empty((count, ring.slots.shape[1]))
        read_count, deadline_s = 0, time.monotonic() + (first + count - self.tick) / self.rate_hz + PATIENCE_S
        while read_count < count:
            require_client(self._doing)
            new_count, _, lost = drain(ring, first + read_count, rows[read_count:])
            if lost:
                raise Refused(f"{self._doing}: ticks were lost before they could be read")
            if not self.ours:
                raise Refused(f"{self._doing}: somebody else has set a reference")
            if new_count:
                self._require_fit(rows[read_count : read_count + new_count])
                judge(self.column(rows[read_count : read_count + new_count], signals.POSITION))
            read_count += new_count
            if time.monotonic() > deadline_s:
                raise Refused(f"{self._doing}: the loop's ticks do not come")
            time.sleep(POLL_S)
        return rows

    def _require_fit(self, rows: Real) -> None:
        flags = np.bitwise_or.reduce(rows[:, signals.FLAGS].astype(np.int64))
        if causes := signals.trip_causes(flags):
            raise Refused(f"{self._doing}: tripped: {', '.join(causes)}")
        if np.any(rows[:, signals.MODE] != Mode.CLOSED_LOOP):
            raise Refused(f"{self._doing}: not in closed loop")
        if flags & (Flag.COMMAND_LIMITED | Flag.DRIVE_LIMITED | Flag.SLEW_LIMITED):
            remedy = "another setpoint, or less motion, is needed"
            raise Refused(f"{self._doing}: command or drive is clipped: {remedy}")
