"""State of a loop before its trip: mode, references and law, to which a recovery returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtloop.configuration.axis import AxisOptions, HoldOptions
from rtloop.foundation.arrays import Real
from rtloop.kernel.reference import Generator
from rtloop.recording.file.topics.recovery_steps import StepReason
from rtloop.service.changing.live import LiveLaw
from rtloop.service.changing.references import Setting
from rtloop.signals import Mode


@dataclass(frozen=True)
class FormerState:
    """Mode, references and options of the axes before a trip.

    `settings` has None for an unknown reference. `table` has the samples of the configured references. `live` is the
    law whose references `settings` are, `client_counts` the number of references that clients set on each of its axes.
    """

    mode: Mode
    settings: tuple[Setting | None, ...]
    axes: tuple[AxisOptions, ...]
    table: Real
    live: LiveLaw
    client_counts: tuple[int, ...]

    def obstacle(self, live: LiveLaw) -> StepReason | None:
        """Return why the loop of `live` cannot return to this state, None if it can.

        REFERENCE: a reference is unknown, or not in the unit of the mode. CHANGED: the loop has another law or other
        configured tables.
        """
        is_raw, uses_table = self.mode is Mode.RAW, False
        for setting in self.settings:
            if setting is None or setting.in_volts != is_raw:
                return StepReason.REFERENCE
            uses_table = uses_table or (setting.samples is None and setting.values[0] == Generator.TABLE)
        if options_without_references(live) != self.axes:
            return StepReason.CHANGED
        has_table = np.array_equal(self.table, live.prepared.plan.table)
        return None if has_table or not uses_table else StepReason.CHANGED

    def renewed(self, live: LiveLaw) -> FormerState:
        """Return this state for the loop of `live`, this one or a later one, with the references that clients have set
        since; the state itself if clients have set none in the same loop.

        Does not wait.
        """
        expected_counts = self.client_counts if live is self.live else (0,) * len(self.settings)
        if (counts := live.references.client_counts) == expected_counts and live is self.live:
            return self
        settings = tuple(
            setting if count == expected else live.references.setting(number)
            for number, (setting, count, expected) in enumerate(
                zip(self.settings, counts, expected_counts, strict=True)
            )
        )
        return FormerState(self.mode, settings, self.axes, self.table, live, counts)


def record_former_state(mode: Mode, live: LiveLaw) -> FormerState:
    """Return the state of the loop of `live`: `mode`, with the present references and options of the axes.

    A reference that is unknown is None. Does not wait.
    """
    counts = live.references.client_counts
    settings = tuple(live.references.setting(number) for number in range(len(counts)))
    table = np.asarray(live.prepared.plan.table)
    return FormerState(mode, settings, options_without_references(live), table, live, counts)


def options_without_references(live: LiveLaw) -> tuple[AxisOptions, ...]:
    """Return the options of the running axes, each with the default reference: a reference is no part of the law."""
    return tuple(axis.model_copy(update={"reference": HoldOptions()}) for axis in live.prepared.configuration.axes)
