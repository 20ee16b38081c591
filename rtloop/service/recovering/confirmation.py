"""Successive confirmations of one loop: periods in which the readings of every tick are sound."""

from __future__ import annotations

from rtloop.configuration.prepare import Prepared
from rtloop.recording.file.topics.recovery_steps import StepReason
from rtloop.service.recovering.soundness import unsound_reason
from rtloop.supervision.supervisor import Supervisor


class Confirmation:
    """Confirmations of the loop of `supervisor`, `period_s` each, from the monotonic time `now_s` on.

    `count` is the number of confirmations in a row, up to the newest one; an unsound reading sets it to 0.
    """

    def __init__(self, supervisor: Supervisor, period_s: float, now_s: float) -> None:
        """Begin with `count` 0 and with the first period: from the monotonic time `now_s` and the loop's next tick on,
        for `period_s`.
        """
        self.supervisor, self.count = supervisor, 0
        self._period_s, self._since_s, self._next_tick = period_s, now_s, supervisor.ticks

    def advance(self, prepared: Prepared, now_s: float) -> StepReason | None:
        """Judge the ticks since the begin of the period, once it has passed at the monotonic time `now_s`, and begin
        the next period.

        Sound readings add 1 to `count`, unsound ones set it to 0. Returns the reason for which they are unsound, which
        is NO_TICKS if one of these ticks can no longer be read; None for sound ones. None, without a judgement, before
        the end of the period and without a new tick.
        """
        ticks = self.supervisor.ticks
        if now_s - self._since_s < self._period_s or ticks == self._next_tick:
            return None
        rows = self.supervisor.newest(ticks - self._next_tick)
        is_complete = len(rows) > 0 and rows[0, 0] == self._next_tick
        reason = unsound_reason(rows, prepared) if is_complete else StepReason.NO_TICKS
        self._since_s, self._next_tick = now_s, ticks
        self.count = self.count + 1 if reason is None else 0
        return reason
