"""What the texts of a file may say, its header and its events: the one place where they are believed or not.

Everything behind relies on the types, ranges and names that stand here. Of a command it is checked what the kernels
make of it: a mode, the number of an axis, the kind of a generator and its place in a table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import pydantic_core
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rtloop import signals
from rtloop.engine.messages import MESSAGE_VALUES, Kind, Origin
from rtloop.law.extras import ExtraOutput, Extras
from rtloop.law.layout import MAX_EXTRAS
from rtloop.law.reference import Generator
from rtloop.recording.file.topics.events import (
    FINAL,
    GAP,
    KEPT,
    RECORDER,
    RECORDING_FAILED,
    RECORDING_RESUMED,
    REMOVED,
    Event,
    known,
    name_fault,
)
from rtloop.recording.file.topics.format import FORMAT
from rtloop.signals import Mode

HIGHEST_RATE_HZ, LOWEST_RATE_HZ = 1e6, 1e-3
LARGEST_TICK, LARGEST_NS = 1 << 53, 1 << 62
"""What a double counts exactly; what leaves room to add two of them in 64 bits."""
SHOWN = 60
"""Characters of a wrong value in a message."""

Text = Annotated[str, Field(max_length=1000, pattern=r"^[^\x00-\x1f\x7f-\x9f]*$")]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,99}$")]
Number = Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)]
Tick = Annotated[int, Field(ge=0, le=LARGEST_TICK)]
Words = dict[str, Any]


class Malformed(ValueError):
    """What is wrong, where, and what is allowed."""


class _Checked(BaseModel):
    """Keys that are not known are left alone: a later version may have more."""

    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)


class _Host(_Checked):
    cpu: Text | None = None
    kernel: Text | None = None


class _Realtime(_Checked):
    scheduler: Name | None = None
    priority: Number | None = None
    mlock: bool | None = None


class _Law(_Checked):
    sha256: Text | None = None
    revision: Annotated[int, Field(ge=1, le=1000)] = 1


class _Versions(_Checked):
    rtloop: Text | None = None


class _Input(_Checked):
    name: Name
    channel: Text


class _Output(_Input):
    axis: Annotated[int, Field(ge=0, lt=64)]
    lowest_v: float
    highest_v: float
    safe_v: float


class _Extras(_Checked):
    inputs: Annotated[list[_Input], Field(max_length=MAX_EXTRAS)] = []
    outputs: Annotated[list[_Output], Field(max_length=MAX_EXTRAS)] = []


class _Cut(_Checked):
    first: Tick
    end: Tick
    files: list[Text]


class _Around(_Checked):
    before_s: Annotated[float, Field(ge=0)]
    after_s: Annotated[float, Field(ge=0)]
    every_s: Annotated[float, Field(gt=0)]
    on: list[Text]


class _AnyHeader(_Checked):
    format: Annotated[int, Field(ge=1)]
    name: Text
    created_unix_ns: Annotated[int, Field(ge=0, lt=LARGEST_NS)]
    observed: list[Name]
    columns: Annotated[list[Name], Field(max_length=2000)]
    rate_hz: Annotated[float, Field(ge=LOWEST_RATE_HZ, le=HIGHEST_RATE_HZ)]
    paced: bool
    ticks_expected: Tick | None = None
    configuration: str
    realtime: _Realtime
    versions: _Versions
    host: _Host
    extras: _Extras = _Extras()
    sequence: Annotated[int, Field(ge=1, le=10**9)] = 1
    first_tick: Tick = 0
    repeats_before: Tick = 0
    cut: _Cut | None = None
    around: _Around | None = None


class _Event(_Checked):
    tick: Tick
    time_ns: Annotated[int, Field(gt=-LARGEST_NS, lt=LARGEST_NS)]
    kind: str
    who: str
    axis: str | None
    what: Words


class _Header(_AnyHeader):
    axes: Annotated[list[Name], Field(min_length=1, max_length=64)]
    law: _Law


class _Imported(_Checked):
    file: Text
    sha256: Text
    time: Text
    mapping: dict[Name, Text]
    units: dict[Name, Text]
    notes: list[Text]


class _ImportedHeader(_AnyHeader):
    """Of measured signals from another program's file: any columns behind the first two, and no law."""

    axes: Annotated[list[Name], Field(max_length=64)]
    law: None
    imported: _Imported


class _Gap(_Checked):
    first_tick: Tick
    count: Annotated[int, Field(ge=1, le=LARGEST_TICK)]


class _Totals(_Checked):
    ticks_executed: Tick
    ticks_logged: Tick
    ticks_lost: Annotated[int, Field(ge=-LARGEST_TICK, le=LARGEST_TICK)]
    events_lost: Tick
    result: Text
    complete: bool
    driver_error: Text | None = None
    gaps: list[Any] = []
    ticks_skipped: Tick = 0


class _Failure(_Checked):
    error: str


class _Resumed(_Checked):
    first_tick: Tick
    count: Tick


class _Kept(_Checked):
    on: Text


class _Removed(_Checked):
    file: Text
    size_bytes: Annotated[int, Field(ge=0)]
    reason: Text


_OF_RECORDER: dict[str, type[_Checked]] = {
    **dict.fromkeys(FINAL, _Totals), GAP: _Gap, RECORDING_FAILED: _Failure, RECORDING_RESUMED: _Resumed,
    KEPT: _Kept, REMOVED: _Removed,
}  # fmt: skip


class _Message(_Checked):
    values: Annotated[list[Any], Field(min_length=MESSAGE_VALUES, max_length=MESSAGE_VALUES)]
    identity: Number
    mode: Name | None = None
    causes: list[Name] = []
    reason: Text | None = None


def header_from(payload: bytes) -> dict[str, Any]:
    """The header in a message of `/configuration`. Raises Malformed."""
    header = _parsed(payload)
    number = header.get("format")
    if isinstance(number, int) and number > FORMAT:
        raise Malformed(f"recording format {_shown(number)} is newer than this version reads ({FORMAT})")
    _require(_ImportedHeader if "imported" in header else _Header, header)
    for key in ("axes", "observed", "columns"):
        if len(set(header[key])) < len(header[key]):
            raise Malformed(f"{key}: {_shown(header[key])}; a name may stand there once")
    return header


def require_columns(header: dict[str, Any]) -> None:
    """Raise Malformed where the columns are not those of the axes, the extras and the observed signals."""
    if "imported" in header:
        if header["columns"][:2] != ["tick", "deadline_ns"]:
            raise Malformed(f"columns: {_shown(header['columns'])}; tick and deadline_ns come first")
        if unknown := header["imported"]["units"].keys() - header["columns"]:
            raise Malformed(f"imported.units: {_shown(sorted(unknown))}; only columns have units")
        return
    axes, observed, extras = header["axes"], header["observed"], extras_of(header).columns
    expected = list(signals.columns(axes, observed, extras))
    if header["columns"] != expected:
        version = header["versions"].get("rtloop") or "of an unknown version"
        raise Malformed(
            f"columns: {_shown(header['columns'])}; axes and observed make {_shown(expected)}. The recording was "
            f"made by rtloop {version}: read it with that version"
        )


def extras_of(header: Mapping[str, Any]) -> Extras:
    """Inputs and outputs beside sensors and drives, as the loop had them."""
    entries = header.get("extras", {})
    outputs = [[output[field] for field in ExtraOutput._fields] for output in entries.get("outputs", ())]
    return Extras(
        tuple(entry["name"] for entry in entries.get("inputs", ())), tuple(ExtraOutput(*output) for output in outputs)
    )


def extra_channels_of(header: Mapping[str, Any]) -> dict[str, str]:
    """The channel of each of them."""
    entries = header.get("extras", {})
    return {entry["name"]: entry["channel"] for kind in ("inputs", "outputs") for entry in entries.get(kind, ())}


def event_from(payload: bytes, axes: Sequence[str]) -> Event:
    """The event in a message of `/events`, of a recording with these axes. Raises Malformed."""
    event = _parsed(payload)
    _require(_Event, event)
    kind, details = event["kind"], event["what"]
    if event["axis"] is not None and event["axis"] not in axes:
        raise Malformed(f"axis: {_shown(event['axis'])}; null or one of {', '.join(axes)} is allowed")
    if (model := _OF_RECORDER.get(kind)) is not None:
        if event["who"] != RECORDER:
            raise Malformed(f"who: {_shown(event['who'])}; only the {RECORDER} says {kind}")
        _require(model, details, "what.")
        return event
    if not known(Kind, kind):
        raise Malformed(f"kind: {_shown(kind)}; {', '.join(Kind.__members__).lower()} or a number")
    if not known(Origin, event["who"]) and (fault := name_fault(event["who"])):
        raise Malformed(f"who: {fault}")
    _require(_Message, details, "what.")
    _require_command(kind, event["axis"], [_number(value) for value in details["values"]])
    return event


def final_event(payload: bytes, axes: Sequence[str]) -> Event | None:
    """The event that ends a file, if a message of `/events` is one."""
    try:
        event = event_from(payload, axes)
    except Malformed:
        return None
    return event if event["kind"] in FINAL else None


def _require_command(kind: str, axis: str | None, values: list[float]) -> None:
    """Raise Malformed where the loop could not execute a command."""
    first, *parameters = values
    if kind == "load_law" and axis is None:
        raise Malformed("axis: null; a law is loaded for one axis")
    allowed_values = {"set_mode": [*Mode], "set_reference": [*Generator], "load_law": [0, 1]}.get(kind)
    if allowed_values and first not in allowed_values:
        raise Malformed(f"what.values: {first:g} for the {kind[kind.index('_') + 1 :]}; "
                        f"{', '.join(f'{value_allowed:d}' for value_allowed in allowed_values)} are allowed")  # fmt: skip
    minima = {Generator.TABLE: (0, 1, 1), Generator.INPUT: (0,)}.get(first, ()) if kind == "set_reference" else ()  # type: ignore[call-overload]
    for minimum, value in zip(minima, parameters, strict=False):
        if not (value.is_integer() and minimum <= value <= LARGEST_TICK):
            raise Malformed(f"what.values: {value:g}; a whole number from {minimum} is an index of a reference")


def _number(value: Any) -> float:
    """A number, or the word for one that JSON does not have."""
    if value in ("nan", "inf", "-inf"):
        return float(value)
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf:
        try:
            return float(value)
        except OverflowError:
            pass
    raise Malformed(f"what.values: {_shown(value)}; a number, 'nan', 'inf' or '-inf' is allowed")


def _parsed(payload: bytes) -> dict[str, Any]:
    try:
        value = pydantic_core.from_json(payload, allow_inf_nan=False)
    except ValueError:
        raise Malformed("it is not JSON") from None
    if not isinstance(value, dict):
        raise Malformed(f"{_shown(value)}; an object is needed")
    return value


def _require(model: type[BaseModel], found: dict[str, Any], place: str = "") -> None:
    try:
        model.model_validate(found)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        location = place + ".".join(str(part) for part in first["loc"])
        raise Malformed(f"{location}: {_shown(first['input'])}; {first['msg'].lower()}") from None


def _shown(value: Any) -> str:
    text = ascii(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 1]}…"
