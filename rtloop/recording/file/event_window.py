"""Recording around events: which stretches of a run are kept, as configuration, header and recorder say it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

SNAPSHOT_S = 1.0
"""At most so far apart are two snapshots of the law: a stretch begins, and ends, at one."""
OVERVIEW_BATCH_S = 10.0
"""Of time that is left out, in one chunk of the file."""
STANDSTILL_S = 10.0
"""That the recorder may stand still, or be replaced, before a tick is lost."""


class EventWindow(NamedTuple):
    """A stretch is kept from `before_s` before an event to `after_s` after it; an overview every `every_s` of the rest.

    `on` are the events, in the words of `rtloop.recording.capture.conditions`.
    """

    before_s: float
    after_s: float
    on: tuple[str, ...]
    every_s: float

    @classmethod
    def from_header(cls, header: Mapping[str, Any]) -> Self | None:
        """As a header has it; None for a recording of every tick."""
        fields = header.get("around")
        return fields and cls(fields["before_s"], fields["after_s"], tuple(fields["on"]), fields["every_s"])

    @property
    def max_delay_s(self) -> float:
        """So much later than it was executed a tick may get into the file."""
        return self.before_s + 2 * SNAPSHOT_S + max(self.every_s, OVERVIEW_BATCH_S)

    def ring_factor(self, ring_s: float) -> float:
        """How many times `ring_s` the loop's ring holds, so that the recorder's memory survives the recorder."""
        return max((self.max_delay_s + STANDSTILL_S) / ring_s, 1.0)
