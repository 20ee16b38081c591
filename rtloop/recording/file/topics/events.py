"""Recorded events: the loop's fixed-size message as a JSON object, and back without loss.

`what` holds the message's `values` and `identity` unchanged, so that a replay can execute the same commands, and their
meaning in words.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import IntEnum
from pathlib import PurePath
from typing import Any
from unicodedata import category

import numpy as np
import numpy.typing as npt

from rtloop.engine.messages import ALL_AXES, MESSAGE, Kind, Origin
from rtloop.recording.file.topics.recovery_steps import Note, step_meaning
from rtloop.signals import Failure, Flag, Mode, Silence, trip_causes

Event = dict[str, Any]
GAP, FINISHED, ROTATED, RECOVERED, CUT = "gap", "finished", "rotated", "recovered", "cut"
RECORDING_FAILED, RECORDING_RESUMED = "recording_failed", "recording_resumed"
RETENTION_BEGUN, FILE_REMOVED = "kept", "removed"
"""Kinds that the recorder itself writes; `who` is RECORDER."""
RECORDER = "recorder"
COMMANDS = frozenset(kind.name.lower() for kind in Kind if kind < Kind.REFUSED)
"""Kinds of events that record a command."""
OPERATOR = Origin.OPERATOR.name.lower()
"""Value of `who` for an operator without a name."""
LOST_HEARTBEAT = "the heartbeat of `rtloop run` or of the service stopped"
"""Reason of a trip by the heartbeat, which concerns all axes; a cause of SILENCES follows."""
SILENCES = {
    Silence.DEAD: "that process died",
    Silence.STOPPED: "that process was stopped by a signal, a debugger or a container",
    Silence.UNWATCHED: "that process lives, but its watch of the loop stood still",
    Silence.STARVED: "the host stalled that process: it was ready to run, and got no processor",
}
"""Causes of a lost heartbeat; recordings of older versions have none."""
RESERVED_NAMES = (*(origin.name.lower() for origin in Origin), RECORDER)
MAX_NAME = 40
"""Maximum length of an operator's name in characters."""
NAME_PUNCTUATION = " .-_@+'"
"""Characters allowed in a name besides letters and digits: safe in terminals, logs, pages and addresses."""
FINAL = (FINISHED, ROTATED, RECOVERED, CUT)
"""Kinds of the event that ends a file; its `what` holds the totals."""


def event_from_message(
    message: np.void, axes: Sequence[str], time_ns: int, laws: Sequence[str] = (), name: str | None = None
) -> Event:
    """Return one record of MESSAGE as an event {tick, time_ns, kind, who, axis, what}, due `time_ns` after the start.

    `axis` is a name, None for all axes. `laws` has the `law_label` of each law of the loop. `name` is the operator's
    name and becomes `who`; without it, `who` is the origin. `what` holds the message's `values` (NaN and infinities as
    text) and `identity`, and for some kinds their meaning, such as {mode} or {causes, reason}.
    """
    values = [float(value) for value in message["values"]]
    kind, axis = int(message["kind"]), int(message["axis"])
    meaning: dict[str, object] = {}
    if kind == Kind.SET_MODE:
        meaning = {"mode": _member_name(Mode, values[0])}
    elif kind == Kind.TRIPPED:
        meaning = {"causes": trip_causes(values[0]), "reason": trip_reason(message, axes, laws)}
    elif kind == Kind.PERIODS_MISSED:
        meaning = {"periods": json_value(values[0])}
    elif kind == Kind.LATENESS_OVER:
        meaning = dict(zip(("periods", "late_ticks", "largest"), map(json_value, values), strict=False))
    elif kind == Note.RECOVERY:
        meaning = step_meaning(values)
    return {
        "tick": int(message["tick"]),
        "time_ns": time_ns,
        "kind": _kind_name(kind),
        "who": name or _member_name(Origin, int(message["origin"])),
        "axis": axes[axis] if 0 <= axis < len(axes) else None,
        "what": {**meaning, "values": [json_value(value) for value in values], "identity": int(message["identity"])},
    }


def trip_reason(message: np.void, axes: Sequence[str], laws: Sequence[str]) -> str | None:
    """Describe the trip of a TRIPPED message: axis, value and limit, the failure of a law, or a lost heartbeat.

    None for any other trip that has no single axis.
    """
    all_causes, value, limit, bit, number = (float(element) for element in message["values"][:5])
    axis, causes = int(message["axis"]), trip_causes(bit)
    if not causes or not 0 <= axis < len(axes):
        return _heartbeat_text(value, int(number)) if int(all_causes) & Flag.TRIP_HEARTBEAT else None
    if causes == ["law"]:
        label = laws[int(number)] if 0 <= number < len(laws) else f"number {number:g}"
        return f"{axes[axis]}: law {label} {_failure_text(int(limit), value)}"
    flag = Flag(int(bit))
    return f"{axes[axis]}: {flag.message.format(cause=causes[0], value=value, limit=limit, unit=flag.unit)}"


def _heartbeat_text(silent_s: float, silence: int) -> str:
    """Describe a lost heartbeat by the length of its silence, 0 if it was not recorded, and a `Silence`."""
    cause = SILENCES.get(Silence(silence)) if silence in set(Silence) else None
    length = f" for {silent_s:.2g} s" if silent_s else ""
    return f"{LOST_HEARTBEAT}{length}: {cause or 'that process died or stood still'}"


def law_label(kind: str, file: str = "") -> str:
    """Return the name of a law for messages, with the name of its file, if it has one: `'damping' (damping.py)`."""
    return f"{kind!r} ({PurePath(file).name})" if file else repr(kind)


def _failure_text(code: int, value: float) -> str:
    """Describe a failure of a law by its `Failure` code: "returned nan from output of the controller".

    An odd code names the function that raised an exception, an even one the function that returned `value`.
    """
    slot, _, function = _member_name(Failure, code - code % 2).partition("_")
    return (
        f"raised an exception in {function} of the {slot}"
        if code % 2
        else f"returned {value:g} from {function} of the {slot}"
    )


def message_from_event(event: Event, axes: Sequence[str]) -> npt.NDArray[np.void] | None:
    """Return the record of MESSAGE, shape (1,), that `event` was made from; None for an event of the recorder.

    Raises ValueError for an unknown kind, and for an axis that is not in `axes`.
    """
    if event["who"] == RECORDER:
        return None
    record = np.zeros(1, MESSAGE)
    record["tick"], record["identity"] = event["tick"], event["what"]["identity"]
    record["kind"], record["origin"] = _kind_value(event["kind"]), _origin_value(event["who"])
    record["axis"] = ALL_AXES if event["axis"] is None else list(axes).index(event["axis"])
    record["values"][0] = [float(value) for value in event["what"]["values"]]
    return record


def name_problem(name: str) -> str | None:
    """Describe the fault in an operator's name and the allowed names; None for a valid name."""
    has_valid_characters = all(character in NAME_PUNCTUATION or category(character)[0] in "LMN" for character in name)
    if not 0 < len(name) <= MAX_NAME or not has_valid_characters or not name[0].isalnum() or name.endswith(" "):
        displayed = ascii(name[:MAX_NAME]) + "…" * (len(name) > MAX_NAME)
        allowed = (
            f"1 to {MAX_NAME} letters, digits, blanks and {NAME_PUNCTUATION.strip()}, a letter or digit first, no "
            "blank last"
        )
        return f"{displayed}; allowed: {allowed}"
    if name != OPERATOR and (is_member_name(Origin, name) or name.lower() == RECORDER):
        return f"{name!r} is reserved; allowed: a name that is not a number and none of {', '.join(RESERVED_NAMES)}"
    return None


def is_kind_name(name: str) -> bool:
    """Whether `name`, in capitals or not, is a Kind or Note of the loop's messages, or a number of at most 9 digits.

    A number stands for a kind that this version does not know.
    """
    return is_member_name(Kind, name) or is_member_name(Note, name)


def is_member_name(kinds: type[IntEnum], name: str) -> bool:
    """Whether `name`, in capitals or not, is a member of the enumeration `kinds`, or a number of at most 9 digits.

    A number stands for a member that this version does not know.
    """
    return name.upper() in kinds.__members__ or (name.isascii() and name.isdigit() and len(name) < 10)


def recorder_event(kind: str, tick: int, time_ns: int, details: Mapping[str, object]) -> Event:
    """Make an event of the recorder, `time_ns` after the start, for no axis; `details` becomes its `what`."""
    return {"tick": tick, "time_ns": time_ns, "kind": kind, "who": RECORDER, "axis": None, "what": details}


def _kind_name(kind: int) -> str:
    """Return the name of a Kind or Note in lower case, or the number as text if this version has no such kind."""
    return _member_name(Note if kind in list(Note) else Kind, kind)


def _kind_value(name: str) -> int:
    """Return the number of a Kind or Note by its name, or by its number as text. Raises ValueError for other text."""
    return _member_value(Note if name.upper() in Note.__members__ else Kind, name)


def _member_name(kinds: type[IntEnum], value: float) -> str:
    """Name of member `value` of the enumeration `kinds` in lower case, or the number as text without such a member."""
    try:
        return str(kinds(int(value)).name).lower()
    except (ValueError, OverflowError):
        return str(value)


def _origin_value(who: str) -> int:
    """Number of the origin `who`; OPERATOR for any other name, which an operator gave."""
    return _member_value(Origin, who) if is_member_name(Origin, who) else int(Origin.OPERATOR)


def _member_value(kinds: type[IntEnum], name: str) -> int:
    """Number of the member `name` of the enumeration `kinds`, or the number that the text `name` states.

    Raises ValueError if `name` is neither a member nor a number.
    """
    return int(kinds[name.upper()]) if name.upper() in kinds.__members__ else int(name)


def json_value(value: object) -> object:
    """Return a value for JSON: a NaN or infinity, which JSON lacks, as "nan", "inf" or "-inf", any other unchanged."""
    return repr(value) if isinstance(value, float) and not math.isfinite(value) else value
