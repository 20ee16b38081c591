"""Player of references on one axis of a running loop, which also reads the records of their ticks.

The records come from the ring that the recorder reads, so they are in the recording as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np

from rtloop import signals
from rtloop.engine.ring import drain
from rtloop.errors import RtloopError
from rtloop.foundation import timing
from rtloop.foundation.arrays import Real
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Refusal, UnconfirmedCommand
from rtloop.service.measuring.client_presence import require_client
from rtloop.signals import Flag, Mode
from rtloop.supervision.supervisor import Supervisor

REST_S, POLL_S, READ_MARGIN_S = 0.2, 0.02, 2.0
LIMITED_SIGNALS = {Flag.COMMAND_LIMITED: "command", Flag.DRIVE_LIMITED: "drive", Flag.SLEW_LIMITED: "slew rate"}
"""Name of the limited quantity for each flag."""


class Player:
    """Player on axis `number` about its setpoint `hold_um`, µm; messages begin with `activity`, such as "response".

    Raises Refusal if the loop is in another mode than closed_loop or the axis has no constant reference,
    ClientDisconnected if the client has disconnected.
    """

    def __init__(self, supervisor: Supervisor, live: LiveLaw, number: int, activity: str) -> None:
        """Store the axis's constant reference as `hold_um`, µm; messages begin with `activity`.

        Waits until a change of the reference has taken effect. Raises Refusal if the loop is in another mode than
        closed_loop or the reference is not constant, ClientDisconnected if the client has disconnected.
        """
        require_client(activity)
        self._supervisor, self._live, self._number, self._activity = supervisor, live, number, activity
        newest = supervisor.newest(1)
        if len(newest):
            self._require_closed_loop(newest)
        self.axis = live.prepared.plan.axes[number]
        self.rate_hz = live.prepared.configuration.loop.rate_hz
        self._set_count = live.references.set_count(number)  # First: a reference that is set now is another client's.
        self.hold_um = live.references.constant_reference_um(number)

    @property
    def next_tick(self) -> int:
        """Number of the tick that the loop executes next."""
        return self._supervisor.ticks

    @property
    def is_in_closed_loop(self) -> bool:
        """Whether the newest tick ran in closed loop and without a latched trip."""
        newest = self._supervisor.newest(1)
        flags = newest[:, signals.FLAGS].astype(np.int64)
        return bool(np.all(newest[:, signals.MODE] == Mode.CLOSED_LOOP)) and not any(map(signals.trip_causes, flags))

    @property
    def owns_reference(self) -> bool:
        """Whether no other client has set a reference of the axis since this player's last one, or since its start.

        Waits until a reference that is being set has taken effect or was refused; a refused one does not count.
        """
        return self._live.references.set_count(self._number) == self._set_count

    def play(self, samples: Real, *, repeat: bool = False) -> int:
        """Play samples (n, 1 or 2), µm, one per tick: reference, addition to the command. Returns the first one's tick.

        The samples play once, and the last one is held; with `repeat` they play endlessly. Does not wait for their end.
        Raises as `LiveReferences.set_waveform`, and Refusal if another client has set a reference.
        """
        self._require_ownership()
        with self._count_own_reference():
            return self._live.references.set_waveform(self.axis, samples, 1, repeat)

    def hold(self, value_um: float) -> None:
        """Set a constant reference, µm, also in place of another client's, and wait REST_S.

        Raises as `LiveReferences.set`, also Refusal in raw mode, in which the loop holds its output.
        """
        with self._count_own_reference():
            self._live.references.set(self.axis, {"kind": "hold", "value": value_um}, restores=True)
        timing.sleep(REST_S)

    @contextmanager
    def _count_own_reference(self) -> Iterator[None]:
        """Count the reference that the work within sets as this player's, unless it is refused."""
        try:
            yield
        except UnconfirmedCommand:  # The loop starts the reference if it goes on.
            self._set_count += 1
            raise
        self._set_count += 1

    def _require_ownership(self) -> None:
        """Raise Refusal if another client has set a reference of the axis since this player's last one."""
        if not self.owns_reference:
            raise Refusal(f"{self._activity}: another client has set a reference meanwhile; try again")

    @contextmanager
    def return_to_hold(self) -> Iterator[None]:
        """Hold the setpoint again after the work within, also if it fails, unless another client has set a reference.

        An RtloopError of this return is ignored.
        """
        try:
            yield
        finally:
            if self.owns_reference:
                with suppress(RtloopError):
                    self.hold(self.hold_um)

    def play_and_read(self, samples: Real, check_position: Callable[[Real], None] = lambda _: None) -> Real:
        """Play references (ticks,), µm, once, wait for their ticks, and return the records of these (ticks, columns).

        `check_position` as in `read`. Raises as `play` and `read`, and Refusal if the records have another reference.
        """
        rows = self.read(self.play(samples[:, np.newaxis]), samples.size, check_position)
        if not np.array_equal(self.column(rows, signals.REFERENCE), samples):
            raise Refusal(
                f"{self._activity}: the recorded reference differs from the reference that was sent, because "
                "loop.hold_input held the reference or another client changed the reference; try again while the hold "
                "input is inactive and no other client changes the reference"
            )
        return rows

    def column(self, rows: Real, signal: int) -> Real:
        """Return a signal of the axis (ticks,) from records (ticks, columns), by its number, such as POSITION."""
        return rows[:, signals.axis_column(self._number, signal)]

    def read(self, first: int, count: int, check_position: Callable[[Real], None] = lambda _: None) -> Real:
        """Wait for `count` ticks from tick `first` on and return their records (count, columns).

        `check_position` receives the positions (n,), µm, of new records and may raise Refusal. Raises Refusal for a
        tick that cannot be used (tripped, not in closed loop, clipped), if ticks were overwritten before they were
        read, once another client has set a reference, and READ_MARGIN_S after the last tick was due. Raises
        ClientDisconnected once the client has disconnected. The reference that plays is not changed.
        """
        ring = self._supervisor.block.ring("ticks")
        rows = np.empty((count, ring.slots.shape[1]))
        due_s = (first + count - self.next_tick) / self.rate_hz
        read_count, deadline_s = 0, timing.monotonic_s() + due_s + READ_MARGIN_S
        while read_count < count:
            require_client(self._activity)
            is_late = timing.monotonic_s() > deadline_s  # read first: a stalled service looks once more
            new_count, _, lost = drain(ring, first + read_count, rows[read_count:])
            if lost:
                raise Refusal(f"{self._activity}: ticks were overwritten before the service read them; try again")
            self._require_ownership()
            if new_count:
                self._require_usable(rows[read_count : read_count + new_count])
                check_position(self.column(rows[read_count : read_count + new_count], signals.POSITION))
            read_count += new_count
            if is_late and read_count < count:
                raise Refusal(f"{self._activity}: the loop stands still or runs too slowly; see `rtloop doctor`")
            timing.sleep(POLL_S)
        return rows

    def _require_usable(self, rows: Real) -> None:
        """Raise Refusal if the loop tripped, left closed loop or was clipped (command, drive, slew) in the records."""
        flags = np.bitwise_or.reduce(rows[:, signals.FLAGS].astype(np.int64))
        if causes := signals.trip_causes(flags):
            raise Refusal(f"{self._activity}: the loop tripped ({', '.join(causes)}); use `rtloop ctl reset` first")
        self._require_closed_loop(rows)
        if limited := [name for flag, name in LIMITED_SIGNALS.items() if flags & flag]:
            remedy = "use another setpoint, or less or slower motion"
            raise Refusal(f"{self._activity}: a limit changed the {' and the '.join(limited)}; {remedy}")

    def _require_closed_loop(self, rows: Real) -> None:
        """Raise Refusal if any of the records `rows` (ticks, columns) has another mode than closed_loop."""
        modes = rows[:, signals.MODE]
        if np.any(modes == Mode.OFF):
            remedy = "`rtloop ctl start`, or in a running loop `rtloop ctl mode closed_loop`"
            raise Refusal(f"{self._activity}: the mode is not closed_loop but off; use {remedy} first")
        if np.any(modes != Mode.CLOSED_LOOP):
            raise Refusal(f"{self._activity}: the mode is not closed_loop; use `rtloop ctl mode closed_loop` first")
