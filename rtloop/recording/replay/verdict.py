"""Report of a replay: compared ticks, unverified ticks with reasons, and contents that no replay can judge."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rtloop import signals

if TYPE_CHECKING:
    from rtloop.recording.file.topics.format import Header


@dataclass
class ReplayReport:
    """Result of a replay: numbers of compared `ticks` and `snapshots`, and the ticks that were not compared.

    `gaps` are {first_tick, count}; `not_verified` are {first_tick, count, why}, with None for an unknown number.
    `first_difference` is {tick, signal, recorded, replayed}; None without one. `problems` are faults of the files.
    `not_judged` are contents that no replay can judge.

    Ticks that never reached the recorder (a gap in its ring) count as a gap, not as recorded; ticks that it omitted
    by intention count as `skipped`. Each of the `stretches` begins at a snapshot and is compared separately.
    """

    ticks: int = 0
    stretches: int = 0
    skipped: int = 0
    gaps: list[dict[str, int]] = field(default_factory=list)
    not_verified: list[dict[str, Any]] = field(default_factory=list)
    snapshots: int = 0
    first_difference: dict[str, Any] | None = None
    problems: list[str] = field(default_factory=list)
    not_judged: list[str] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        """Whether all recorded ticks, at least one, were compared once, in order, and no tick or snapshot differed."""
        return self.ticks > 0 and self.first_difference is None and not self.not_verified

    @property
    def unverified(self) -> int:
        """Number of recorded ticks that were not compared; a range of unknown length counts as 0."""
        return sum(entry["count"] or 0 for entry in self.not_verified)

    def add_unverified(self, first_tick: int | None, count: int | None, reason: str) -> None:
        """Add `count` unverified ticks from `first_tick` on; an adjacent range with the same reason is merged.

        None for `first_tick` or `count` means that it is unknown.
        """
        if self.not_verified and first_tick is not None and count is not None:
            last = self.not_verified[-1]
            if last["why"] == reason and last["count"] and last["first_tick"] + last["count"] == first_tick:
                last["count"] += count
                return
        self.not_verified.append({"first_tick": first_tick, "count": count, "why": reason})

    def as_dict(self) -> dict[str, object]:
        """Return the object that `rtloop replay --json` prints: the fields of the report.

        Keys: ticks, stretches, ticks_skipped, identical, first_difference, not_verified, unverified, gaps,
        snapshots_compared, problems, not_judged.
        """
        return {
            "ticks": self.ticks,
            "stretches": self.stretches,
            "ticks_skipped": self.skipped,
            "identical": self.identical,
            "first_difference": self.first_difference,
            "not_verified": self.not_verified,
            "unverified": self.unverified,
            "gaps": self.gaps,
            "snapshots_compared": self.snapshots,
            "problems": self.problems,
            "not_judged": self.not_judged,
        }


def unjudged_contents(header: Header) -> list[str]:
    """Return one text for each kind of recorded contents that no replay can judge: no output of the law depends on it.

    The texts are the same for every recording but for the names of its observed signals.
    """
    measured_names = ", ".join(signals.COMMON_SIGNALS[column].name for column in signals.MEASURED_COLUMNS)
    return [
        f"measured times: {measured_names}, flag OVERRUN, rate_hz, host",
        "inputs, where no output depends on them: adc_v, reference_um, feed_um, deadline_ns, periods_missed, "
        "sample_age_us, enable_v",
        f"observed signals: {', '.join(header['observed']) or 'there are none'}",
        "events other than commands to the law, such as generators of references; commands that change no output, or "
        "up to the first recorded tick; texts, who, time_ns and identity of events",
        "the state that the first snapshot starts from; the configuration's text",
    ]
