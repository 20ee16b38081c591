"""The configuration file: TOML, checked as a whole. Every fault is reported at once: key, value, allowed range.

[loop]  [driver]  [driver.channels.AXIS]  [inputs]  [outputs]  [[axis]]  [[schedule]]  [recording]  [service]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.extras import NAME, ExtraInputOptions, ExtraOutputOptions, extra_faults
from rtloop.configuration.laws import DEFAULT_LAWS, Library, names_own_laws
from rtloop.configuration.recording import RecordingOptions
from rtloop.configuration.schedule import ModeName, ScheduleOptions, setpoint_faults
from rtloop.configuration.service import ServiceOptions
from rtloop.configuration.text_files import parse_toml, read_text
from rtloop.drivers.base import Wiring
from rtloop.drivers.errors import DriverError
from rtloop.drivers.registry import driver_class, kinds
from rtloop.errors import ConfigError
from rtloop.foundation.options import LARGEST_INTEGER, Options
from rtloop.kernel.layout import MAX_LAWS
from rtloop.laws.contract import ANY_NUMBER
from rtloop.laws.limited.trial import needs_limited_process, try_limited
from rtloop.laws.registry import LawReference, law_class

HIGHEST_RATE_HZ = 1e6
MAX_LATENESS_SAMPLES = 4096
LARGEST_LATENESS_US = 1e6
"""Largest simulated lateness of a tick: it bounds the time that the rig needs for the periods missed by one tick."""
SPECIFICATION = (
    "this file is a specification; give a configuration, a file with [loop], [driver] and [[axis]]. Specifications "
    "are for `rtloop design synthesise`, `rtloop design robust` and the options --spec and --specs"
)
MAX_FAULTS, MAX_CHARACTERS = 40, 400
"""Faults shown of one text, and characters shown of each fault."""


class LoopOptions(Options):
    """Rate, mode and scheduling of the loop."""

    rate_hz: float = Field(gt=0, le=HIGHEST_RATE_HZ)
    """Ticks per second; laws are discretised for the period 1/`rate_hz`."""
    mode: ModeName = "closed_loop"
    """Mode of the first tick of the loop."""
    spin_us: float = Field(default=0.0, ge=0, le=1e6)
    """Spin instead of sleep for the last microseconds before a deadline."""
    priority: int = Field(default=80, ge=1, le=99)
    """Priority of the loop's process under SCHED_FIFO, in real time; where the host refuses it, the loop runs without,
    unless `require_realtime` is true."""
    cpu: int | None = Field(default=None, ge=0)
    """Number of the processor to which the loop is pinned; by default the system chooses."""
    require_realtime: bool = False
    """Refuse to start where SCHED_FIFO or locked memory is not granted."""
    enable_input: str | None = None
    """Input channel of an enable or emergency-stop switch; its threshold is [axis.interlocks] enable_min_v."""
    heartbeat_timeout_s: float = Field(default=1.0, gt=0)
    """Silence of the supervisor after which the loop parks itself."""
    hold_input: str | None = None
    """An input of [inputs] that holds the references: they stand still while it is high, or low by `hold_while`."""
    hold_min_v: float = 2.5
    """Voltage from which on `hold_input` is high."""
    hold_while: Literal["high", "low"] = "high"
    """State of `hold_input` in which references stand still. With "low", a gate that goes high starts them."""
    simulated_lateness_us: Annotated[
        tuple[Annotated[float, Field(ge=0, le=LARGEST_LATENESS_US)], ...],
        Field(strict=False, max_length=MAX_LATENESS_SAMPLES),
    ] = ()
    """Delays of the ticks in virtual time: each tick is late by one of them, drawn at random with equal probability."""
    laws: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Further laws, kinds or files, loaded so that they may be swapped in while the loop runs."""


class ChannelOptions(Options):
    """Channels and scale of an axis: position in µm = (volts − offset) · um_per_v."""

    input: str
    """Name of the driver's input channel to which the axis's sensor is wired, such as `adc0`."""
    output: str
    """Name of the driver's output channel to which the axis's amplifier is wired, such as `dac0`."""
    um_per_v: float
    """Scale of the sensor: displacement per volt of the reading; negative for a sensor that is reversed."""
    offset: float = 0.0
    """Reading in V at position 0; `rtloop serve` measures it instead where [service] `tare_s` is above 0."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Require um_per_v other than 0."""
        if self.um_per_v == 0:
            raise ValueError("um_per_v: 0; allowed: any other number")
        return self


class FileOptions(Options):
    """Sections of the file, without [driver]."""

    loop: LoopOptions
    """Rate of the loop, mode of its first tick, and its scheduling by the host."""
    axis: Annotated[tuple[AxisOptions, ...], Field(strict=False, min_length=1)]
    """The controlled axes, at least one; a recording has their signals in the same order."""
    inputs: dict[Annotated[str, Field(pattern=NAME)], ExtraInputOptions] = {}  # noqa: RUF012
    """Channels that are read besides the sensors, each by the name that laws and recordings use."""
    outputs: dict[Annotated[str, Field(pattern=NAME)], ExtraOutputOptions] = {}  # noqa: RUF012
    """Channels that controllers set besides the drives, each by the name that laws and recordings use."""
    schedule: Annotated[tuple[ScheduleOptions, ...], Field(strict=False)] = ()
    """Changes of mode and reference at given ticks; changes at one tick take effect in the file's order."""
    recording: RecordingOptions = RecordingOptions.of_absent_table()
    """Place, size and contents of the recordings; by default every tick is recorded."""
    service: ServiceOptions = ServiceOptions.of_absent_table()
    """Settings of `rtloop serve`: control socket, restarts, preparation of the actuator."""


@dataclass(frozen=True)
class Configuration:
    """A configuration whose parts are valid one by one; `rtloop.configuration.prepare` checks that they fit."""

    name: str
    source: str
    """The file, or another origin of the text, for messages."""
    folder: Path
    text: str
    loop: LoopOptions
    axes: tuple[AxisOptions, ...]
    schedule: tuple[ScheduleOptions, ...]
    recording: RecordingOptions
    service: ServiceOptions
    driver_kind: str
    driver_options: Options
    channels: Mapping[str, ChannelOptions]
    inputs: Mapping[str, ExtraInputOptions] = field(default_factory=dict)
    outputs: Mapping[str, ExtraOutputOptions] = field(default_factory=dict)
    laws: tuple[LawReference, ...] = DEFAULT_LAWS
    """All laws that the loop loads, in an order that does not depend on where they are used."""

    @cached_property
    def owners(self) -> tuple[int, ...]:
        """Number of the axis whose controller controls an axis, for each axis in turn: its own number, unless it shares
        the controller of an earlier axis."""
        owner_numbers: list[int] = []
        for number, axis in enumerate(self.axes):
            owner = number if axis.controller or not owner_numbers else owner_numbers[-1]
            controller = self.axes[owner].controller
            owner_numbers.append(owner if controller and axis.name in controller.axes else number)
        return tuple(owner_numbers)

    def axes_sharing(self, number: int) -> tuple[int, ...]:
        """Return the numbers, rising, of the axes that share the controller of axis `number`, itself included."""
        return tuple(i for i, owner in enumerate(self.owners) if owner == self.owners[number])

    @property
    def wiring(self) -> dict[str, Wiring]:
        """Names of the input and output channel of each axis, by the axis's name, in the order of the axes."""
        return {
            axis.name: Wiring(self.channels[axis.name].input, self.channels[axis.name].output) for axis in self.axes
        }


def load(path: str | Path, name: str | None = None) -> Configuration:
    """Read and check a TOML file. `name` replaces the stem of the file's name as the configuration's name.

    Laws that it names and that do not ship are run first in the limited process, which is killed if a law does not
    return, then in this one. Raises InputFileError if the file cannot be read, else ConfigError with all faults.
    """
    path = Path(path)
    return parse(read_text(path), name or path.stem, path.parent, str(path))


def parse(text: str, name: str, folder: Path, source: str, library: Library | None = None) -> Configuration:
    """Check a configuration's text. Relative paths, also of laws without a `library`, start at `folder`.

    `source` names the text in messages. `library` is the source of laws; None: shipped and installed ones, and files.
    A text that names user laws is checked first in the limited process, as checking runs their files.
    Raises ConfigError with all faults.
    """
    try:
        raw = parse_toml(text)
    except ValueError as error:
        raise ConfigError(source, [str(error)]) from None
    if names_own_laws(raw) if library is None else needs_limited_process(library.loaded or ()):
        try_limited(source, parse, text, name, folder, source, library)
    if "specification" in raw and raw.keys().isdisjoint(("loop", "driver", "axis")):
        raise ConfigError(source, [SPECIFICATION])
    driver = raw.pop("driver", None)
    faults: list[str] = []
    library = library or Library(folder)
    sections = _validated(FileOptions, raw, "", faults, {"library": library})
    laws = () if sections is None else _laws(sections, library, faults)
    kind, options, channels = _driver(driver, folder, faults)
    if sections is not None:
        faults += _cross_faults(sections, channels)
    if faults or sections is None or options is None:
        raise ConfigError(source, faults)
    return Configuration(
        name=name,
        source=source,
        folder=folder,
        text=text,
        loop=sections.loop,
        axes=sections.axis,
        schedule=sections.schedule,
        recording=sections.recording,
        service=sections.service,
        driver_kind=kind,
        driver_options=options,
        channels=channels,
        inputs=sections.inputs,
        outputs=sections.outputs,
        laws=laws,
    )


def _laws(sections: FileOptions, library: Library, faults: list[str]) -> tuple[LawReference, ...]:
    """Return all laws that the loop loads, each once: DEFAULT_LAWS, used or not, then the others, sorted.

    The others are the laws of the axes and the spare laws of [loop] laws. Appends to `faults` for a spare law that
    `library` lacks or that no controller could use, and for more than MAX_LAWS.
    """
    references = {options.law for axis in sections.axis for options in (axis.feedforward, axis.controller) if options}
    coupled_counts = {len(axis.controller.axes) for axis in sections.axis if axis.controller} - {0, 1}
    for name in sections.loop.laws:
        try:
            law = library.find({"file" if name.endswith(".py") else "kind": name}, name)
        except ValueError as error:
            faults.append(f"loop.laws: {error}")
            continue
        axis_counts = coupled_counts if law_class(law).axes == ANY_NUMBER else {0}
        if not axis_counts:
            faults.append(f"loop.laws: {law.kind!r} is for several axes, but each controller of this file has one axis")
        references |= {replace(law, axes=count) for count in axis_counts}
    laws = (*DEFAULT_LAWS, *sorted(references - {None, *DEFAULT_LAWS}))
    if len(laws) > MAX_LAWS:
        faults.append(f"loop.laws: {len(laws)} laws; allowed: up to {MAX_LAWS}")
    return laws


def _driver(raw: object, folder: Path, faults: list[str]) -> tuple[str, Options | None, dict[str, ChannelOptions]]:
    """Return kind, options and channels of [driver]; append a line for each fault to `faults`.

    The options are None if they are wrong, or if the driver is unknown or cannot be imported. A missing kind is "".
    Wrong channels are returned as the file's tables, by name. Relative paths start at `folder`, where the driver's
    options ask for it.
    """
    if not isinstance(raw, dict):
        faults.append("driver: missing; needs a section [driver] with kind and channels")
        return "", None, {}
    options = dict(raw)
    kind, channel_tables = options.pop("kind", None), options.pop("channels", {})
    channels = _validated(dict[str, ChannelOptions], channel_tables, "driver.channels", faults)
    if channels is None and isinstance(channel_tables, dict):
        channels = channel_tables  # their names are known all the same
    if not isinstance(kind, str):
        faults.append(f"driver.kind: {'missing' if kind is None else repr(kind)}; allowed: {', '.join(kinds())}")
        return "", None, channels or {}
    try:
        model = driver_class(kind).options_model
    except (ValueError, DriverError) as error:
        faults.append(f"driver.kind: {error}")
        return kind, None, channels or {}
    return kind, _validated(model, options, "driver", faults, {"folder": folder}), channels or {}


@cache
def type_adapter(kind: Any) -> TypeAdapter[Any]:
    """Return pydantic's adapter of a type; the same one at every call, so that its validator is built once."""
    return TypeAdapter(kind)


def _validated(kind: Any, raw: object, prefix: str, faults: list[str], context: dict[str, object] | None = None) -> Any:
    """Return the value `raw` of key `prefix`, validated as type `kind`; None, with faults appended, if invalid."""
    adapter = type_adapter(kind)
    try:
        return adapter.validate_python(raw, context=context)
    except ValidationError as error:
        faults += describe(error, prefix, raw, _keys(adapter.json_schema()))
        return None


def describe(error: ValidationError, prefix: str, raw: object, known_keys: set[str] | None = None) -> list[str]:
    """Return a line for each fault in `error`, raised for `raw`, the value of key `prefix`; `raw` None: not available.

    Beyond MAX_FAULTS, a last line says how many more there are. `known_keys` are suggested for an unknown key that
    resembles one; with None, only missing required keys beside it are.
    """
    errors = error.errors(include_url=False)
    # A list that is too short only because entries are faulty is reported by the faults of its entries.
    details = [detail for detail in errors if not (detail["type"] == "too_short" and detail["input"])] or errors
    omission = [f"and {len(details) - MAX_FAULTS} more faults"] if len(details) > MAX_FAULTS else []
    missing = [detail["loc"] for detail in details if detail["type"] == "missing"]
    faults = []
    for detail in details[:MAX_FAULTS]:
        missing_beside = [str(loc[-1]) for loc in missing if loc[:-1] == detail["loc"][:-1]]
        faults.append(_shorten(_fault(detail, prefix, raw, known_keys or set(), missing_beside)))
    return faults + omission


def _keys(schema: object) -> set[str]:
    """Return all keys that a JSON schema knows, at any depth."""
    if isinstance(schema, list):
        return set().union(*map(_keys, schema))
    if not isinstance(schema, dict):
        return set()
    return set(schema.get("properties", ())).union(*map(_keys, schema.values()))


def _fault(detail: Any, prefix: str, raw: object, known_keys: set[str], missing_beside: Sequence[str]) -> str:
    """Return one error of pydantic, `detail`, as key, value and allowed values; other parameters as in `describe`.

    `missing_beside` are required keys that the table of the faulty key lacks; an unknown key is compared with these
    first.
    """
    path = [prefix] if prefix else []
    node = raw
    for part in detail["loc"]:
        is_element = isinstance(node, list) and isinstance(part, int) and part < len(node)
        is_present = is_element or (isinstance(node, dict) and part in node)
        if is_present and isinstance(node, dict | list):
            node = node[part]  # type: ignore[index]
            name = node.get("name") if isinstance(part, int) and isinstance(node, dict) else None
            path.append(str(name if isinstance(name, str) else part))
        elif raw is None or (detail["type"] in ("missing", "extra_forbidden") and part == detail["loc"][-1]):
            path.append(str(part))
    key = ".".join(path)
    if detail["type"] == "missing":
        return f"{key}: missing; this key is required"
    if detail["type"] == "extra_forbidden":
        beside = [*missing_beside, *detail.get("ctx", {}).get("keys", ())]
        suggestion = _resembling(path[-1], beside)
        if path[-1] in known_keys and not suggestion:
            return f"{key}: unknown key in this table; {path[-1]} belongs in another table"
        suggestion = suggestion or _resembling(path[-1], sorted(known_keys))
        return f"{key}: unknown key" + (f"; did you mean {suggestion}?" if suggestion else "")
    if detail["type"] == "union_tag_invalid":
        tag = detail["ctx"]["tag"]
        return f"{key}.kind: {repr(tag) if tag else 'missing'}; allowed: {detail['ctx']['expected_tags']}"
    if detail["type"] == "tuple_type" and isinstance(detail["input"], dict):
        return f"{key}: a single table; allowed: a list of tables, each with the heading [[{key}]]"
    message = detail["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    if not key:  # a fault between several keys, whose message names them
        return message
    value = detail["input"]
    value_text = f" {_format_value(value)}:" if isinstance(value, str | int | float | bool) else ""
    return f"{key}:{value_text} {message if value_text else message[0].lower() + message[1:]}"


def _resembling(key: str, known_keys: Sequence[str]) -> str:
    """Return the known key that a wrong one resembles, first one that only adds a unit to it; "" for none."""
    from difflib import get_close_matches

    with_unit = [known for known in known_keys if known.startswith(f"{key}_")]
    return next(iter(with_unit or get_close_matches(key, known_keys, n=1)), "")


def _format_value(value: object) -> str:
    """Return the value as Python writes it, True for true, or a note in place of a very long integer."""
    return "a very long integer" if isinstance(value, int) and abs(value) > LARGEST_INTEGER else repr(value)


def _shorten(fault: str) -> str:
    """Return the first MAX_CHARACTERS of a fault, with "…" behind them if it is longer."""
    return fault if len(fault) <= MAX_CHARACTERS else f"{fault[:MAX_CHARACTERS]}…"


def shared_faults(axes: Sequence[AxisOptions]) -> list[str]:
    """Return a line for each controller whose `axes` are not its own axis and the axes that follow it.

    Also a line for each of its further axes that has a controller.
    """
    names, faults = [axis.name for axis in axes], list[str]()
    for number, axis in enumerate(axes):
        controller_axes = axis.controller.axes if axis.controller else ()
        key_text = f"axis.{axis.name}.controller.axes: {', '.join(controller_axes)}"
        adjacent = tuple(names[number : number + max(len(controller_axes), 1)])
        if controller_axes and controller_axes != adjacent:
            faults.append(
                f"{key_text}; allowed: {', '.join(adjacent)}, in the order of the file: the controller's own axis, "
                "then the axes that follow it"
            )
        for other_axis in axes[number + 1 : number + len(controller_axes)]:
            if other_axis.controller:
                faults.append(
                    f"{key_text}; but axis {other_axis.name} has a controller of its own; remove that "
                    f"controller, or remove {other_axis.name} from axes"
                )
    return faults


def _cross_faults(sections: FileOptions, channels: Mapping[str, ChannelOptions]) -> list[str]:
    """Return a line for each fault between sections: a name that is missing, unknown or used twice, wrong axes of a
    shared controller, a constant reference that is refused, an entry of the schedule that equals an earlier one.
    """
    names = [axis.name for axis in sections.axis]
    faults = [
        f"axis.{name}: two axes have this name; rename one of them"
        for name in sorted(set(names))
        if names.count(name) > 1
    ]
    faults += [
        f"driver.channels.{name}: missing; the axis needs input, output, um_per_v"
        for name in names
        if name not in channels
    ]
    faults += [
        f"driver.channels.{name}: there is no axis of this name; the axes are {', '.join(names)}"
        for name in channels
        if name not in names
    ]
    faults += setpoint_faults(sections.axis, sections.loop.mode, sections.schedule)
    faults += shared_faults(sections.axis)
    faults += extra_faults(sections.inputs, sections.outputs, sections.loop.hold_input, sections.axis)
    for entry in sections.schedule:
        if entry.axis is not None and entry.axis not in names:
            faults.append(f"schedule.axis: {entry.axis!r} is not an axis; the axes are {', '.join(names)}")
    for i, entry in enumerate(sections.schedule):
        if entry in sections.schedule[:i]:
            faults.append(f"schedule, at_tick {entry.at_tick}: two equal entries; remove one of them")
    return faults
