"""Recovery by policy, [service.recover]: after a trip from outside, confirmed by readings, at most some times an hour.

    ready ──allowed trip──► waiting ──wait_s──► confirming ──n confirmations──► returning ──► ready
      ▲                        ▲                    │ unsound: from 0                │ trip: counts once more
      └──reset── latched ◄─────┴── another cause, too many, a client's stop, another law

Nothing here waits or sends; `worker` does. The state of the service stays `tripped` until the return begins.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple, Protocol

from rtloop import signals
from rtloop.configuration.file import Configuration
from rtloop.configuration.service import RecoverOptions
from rtloop.foundation import timing
from rtloop.recording.file.topics.recovery_steps import REASON_TEXTS, RecoveryStep, StepReason
from rtloop.service.changing.active_references import Trip
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Desk
from rtloop.service.recovering.confirmation import Confirmation
from rtloop.service.recovering.former_state import FormerState, record_former_state
from rtloop.signals import Mode
from rtloop.supervision.supervisor import Supervisor

HOUR_S = 3600.0
LONGEST_PAUSE_S = 60.0
"""Longest pause between two starts of a loop whose driver fails each time."""
UNSOUND_PERIOD_S = 10.0
"""Time between two reports of unsound readings for the same reason."""
OUTSIDE_OUTCOMES = {"driver_failed": "driver", "heartbeat_lost": "heartbeat"}
"""Cause of the trip by the outcome of a loop that ended without a request."""
STANDSTILL_CAUSES, STANDSTILL = {"stale", "driver"}, "frozen"
"""While samples do not come, the reading stands still and the outputs ramp: `frozen` may follow these causes."""
log = logging.getLogger("rtloop")


class RecoveryState(StrEnum):
    """State of the recovery, as the status shows it."""

    READY = "ready"
    """There is no trip to recover from."""
    WAITING = "waiting"
    CONFIRMING = "confirming"
    RETURNING = "returning"
    LATCHED = "latched"
    """The service does not return before `reset`."""


class Host(Protocol):
    """The attributes of the service that a recovery uses."""

    configuration: Configuration
    supervisor: Supervisor | None
    live: LiveLaw | None
    faults: list[str]
    armed: bool

    @property
    def desk(self) -> Desk:
        """The desk of the running loop. Raises Refusal without a running loop."""
        ...

    @property
    def is_moved(self) -> bool:
        """Whether a measurement or the preparation of the actuator moves the loop."""
        ...


class Step(NamedTuple):
    """A step of the recovery: its reason, recoveries left within the hour, causes of the trip as bits of Flag."""

    step: RecoveryStep
    reason: StepReason
    left: int
    causes: int


class Return(NamedTuple):
    """A confirmed return: the state to return to, the options, and the serial number of the recovery."""

    former: FormerState
    options: RecoverOptions
    serial: int


class Recovery:
    """Recovery of one service. Thread-safe; `now_s` is a monotonic clock."""

    def __init__(self, host: Host, now_s: Callable[[], float] = timing.monotonic_s) -> None:
        """Begin in the state READY for the service `host`; `now_s` returns a monotonic time in s."""
        self._host, self._now_s = host, now_s
        self._guard = timing.reentrant_lock()
        self._state, self._reason, self._causes = RecoveryState.READY, StepReason.NONE, 0
        self._former: FormerState | None = None
        """State to return to; None unless a recovery is under way."""
        self.unrestored: FormerState | None = None
        """State whose references a return or a preparation has replaced and not restored: the next start does it."""
        self._serial = 0
        """Changes when a recovery begins or ends; the commands of an earlier one are refused."""
        self._begun_s: deque[float] = deque()
        self._due_s, self._unsound_s = 0.0, 0.0
        self._confirmation: Confirmation | None = None
        self._live: LiveLaw | None = None
        self._seen_trip = 0
        self._own_faults: set[str] = set()
        self._failures = 0
        """Loops that the driver ended, or that could not start, since the last return."""
        self._steps: deque[Step] = deque(maxlen=64)

    def observe(self) -> None:
        """Begin a recovery after a new trip in the loop's events, as `_begin` does; latch a recovery under way, so that
        the service does not return before `reset`, if it is no longer allowed.

        It is no longer allowed once [service.recover] is removed and, until its return begins, for any reason of
        `_obstacle`. A reference that a client sets until then becomes one to return to. Call this often, each time
        after `LiveReferences.follow`.
        """
        with self._guard:
            options, live = self._options, self._host.live
            if options is None:
                if self._former is not None:
                    self._end(RecoveryStep.ENDED, StepReason.CHANGED, RecoveryState.LATCHED)
                return
            if live is None:
                return
            if live is not self._live:
                self._live, self._seen_trip = live, 0
            trip = live.references.trip
            if trip.number != self._seen_trip:
                self._seen_trip = trip.number
                self._begin(trip, live, options)
            elif self._former is not None and self._state is not RecoveryState.RETURNING:
                self._causes |= trip.causes
                if (reason := self._obstacle(trip, options)) is not None:
                    self._end(RecoveryStep.LATCHED, reason, RecoveryState.LATCHED)
                elif live is self._former.live:
                    self._former = self._former.renewed(live)

    def _begin(self, trip: Trip, live: LiveLaw, options: RecoverOptions) -> None:
        """Begin a recovery after a new trip; the guard must be held. A trip during a recovery begins another one, which
        counts once more, with the same former state.

        Latches instead (no return before `reset`) for a reason of `_obstacle`, for an unknown mode, and if no recovery
        is left within the hour. No effect while latched, and for a trip in mode off without a recovery under way: there
        is no mode to return to.
        """
        is_under_way = self._former is not None
        if self._state is RecoveryState.LATCHED or (trip.mode is Mode.OFF and not is_under_way):
            return
        self._causes = trip.causes
        reason = self._obstacle(trip, options)
        if reason is None and self._former is None:
            self._former = None if trip.mode is None else record_former_state(trip.mode, live)
            reason = StepReason.REFERENCE if self._former is None else None
        if reason is not None:
            self._end(RecoveryStep.LATCHED, reason, RecoveryState.LATCHED)
            return
        self._wait(options)

    def _wait(self, options: RecoverOptions) -> None:
        """Count one more recovery and enter WAITING; latch if none is left. The guard must be held."""
        if self._count_remaining(options) == 0:
            self._end(RecoveryStep.LATCHED, StepReason.COUNT, RecoveryState.LATCHED)
            return
        self._begun_s.append(self._now_s())
        self._serial += 1
        self._state, self._reason, self._confirmation = RecoveryState.WAITING, StepReason.NONE, None
        self._due_s = self._now_s() + options.wait_s
        self._add_step(RecoveryStep.BEGUN)

    def _obstacle(self, trip: Trip, options: RecoverOptions) -> StepReason | None:
        """Return why the service may not return after `trip` in its present state, None if it may.

        In this order: another cause, a client's stop, another fault of the service, a measurement, outputs not armed.
        """
        if not _are_allowed(trip, options):
            return StepReason.CAUSE
        if trip.is_stopped:
            return StepReason.CLIENT
        if set(self._host.faults) - self._own_faults:
            return StepReason.FAULT
        if self._host.is_moved:
            return StepReason.ACTIVITY
        return None if self._host.armed else StepReason.DISARMED

    def confirm(self, supervisor: Supervisor, live: LiveLaw) -> Return | None:
        """Judge the newest readings if a confirmation is due; unsound ones set the count of confirmations to 0.

        Once the required number of confirmations has succeeded in a row, the state becomes RETURNING, and the result is
        a Return: the state to return to, options and serial number. None otherwise: before, in any state but WAITING
        and CONFIRMING, if `live` is not the loop that `observe` has seen last, and for an obstacle at the end, which
        latches the recovery (no return before `reset`).
        """
        with self._guard:
            options, former = self._options, self._former
            is_due = self._state in (RecoveryState.WAITING, RecoveryState.CONFIRMING) and self._now_s() >= self._due_s
            if options is None or former is None or live is not self._live or not is_due:
                return None
            if self._confirmation is None or self._confirmation.supervisor is not supervisor:
                self._state = RecoveryState.CONFIRMING
                self._confirmation = Confirmation(supervisor, options.confirmation_s, self._now_s())
            if (reason := self._confirmation.advance(live.prepared, self._now_s())) is not None:
                self._add_unsound(reason)
            if self._confirmation.count < options.confirmations:
                return None
            former = former.renewed(live)
            obstacle = self._obstacle(live.references.trip, options) or former.obstacle(live)
            if obstacle is not None:
                self._end(RecoveryStep.LATCHED, obstacle, RecoveryState.LATCHED)
                return None
            self._state, self._reason, self.unrestored = RecoveryState.RETURNING, StepReason.NONE, former
            self._add_step(RecoveryStep.CONFIRMED)
            return Return(former, options, self._serial)

    def is_current(self, serial: int) -> bool:
        """Return whether the recovery `serial` is still under way; another trip ends it, too."""
        return self._serial == serial

    def report(self, serial: int, step: RecoveryStep) -> None:
        """Add a step of the return `serial`, to be sent to the loop; no effect once that recovery has ended."""
        with self._guard:
            if self._serial == serial:
                self._add_step(step)

    def finish(self, serial: int, failure: StepReason | None = None) -> bool:
        """End the return `serial`: it succeeded (None), a client took over (CLIENT), or it failed and latches until
        `reset` (any other reason).

        Returns True; False, without effect, if the return has ended already, if its loop is gone, or if another trip is
        in the loop's events, which `observe` handles.
        """
        with self._guard:
            live = self._host.live
            if self._serial != serial or live is not self._live or live is None:
                return False
            live.references.follow()
            if live.references.trip.number != self._seen_trip:
                return False
            if failure is None:
                self._failures, self.unrestored = 0, None
                self._end(RecoveryStep.RECOVERED, StepReason.NONE, RecoveryState.READY)
            elif failure is StepReason.CLIENT:
                self._end(RecoveryStep.ENDED, failure, RecoveryState.READY)
            else:
                self._end(RecoveryStep.LATCHED, failure, RecoveryState.LATCHED)
            return True

    def end(self) -> bool:
        """End a recovery that is under way, because a client takes over; the recovery sends no command afterwards.

        The state becomes READY if the return has begun, else LATCHED: no return before `reset`. Returns whether a
        recovery was under way.
        """
        with self._guard:
            if self._former is None:
                return False
            is_returning = self._state is RecoveryState.RETURNING
            state = RecoveryState.READY if is_returning else RecoveryState.LATCHED
            self._end(RecoveryStep.ENDED, StepReason.CLIENT, state)
            return True

    def clear(self) -> None:
        """Enter the state READY after a reset, and end a recovery under way; the recoveries of the last hour still
        count.
        """
        with self._guard:
            self.end()
            self._state, self._reason, self._causes, self._failures = RecoveryState.READY, StepReason.NONE, 0, 0
            self._own_faults.clear()

    def accept_end(self, outcome: str, fault: str) -> bool:
        """Return whether the policy covers a loop that ended without a request, with the `outcome` of its RunResult.

        If True, the return will remove `fault`, the text that the service latches for this end, from the service's
        faults. If False, the recovery latches until `reset`, except without a policy, when its state does not change.
        """
        with self._guard:
            options = self._options
            if options is None:
                return False
            if OUTSIDE_OUTCOMES.get(outcome) in options.causes:
                return self._accept(fault, options)
            if self._state is not RecoveryState.LATCHED:
                self._end(RecoveryStep.LATCHED, StepReason.CAUSE, RecoveryState.LATCHED)
            return False

    def accept_failed_start(self, fault: str) -> bool:
        """Return whether the policy covers a loop whose driver could not be opened.

        If True, the return will remove `fault`, the text that the service latches for this failure, from the service's
        faults. False, without effect, without a policy, if it lacks the cause "driver", and before a first loop has
        run: the first loop must start.
        """
        with self._guard:
            options = self._options
            if options is None or "driver" not in options.causes or self._live is None:
                return False
            return self._accept(fault, options)

    def _accept(self, fault: str, options: RecoverOptions) -> bool:
        """Count a loop that ended or could not start, and store `fault`, the text that the service latches for this
        failure, so that the return removes `fault` from the service's faults. Returns True.

        A loop that ends in a return, before the return has reset its trip, tells no other trip: the next loop must be
        confirmed anew.
        """
        self._own_faults.add(fault)
        self._failures += 1
        if self._state is RecoveryState.RETURNING:
            self._wait(options)
        return True

    def remove_own_faults(self, serial: int) -> None:
        """Remove from the service's faults each one that `accept_end` or `accept_failed_start` has accepted; no effect
        once the recovery `serial` has ended, also by the end of its loop, which has added a fault.
        """
        with self._guard:
            if self._serial != serial:
                return
            self._host.faults[:] = [fault for fault in self._host.faults if fault not in self._own_faults]
            self._own_faults.clear()

    @property
    def pause_s(self) -> float:
        """Pause before the next start of a loop, s: `wait_s`, doubled with each further failure, at most
        LONGEST_PAUSE_S; LONGEST_PAUSE_S without [service.recover].
        """
        wait_s = LONGEST_PAUSE_S if self._options is None else self._options.wait_s
        return min(wait_s * 2.0 ** min(max(self._failures - 1, 0), 10), LONGEST_PAUSE_S)

    @property
    def is_returning(self) -> bool:
        """Whether the return has begun, and neither succeeded nor ended."""
        return self._state is RecoveryState.RETURNING

    @property
    def oldest_step(self) -> Step | None:
        """The oldest step that no loop has acknowledged as an event of its recording; None if there is none."""
        with self._guard:
            return self._steps[0] if self._steps else None

    def forget_step(self, step: Step) -> None:
        """Remove `step`, once it is an event of the loop; no effect if it is not the oldest step."""
        with self._guard:
            if self._steps and self._steps[0] is step:
                self._steps.popleft()

    def for_json(self) -> dict[str, object] | None:
        """Return {state, left, confirmed, confirmations, causes, reason} for `/status`; None without [service.recover].

        `left` is the number of recoveries left within the hour; `confirmed` is the number of confirmations that have
        succeeded in a row, `confirmations` the required number; `causes` are the names of the trip's causes; `reason`
        is the last reason in words, None without one.
        """
        with self._guard:
            options = self._options
            return None if options is None else {
                "state": self._state.value,
                "left": self._count_remaining(options),
                "confirmed": 0 if self._confirmation is None else self._confirmation.count,
                "confirmations": options.confirmations,
                "causes": signals.trip_causes(self._causes),
                "reason": REASON_TEXTS.get(self._reason),
            }  # fmt: skip

    @property
    def _options(self) -> RecoverOptions | None:
        """The policy in the present configuration; None if recovery is off."""
        return self._host.configuration.service.recover

    def _count_remaining(self, options: RecoverOptions) -> int:
        """Return how many recoveries the policy still allows, given those begun in the last 3600 s.

        `self._guard` must be held.
        """
        while self._begun_s and self._now_s() - self._begun_s[0] >= HOUR_S:
            self._begun_s.popleft()
        return max(options.max_per_hour - len(self._begun_s), 0)

    def _end(self, step: RecoveryStep, reason: StepReason, state: RecoveryState) -> None:
        """End the recovery: enter `state`, add `step` with its reason, and refuse further commands of this recovery.

        The guard must be held.
        """
        self._serial += 1
        self._former, self._confirmation = None, None
        self._state, self._reason = state, reason
        self._add_step(step, reason)

    def _add_unsound(self, reason: StepReason) -> None:
        """Add a step for unsound readings, at most one in UNSOUND_PERIOD_S for the same reason.

        The guard must be held.
        """
        if reason is not self._reason or self._now_s() >= self._unsound_s:
            self._reason, self._unsound_s = reason, self._now_s() + UNSOUND_PERIOD_S
            self._add_step(RecoveryStep.UNSOUND, reason)

    def _add_step(self, step: RecoveryStep, reason: StepReason = StepReason.NONE) -> None:
        """Add a step to be reported, and log it; the guard must be held."""
        options = self._options
        left = 0 if options is None else self._count_remaining(options)
        self._steps.append(Step(step, reason, left, self._causes))
        causes, text = ", ".join(signals.trip_causes(self._causes)), REASON_TEXTS.get(reason)
        is_bad = step in (RecoveryStep.LATCHED, RecoveryStep.UNSOUND)
        words = f"recovery after {causes or 'a trip'}: {step.name.lower()}{f' ({text})' if text else ''}"
        log.log(logging.WARNING if is_bad else logging.INFO, "%s; recoveries left within the hour: %d", words, left)


def _are_allowed(trip: Trip, options: RecoverOptions) -> bool:
    """Return whether the policy, `options.causes`, covers the first causes of a trip and the later ones.

    The later cause `frozen` is also covered after `stale` or `driver`.
    """
    first, allowed = set(signals.trip_causes(trip.first_causes)), set(options.causes)
    followers = {STANDSTILL} if first & STANDSTILL_CAUSES else set()
    return first <= allowed and set(signals.trip_causes(trip.causes)) <= allowed | followers
