"""Thread of a recovery: reports its steps to the loop, judges the readings, and returns."""

from __future__ import annotations

import contextlib
import logging
from functools import partial

from rtloop.engine.messages import Kind, Origin
from rtloop.errors import RtloopError
from rtloop.foundation import timing
from rtloop.recording.file.topics.recovery_steps import Note, RecoveryStep, StepReason
from rtloop.service.background import repeat_every
from rtloop.service.changing.references import ReferenceReplaced
from rtloop.service.desk import Refusal, Requester, use_requester
from rtloop.service.recovering.comeback import ReturnStep, RunningLoop, come_back
from rtloop.service.recovering.recovery import Host, Recovery, Return
from rtloop.signals import Mode

PERIOD_S = 0.02
log = logging.getLogger("rtloop")


def run_recovery(host: Host, recovery: Recovery) -> contextlib.AbstractContextManager[None]:
    """Return a context manager: during the work within, a thread calls `RecoveryWorker.step` every PERIOD_S."""
    return repeat_every(PERIOD_S, RecoveryWorker(host, recovery).step)


class RecoveryWorker:
    """Worker of a recovery; `step` waits for the loop, for seconds during a return."""

    def __init__(self, host: Host, recovery: Recovery) -> None:
        """Work for `recovery` in the loops of the service `host`, at each call of `step`."""
        self._host, self._recovery = host, recovery

    def step(self) -> None:
        """Send the recovery's new steps to the loop, judge the loop's readings if a confirmation is due, and return to
        the former state once all confirmations have succeeded.

        A return takes seconds. No effect without a loop; an RtloopError is logged.
        """
        try:
            loop = self._running_loop()
            if loop is None:
                return
            self._report_steps(loop)
            if (confirmed := self._recovery.confirm(loop.supervisor, loop.live)) is not None:
                self._return(loop, confirmed)
                self._report_steps(loop)
        except RtloopError as error:
            log.warning("recovery: %s", error)

    def _running_loop(self) -> RunningLoop | None:
        """Return the running loop, once it has executed a tick; None without one, and for a loop that has ended."""
        supervisor, live = self._host.supervisor, self._host.live
        if supervisor is None or live is None or supervisor.ended:
            return None
        try:
            return RunningLoop(supervisor, live, self._host.desk)
        except Refusal:
            return None

    def _report_steps(self, loop: RunningLoop) -> None:
        """Send the new steps through the loop, which makes them events of the recording.

        A step that the loop does not acknowledge stays in the recovery for the next call, also with the next loop;
        the RtloopError is ignored.
        """
        with use_requester(Requester(origin=Origin.SUPERVISOR)), contextlib.suppress(RtloopError):
            while (step := self._recovery.oldest_step) is not None and not loop.supervisor.ended:
                values = (step.step, step.left, step.reason, step.causes)
                loop.desk.submit(Note.RECOVERY, values=[float(value) for value in values])
                self._recovery.forget_step(step)

    def _return(self, loop: RunningLoop, confirmed: Return) -> None:
        """Return to the former state of `confirmed`, wait `confirmation_s` to see whether the loop trips again, and end
        the recovery.

        An RtloopError of the return ends it by `_fail`.
        """
        recovery, serial = self._recovery, confirmed.serial
        sine = self._host.configuration.service.depolarise if confirmed.options.depolarise else None
        requester = Requester(
            origin=Origin.SUPERVISOR, require_permission=partial(self._require_current, serial), may_always_stop=False
        )
        self._report_steps(loop)
        try:
            with use_requester(requester):
                come_back(confirmed.former, loop, sine, partial(self._take_step, loop, serial))
        except RtloopError as error:
            self._fail(error, loop, serial)
            return
        deadline_s = timing.monotonic_s() + confirmed.options.confirmation_s
        while recovery.is_current(serial) and timing.monotonic_s() < deadline_s:
            timing.sleep(PERIOD_S)
        recovery.finish(serial)

    def _require_current(self, serial: int) -> None:
        """Raise Refusal once the recovery `serial` has ended."""
        if not self._recovery.is_current(serial):
            raise Refusal("the recovery has ended")

    def _take_step(self, loop: RunningLoop, serial: int, step: ReturnStep) -> None:
        """Report `step` of the return `serial` as an event of the loop; after the reset, only remove the service's
        faults that the recovery covers.
        """
        if step is ReturnStep.RESET:
            self._recovery.remove_own_faults(serial)
            return
        self._recovery.report(
            serial, RecoveryStep.DEPOLARISED if step is ReturnStep.DEPOLARISED else RecoveryStep.RETURNING
        )
        self._report_steps(loop)

    def _fail(self, error: RtloopError, loop: RunningLoop, serial: int) -> None:
        """End the return `serial`, which failed with `error`: latch the recovery, log the error, add it to the
        service's faults, and set mode off.

        If the error is ReferenceReplaced, a client took over, and the recovery only ends. No effect if the recovery has
        ended already, or after another trip, which `Recovery.observe` handles. Raises as `Desk.submit`.
        """
        is_client = isinstance(error, ReferenceReplaced)
        if not self._recovery.finish(serial, StepReason.CLIENT if is_client else StepReason.REFUSED) or is_client:
            return
        log.error("recovery: %s", error)
        self._host.faults.append(f"recovery: {error}")
        with use_requester(Requester(origin=Origin.SUPERVISOR)):
            loop.desk.submit(Kind.SET_MODE, values=[float(Mode.OFF), 0.0, 1.0])
