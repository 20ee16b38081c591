"""Validation of the texts in a file: its header and its events.

All other code relies on the types, ranges and names that are checked here. Of a command, the values that the kernels
use are checked: the mode, the axis, the kind of a generator and its place in a table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, cast

import pydantic_core
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rtloop import signals
from rtloop.engine.messages import MESSAGE_VALUES, Kind, Origin
from rtloop.kernel.extras import ExtraOutput, Extras, Mark
from rtloop.kernel.layout import MAX_EXTRAS
from rtloop.kernel.reference import Generator
from rtloop.recording.file.topics.events import (
    FILE_REMOVED,
    FINAL,
    GAP,
    RECORDER,
    RECORDING_FAILED,
    RECORDING_RESUMED,
    RETENTION_BEGUN,
    Event,
    is_kind_name,
    is_member_name,
    name_problem,
)
from rtloop.recording.file.topics.format import FORMAT, Header
from rtloop.recording.file.topics.recovery_steps import Note
from rtloop.signals import Mode

HIGHEST_RATE_HZ, LOWEST_RATE_HZ = 1e6, 1e-3
LARGEST_TICK, LARGEST_NS = 1 << 53, 1 << 62
"""Largest number up to which a double counts exactly; largest time of which two can be added in 64 bits."""
MAX_SHOWN_CHARACTERS = 60
"""Maximum number of characters of a wrong value in a message."""

Text = Annotated[str, Field(max_length=1000, pattern=r"^[^\x00-\x1f\x7f-\x9f]*$")]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,99}$")]
Number = Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)]
Tick = Annotated[int, Field(ge=0, le=LARGEST_TICK)]
JsonObject = dict[str, Any]


class MalformedText(ValueError):
    """A malformed text; the message gives the place, the value and the allowed values."""


class _CheckedModel(BaseModel):
    """Model that ignores unknown keys: a later version may have more."""

    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False, defer_build=True)


class _HostModel(_CheckedModel):
    """Header field `host`."""

    cpu: Text | None = None
    kernel: Text | None = None


class _RealtimeModel(_CheckedModel):
    """Header field `realtime`."""

    scheduler: Name | None = None
    priority: Number | None = None
    mlock: bool | None = None


class _LawModel(_CheckedModel):
    """Header field `law`."""

    sha256: Text | None = None
    revision: Annotated[int, Field(ge=1, le=1000)] = 1
    laws: list[JsonObject] = []


class _DriverModel(_CheckedModel):
    """Header field `driver` of a run: its kind."""

    kind: Name


class _VersionsModel(_CheckedModel):
    """Header field `versions`."""

    rtloop: Text | None = None


class _InputModel(_CheckedModel):
    """Recorded input besides the sensors: its name and its channel."""

    name: Name
    channel: Text


class _OutputModel(_InputModel):
    """Recorded output besides the drives, and its range."""

    axis: Annotated[int, Field(ge=0, lt=64)]
    lowest_v: float
    highest_v: float
    safe_v: float
    mark: Annotated[int, Field(ge=0, le=max(Mark))] = 0
    level_um: float = 0.0


class _ExtrasModel(_CheckedModel):
    """Header field `extras`."""

    inputs: Annotated[list[_InputModel], Field(max_length=MAX_EXTRAS)] = []
    outputs: Annotated[list[_OutputModel], Field(max_length=MAX_EXTRAS)] = []


class _CutModel(_CheckedModel):
    """Header field `cut` of a recording that was cut: its range of ticks, without `end`, and the original files."""

    first: Tick
    end: Tick
    files: list[Text]


class _EventWindowModel(_CheckedModel):
    """Settings `around` of a recording around events."""

    before_s: Annotated[float, Field(ge=0)]
    after_s: Annotated[float, Field(ge=0)]
    every_s: Annotated[float, Field(gt=0)]
    on: list[Text]


class _HeaderBase(_CheckedModel):
    """Header fields of every recording."""

    format: Annotated[int, Field(ge=1)]
    name: Text
    created_unix_ns: Annotated[int, Field(ge=0, lt=LARGEST_NS)]
    observed: list[Name]
    columns: Annotated[list[Name], Field(max_length=2002)]  # tick, deadline_ns, and all columns of an imported file
    rate_hz: Annotated[float, Field(ge=LOWEST_RATE_HZ, le=HIGHEST_RATE_HZ)]
    paced: bool
    ticks_expected: Tick | None = None
    configuration: str
    realtime: _RealtimeModel
    versions: _VersionsModel
    host: _HostModel
    extras: _ExtrasModel = _ExtrasModel.model_construct()
    sequence: Annotated[int, Field(ge=1, le=10**9)] = 1
    first_tick: Tick = 0
    repeats_before: Tick = 0
    cut: _CutModel | None = None
    around: _EventWindowModel | None = None


class _EventModel(_CheckedModel):
    """Event of `/events`; `what` is validated by its kind."""

    tick: Tick
    time_ns: Annotated[int, Field(gt=-LARGEST_NS, lt=LARGEST_NS)]
    kind: str
    who: str
    axis: str | None
    what: JsonObject


class _RunHeader(_HeaderBase):
    """Header of a recording by rtloop."""

    axes: Annotated[list[Name], Field(min_length=1, max_length=64)]
    law: _LawModel
    driver: _DriverModel


class _ImportedModel(_CheckedModel):
    """Header field `imported`: origin and units of imported signals."""

    file: Text
    sha256: Text
    time: Text
    mapping: dict[Name, Text]
    units: dict[Name, Text]
    notes: list[Text]
    position_first: bool = False


class _ImportedHeader(_HeaderBase):
    """Header of imported signals: any columns after the first two, and no law."""

    axes: Annotated[list[Name], Field(max_length=64)]
    law: None
    imported: _ImportedModel


class _TotalsDetails(_CheckedModel):
    """Details of an event that ends a file."""

    ticks_executed: Tick
    ticks_logged: Tick
    ticks_lost: Annotated[int, Field(ge=-LARGEST_TICK, le=LARGEST_TICK)]
    events_lost: Tick
    result: Text
    complete: bool
    driver_error: Text | None = None
    gaps: list[Any] = []
    ticks_skipped: Tick = 0


class _FailureDetails(_CheckedModel):
    """Details of an event that recording failed."""

    error: str


class _ResumptionDetails(_CheckedModel):
    """Details of an event that recording was resumed: the missing range of ticks."""

    first_tick: Tick
    count: Tick


class _GapDetails(_ResumptionDetails):
    """Details of a gap: the missing range of ticks."""

    count: Annotated[int, Field(ge=1, le=LARGEST_TICK)]


class _RetentionDetails(_CheckedModel):
    """Details of an event that a retained span begins: its condition."""

    on: Text


class _RemovalDetails(_CheckedModel):
    """Details of an event that a file was removed."""

    file: Text
    size_bytes: Annotated[int, Field(ge=0)]
    reason: Text


_RECORDER_DETAILS: dict[str, type[_CheckedModel]] = {
    **dict.fromkeys(FINAL, _TotalsDetails), GAP: _GapDetails, RECORDING_FAILED: _FailureDetails,
    RECORDING_RESUMED: _ResumptionDetails, RETENTION_BEGUN: _RetentionDetails, FILE_REMOVED: _RemovalDetails,
}  # fmt: skip


class _MessageDetails(_CheckedModel):
    """Details of an event of the loop."""

    values: Annotated[list[Any], Field(min_length=MESSAGE_VALUES, max_length=MESSAGE_VALUES)]
    identity: Number
    mode: Name | None = None
    causes: list[Name] = []
    reason: Text | None = None


def parse_header(payload: bytes) -> Header:
    """Parse the header in a message of `/configuration`.

    Raises MalformedText if it is no JSON object, its format is newer than FORMAT, a field is missing or wrong, or a
    name comes twice in `axes`, `observed` or `columns`.
    """
    header = _parse_object(payload)
    number = header.get("format")
    if isinstance(number, int) and number > FORMAT:
        raise MalformedText(
            f"recording format {_shorten(number)} is newer than this version reads (up to {FORMAT}); use a newer rtloop"
        )
    _validate(_ImportedHeader if "imported" in header else _RunHeader, header)
    for key in ("axes", "observed", "columns"):
        if len(set(header[key])) < len(header[key]):
            raise MalformedText(f"{key}: {_shorten(header[key])}; allowed: each name once")
    return cast(Header, header)


def require_columns(header: Header) -> None:
    """Raise MalformedText unless the columns follow from the axes, the extras and the observed signals.

    Of imported signals, the first two columns must be tick and deadline_ns, and units must belong to columns.
    """
    if "imported" in header:
        if header["columns"][:2] != ["tick", "deadline_ns"]:
            raise MalformedText(f"columns: {_shorten(header['columns'])}; the first two must be tick and deadline_ns")
        if unknown := header["imported"]["units"].keys() - header["columns"]:
            raise MalformedText(
                f"imported.units: there is no column {_shorten(sorted(unknown))}; allowed: names of columns"
            )
        return
    axes, observed, extras = header["axes"], header["observed"], header_extras(header).columns
    expected = list(signals.column_names(axes, observed, extras))
    if header["columns"] != expected:
        version = header["versions"].get("rtloop") or "of an unknown version"
        raise MalformedText(
            f"columns: {_shorten(header['columns'])}; the recorded axes and observed signals need: "
            f"{_shorten(expected)}. The recording was made by rtloop {version}; read it with that version"
        )


def header_extras(header: Header) -> Extras:
    """Return the recorded inputs (names) and outputs (ExtraOutput) besides sensors and drives.

    Both are empty if there were none.
    """
    entries = header.get("extras", {})
    outputs = [
        ExtraOutput(**{field: output[field] for field in ExtraOutput._fields if field in output})
        for output in entries.get("outputs", ())
    ]
    return Extras(tuple(entry["name"] for entry in entries.get("inputs", ())), tuple(outputs))


def header_extra_channels(header: Header) -> dict[str, str]:
    """Return {name: channel of the driver} of the recorded inputs and outputs besides sensors and drives."""
    entries = header.get("extras", {})
    return {entry["name"]: entry["channel"] for kind in ("inputs", "outputs") for entry in entries.get(kind, ())}


def parse_event(payload: bytes, axes: Sequence[str]) -> Event:
    """Parse an event in a message of `/events` of a recording with `axes`.

    Raises MalformedText if it is no JSON object, a field is missing or wrong, axis, kind or `who` is unknown, or the
    loop could not execute the command.
    """
    event = _parse_object(payload)
    _validate(_EventModel, event)
    kind, details = event["kind"], event["what"]
    if event["axis"] is not None and event["axis"] not in axes:
        raise MalformedText(f"axis: {_shorten(event['axis'])}; allowed: null, {', '.join(axes)}")
    if (model := _RECORDER_DETAILS.get(kind)) is not None:
        if event["who"] != RECORDER:
            raise MalformedText(f"event {kind}: the field who is {_shorten(event['who'])}; allowed: {RECORDER}")
        _validate(model, details, "what.")
        return event
    if not is_kind_name(kind):
        names = ", ".join((*Kind.__members__, *Note.__members__)).lower()
        raise MalformedText(
            f"the field kind of the event is {_shorten(kind)}; allowed: {names}, or a whole number of 1 to 9 digits "
            "for a kind that this version does not know"
        )
    if not is_member_name(Origin, event["who"]) and (fault := name_problem(event["who"])):
        raise MalformedText(f"event {kind}: the field who: {fault}")
    _validate(_MessageDetails, details, "what.")
    _require_command(kind, event["axis"], [_command_value(value) for value in details["values"]])
    return event


def parse_final_event(payload: bytes, axes: Sequence[str]) -> Event | None:
    """Event in a message of `/events` if it ends a file; None for any other or a malformed event."""
    try:
        event = parse_event(payload, axes)
    except MalformedText:
        return None
    return event if event["kind"] in FINAL else None


def _require_command(kind: str, axis: str | None, values: list[float]) -> None:
    """Raise MalformedText for a command that the loop could not execute.

    load_law needs an axis; mode, generator and slot must exist; numbers of a table or an input must be whole and in
    range.
    """
    first, *parameters = values
    if kind == "load_law" and axis is None:
        raise MalformedText("event load_law: the field axis is null; allowed: the name of an axis")
    allowed_values = {"set_mode": [*Mode], "set_reference": [*Generator], "load_law": [0, 1]}.get(kind)
    if allowed_values and first not in allowed_values:
        numbers = ", ".join(f"{value:d}" for value in allowed_values)
        raise MalformedText(f"event {kind}: the first number in what.values is {first:g}; allowed: {numbers}")
    minima = {Generator.TABLE: (0, 1, 1), Generator.INPUT: (0,)}.get(first, ()) if kind == "set_reference" else ()  # type: ignore[call-overload]
    for minimum, value in zip(minima, parameters, strict=False):
        if not (value.is_integer() and minimum <= value <= LARGEST_TICK):
            raise MalformedText(
                f"event {kind}: a number in what.values is {value:g}; allowed: a whole number, {minimum} or more"
            )


def _command_value(value: object) -> float:
    """Number of a JSON value, which may be 'nan', 'inf' or '-inf'. Raises MalformedText for any other value."""
    if value in ("nan", "inf", "-inf"):
        return float(value)
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf:
        try:
            return float(value)
        except OverflowError:
            pass
    raise MalformedText(
        f"the field what.values of the event contains {_shorten(value)}; allowed: numbers, 'nan', 'inf', '-inf'"
    )


def _parse_object(payload: bytes) -> dict[str, Any]:
    """Parse a JSON object. Raises MalformedText for any other content."""
    try:
        value = pydantic_core.from_json(payload, allow_inf_nan=False)
    except ValueError:
        raise MalformedText("not JSON") from None
    if not isinstance(value, dict):
        raise MalformedText(f"the content is {_shorten(value)}; allowed: a JSON object")
    return value


def _validate(model: type[BaseModel], values: Mapping[str, object], place: str = "") -> None:
    """Raise MalformedText for the first of `values` that does not fit `model`.

    `place`, such as "what.", precedes the value's name in the message.
    """
    try:
        model.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        location = place + ".".join(str(part) for part in first["loc"])
        raise MalformedText(f"{location}: {_shorten(first['input'])}; {first['msg'].lower()}") from None


def _shorten(value: object) -> str:
    """Return a value as text of at most MAX_SHOWN_CHARACTERS characters, in ASCII but for the ellipsis."""
    text = ascii(value)
    return text if len(text) <= MAX_SHOWN_CHARACTERS else f"{text[: MAX_SHOWN_CHARACTERS - 1]}…"
