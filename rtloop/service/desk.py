"""The desk: sends commands to the loop; the event that the loop writes for a command is its acknowledgement.

Callers do not wait for each other. A command without acknowledgement in time is withdrawn, so that it cannot take
effect after its refusal. If the loop has taken the command already, UnconfirmedCommand states that it may take effect.
Mode off is never withdrawn: it stays in the queue, and takes effect once the loop continues.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from rtloop.engine.commands import send, withdraw
from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import ALL_AXES, MESSAGE, Kind, Origin, message
from rtloop.engine.ring import drain
from rtloop.errors import RtloopError
from rtloop.foundation import timing
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.file.topics.events import OPERATOR
from rtloop.recording.file.topics.recovery_steps import Note
from rtloop.service.background import set_in_context
from rtloop.signals import Mode

ANSWER_TIMEOUT_S = 2.0
ANSWER_PERIODS = 3.0
"""Periods of the loop that are added to ANSWER_TIMEOUT_S, for slow loops."""
POLL_S = 0.001
MAX_CHANGES = 1000
"""Most changes of a law whose texts are stored."""


@dataclass(frozen=True)
class Requester:
    """Sender of commands: name and origin as in the recording. `require_permission` raises Refusal once the sender may
    send no more, as after a loss of the lock; it must not wait.
    """

    name: str = OPERATOR
    origin: Origin = Origin.OPERATOR
    require_permission: Callable[[], None] = lambda: None
    may_always_stop: bool = True
    """Whether a stop and a reset need no permission."""


UNNAMED_REQUESTER = Requester()
"""Requester with the name OPERATOR, which stands for a client without a name."""
_requester = ContextVar("requester", default=UNNAMED_REQUESTER)


def current_requester() -> Requester:
    """Return the requester of the work in this context, UNNAMED_REQUESTER if none was set."""
    return _requester.get()


def use_requester(requester: Requester) -> AbstractContextManager[None]:
    """Return a context manager: commands sent within, also by threads that copy the context, come from `requester`."""
    return set_in_context(_requester, requester)


class Refusal(RtloopError):
    """A request that the loop or the service's state does not allow, or that the loop did not acknowledge in time."""


class RefusedByLoop(Refusal):
    """A command of `kind` that the loop itself refused at `tick`.

    A loop that is tripped or stopping refuses a mode; its outputs are safe, or ramp there if the driver takes the
    writes. Coefficients that do not fit the loop are refused at any time.
    """

    def __init__(self, kind: Kind | Note, tick: int) -> None:
        """Make the message for a command of `kind`, with the reason for a refusal of this kind, and store `tick`."""
        reason = (
            "the coefficients do not fit the memory of the running loop; restart the service"
            if kind is Kind.LOAD_LAW
            else "the loop is tripped or is stopping; after a trip use reset first (`rtloop ctl reset`)"
        )
        super().__init__(f"{kind.name.lower()}: refused at tick {tick}, because {reason}")
        self.tick = tick


class UnconfirmedCommand(RtloopError):
    """The loop stands still, and took a command or will take it: it is unknown when, or whether, it takes effect."""


class Desk:
    """Sender of commands to the loop of `block`, from any thread; the recorder reads requesters' names from `names`.

    None stores no names. `rate_hz` is the loop's rate: a slow loop gets more time to acknowledge.
    """

    def __init__(self, block: SharedBlock, rate_hz: float = 1e6, names: RequesterNames | None = None) -> None:
        """Send to the loop of `block`, whose rate is `rate_hz`; `names`, unless None, receives requesters' names."""
        self._block, self._period_s, self._names = block, 1.0 / rate_hz, names
        self._lock = timing.lock()
        self._last_identity = 0
        self._changes: OrderedDict[int, str] = OrderedDict()

    def change_text(self, identity: int) -> str | None:
        """Return in words the change of a law for which the command with `identity`, the number in its event, was sent.

        None if that command was sent for no change of a law, and after MAX_CHANGES later changes.
        """
        return self._changes.get(identity)

    def submit(
        self, kind: Kind | Note, *, axis: int = ALL_AXES, values: Sequence[float] = (), change: str | None = None
    ) -> int:
        """Send a command of the `current_requester`, wait until it took effect, and return the tick of the effect.

        `axis` is a number from 0, by default all axes; `kind` and `values` as in `Kind`, or a Note, which the loop only
        records; `change` describes a change of a law in words, for `change_text`. Raises Refusal if the requester has
        no permission (a stop and a reset need none, unless `may_always_stop` is False), or without an acknowledgement
        in time (the command is withdrawn); RefusedByLoop if the loop refuses the command; UnconfirmedCommand if the
        loop took the command and stands still, and for mode off without an acknowledgement; QueueFull if too many
        commands wait for the loop.
        """
        requester = current_requester()
        command = message(cast(Kind, kind), axis=axis, origin=requester.origin, values=values)
        is_off = kind is Kind.SET_MODE and values[0] == Mode.OFF
        is_urgent = is_off or kind is Kind.RESET_TRIP
        with self._lock:  # The queue allows one producer. A permission that ends before a stop is sent ends here, too.
            if not (is_urgent and requester.may_always_stop):
                requester.require_permission()
            self._last_identity += 1
            command["identity"] = identity = self._last_identity
            cursor = int(self._block["events_head"][0])
            if self._names is not None and requester.name != OPERATOR:
                self._names.store(identity, requester.name)
            if change is not None:
                self._changes[identity] = change
                if len(self._changes) > MAX_CHANGES:
                    self._changes.popitem(last=False)
            position = send(self._block, command, urgent=is_urgent)
        return self._answer(kind, identity, cursor, None if is_off else position)

    def _answer(self, kind: Kind | Note, identity: int, cursor: int, position: int | None) -> int:
        """Wait for the event with `identity`, the acknowledgement of a command, and return its tick.

        `cursor` is the number of the first event to read, `position` the command's place in the queue (None: it must
        not be withdrawn), `kind` names it in messages. Raises RefusedByLoop if the loop refused the command. Without an
        acknowledgement in time, withdraws it and raises Refusal, or UnconfirmedCommand if it is not withdrawn.
        """
        timeout_s = ANSWER_TIMEOUT_S + ANSWER_PERIODS * self._period_s
        ring, deadline = self._block.ring("events"), timing.monotonic_s() + timeout_s
        events: npt.NDArray[np.void] = np.zeros(64, MESSAGE)
        is_late = False
        while True:
            event_count, first, _ = drain(ring, cursor, events)
            cursor = int(first) + event_count
            for event in events[:event_count]:
                if event["identity"] == identity:
                    if event["kind"] == Kind.REFUSED:
                        raise RefusedByLoop(kind, int(event["tick"]))
                    self._await_tick(int(event["tick"]), deadline)
                    return int(event["tick"])
            if is_late:
                break
            is_late = timing.monotonic_s() >= deadline
            if is_late and position is not None and withdraw(self._block, position):
                raise Refusal(
                    f"{kind.name.lower()}: the loop did not answer within {timeout_s:g} s; the command is withdrawn; "
                    "try again, and see `rtloop doctor` if the loop stands still"
                )
            timing.sleep(POLL_S)  # After a withdrawal that failed, too: the loop may have answered just now.
        if position is None:
            raise UnconfirmedCommand(
                f"{kind.name.lower()}: the loop did not answer within {timeout_s:g} s; mode off stays in force: the "
                "outputs ramp to safe as soon as the loop continues, and rtloop parks them if it ends the loop's "
                "process instead"
            )
        raise UnconfirmedCommand(
            f"{kind.name.lower()}: the loop has taken the command and stands still; "
            "the command takes effect if the loop continues"
        )

    def _await_tick(self, tick: int, deadline: float) -> None:
        """Wait for the record of `tick`, which follows the event, so that the newest record shows the command's effect.

        Returns at the monotonic time `deadline` at the latest, without an error.
        """
        while int(self._block["ticks_head"][0]) <= tick and timing.monotonic_s() < deadline:
            timing.sleep(POLL_S)
