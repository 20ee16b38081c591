"""Settings of a recording around events, as the configuration, the header and the recorder use them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

SNAPSHOT_S = 1.0
"""Longest time between two snapshots of the law; recorded spans begin and end at snapshots."""
OVERVIEW_BATCH_S = 10.0
"""Time of omitted ticks that one chunk of the file covers."""
STANDSTILL_S = 10.0
"""Time for which the recorder may stand still, or be replaced, before a tick is lost."""


class EventWindow(NamedTuple):
    """Every tick is recorded from `before_s` before an event to `after_s` after it, else an overview each `every_s`.

    `on` are the conditions, in the words of `rtloop.recording.capture.conditions`.
    """

    before_s: float
    after_s: float
    on: tuple[str, ...]
    every_s: float

    @classmethod
    def from_header(cls, header: Mapping[str, Any]) -> Self | None:
        """Settings `around` of a valid header; None for a recording of every tick."""
        fields = header.get("around")
        return fields and cls(fields["before_s"], fields["after_s"], tuple(fields["on"]), fields["every_s"])

    @property
    def max_delay_s(self) -> float:
        """Longest time, in s, from the execution of a tick to its write to the file."""
        return self.before_s + 2 * SNAPSHOT_S + max(self.every_s, OVERVIEW_BATCH_S)

    def ring_factor(self, ring_s: float) -> float:
        """Factor (1 or more) by which a ring of `ring_s` seconds must be longer for this recording.

        Such a ring still holds the ticks that a dead recorder had in its buffer.
        """
        return max((self.max_delay_s + STANDSTILL_S) / ring_s, 1.0)
