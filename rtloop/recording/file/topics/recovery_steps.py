"""Steps of a recovery by policy, as messages of the service that pass through the loop and are recorded as events.

The loop acknowledges a message of a kind that it does not know without any effect; so a step gets the tick at which it
was taken. values[0]: RecoveryStep; values[1]: recoveries that are left within the hour; values[2]: StepReason;
values[3]: causes of the trip as bits of Flag.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

from rtloop.signals import trip_causes


class Note(IntEnum):
    """Kinds of messages that have no effect in the loop, beside those of `rtloop.engine.messages.Kind`."""

    RECOVERY = 50


class RecoveryStep(IntEnum):
    """Step of a recovery."""

    BEGUN = 1
    """A trip with an allowed cause: the service waits and confirms the readings."""
    UNSOUND = 2
    """A reading was not sound; the confirmations begin anew."""
    CONFIRMED = 3
    """All confirmations succeeded; the trip is reset next."""
    DEPOLARISED = 4
    RETURNING = 5
    """The former mode is set, and the references move to the former ones."""
    RECOVERED = 6
    ENDED = 7
    """The recovery ended without a return: a client took over."""
    LATCHED = 8
    """The trip stays latched until `reset`."""


class StepReason(IntEnum):
    """Reason of a step: first those of UNSOUND, then those of ENDED and LATCHED."""

    NONE = 0
    NO_TICKS = 1
    OUTPUTS = 2
    DRIVER = 3
    AGE = 4
    SENSOR = 5
    POSITION = 6
    ENABLE = 7
    LATENESS = 8
    CLIENT = 20
    CAUSE = 21
    COUNT = 22
    ACTIVITY = 23
    FAULT = 24
    CHANGED = 25
    REFUSED = 26
    REFERENCE = 27
    DISARMED = 28


REASON_TEXTS = {
    StepReason.NO_TICKS: "ticks are missing, so their readings are unknown",
    StepReason.OUTPUTS: "an output is not at its safe value, or the driver refused to write it",
    StepReason.DRIVER: "the driver reports a fault (driver_status is not 0)",
    StepReason.AGE: "the sample is older than interlocks.sample_age_us",
    StepReason.SENSOR: "a reading is not finite, beyond its limits or at the end of the channel's range",
    StepReason.POSITION: "a position is beyond interlocks.position_um",
    StepReason.ENABLE: "the enable input is open",
    StepReason.LATENESS: "a tick was later than interlocks.late_us",
    StepReason.CLIENT: "a client's command",
    StepReason.CAUSE: "the trip has a cause that is not in service.recover.causes",
    StepReason.COUNT: "as many recoveries as service.recover.max_per_hour allows were made within the hour",
    StepReason.ACTIVITY: "a measurement or the preparation of the actuator was under way",
    StepReason.FAULT: "the service has another fault than the trip",
    StepReason.CHANGED: "the configuration or the law changed since the trip",
    StepReason.REFUSED: "a step of the recovery failed",
    StepReason.REFERENCE: "the former mode or reference is unknown",
    StepReason.DISARMED: "the outputs are not armed",
}


def step_meaning(values: Sequence[float]) -> dict[str, object]:
    """Return {step, left, reason, causes} of the values of a RECOVERY message.

    `step`: name of a RecoveryStep in lower case; `left`: number of recoveries left within the hour; `reason`: text, or
    None for a step without a reason; `causes`: names of the trip's causes. A step or reason that this version does not
    know is its number as text.
    """
    step, left, reason, causes = (int(value) for value in values[:4])
    is_known = reason in list(StepReason)
    text = REASON_TEXTS.get(StepReason(reason)) if is_known else str(reason)
    name = RecoveryStep(step).name.lower() if step in list(RecoveryStep) else str(step)
    return {"step": name, "left": left, "reason": text, "causes": trip_causes(causes)}
