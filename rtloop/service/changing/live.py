"""Changes to a law that runs: built and verified beside the loop, staged in shared memory, swapped at one tick."""

from __future__ import annotations

import threading
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from rtloop.configuration.axis import AxisOptions, ReferenceOptions
from rtloop.configuration.file import Configuration, describe, shared_faults
from rtloop.configuration.laws import Library
from rtloop.configuration.prepare import Prepared
from rtloop.configuration.references import TableOfSamples, extent, generator_values, table_values, volts
from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import Kind
from rtloop.engine.ring import drain
from rtloop.errors import ConfigError, RtloopError
from rtloop.law.reference import Generator
from rtloop.law.safety import USABLE_MAGNITUDE
from rtloop.service.changing.building import figures_limited, prepare_limited
from rtloop.service.changing.changes import Change, Changes
from rtloop.service.changing.preview import Figures
from rtloop.service.desk import Desk, Refused, Taken
from rtloop.signals import MODE, Mode

FIXED = ("loop", "driver_kind", "driver_options", "channels", "inputs", "outputs")
"""Parts of a configuration that only a restart can change."""
OTHER_AXES = "controller.axes: which axes share a controller changed, which needs a restart"
SECTIONS = ("controller", "limits", "interlocks", "prefilter", "model")
"""Of an axis, that may be tuned."""


class LiveLaw:
    """The law as it runs now, and the ways to change it. Thread-safe.

    `offsets_v` are the readings at position 0 of the axes that were tared, which no other change may undo.
    """

    def __init__(self, prepared: Prepared, block: SharedBlock, desk: Desk, offsets_v: dict[int, float]) -> None:
        self.prepared = prepared
        self.offsets_v = offsets_v
        self._block, self._desk = block, desk
        self._lock = threading.Lock()
        self._building = threading.Lock()
        """Held while another law is built and verified: references do not wait for that."""
        self._first_spare = prepared.plan.table.size
        self._places = [0] * len(prepared.plan.axes)
        self._unsettled_tick: int | None = None
        self._playing = [(int(one["kind"]), float(one["parameters"][0])) for one in prepared.plan.generators]
        self._changes = Changes()
        self._figures: dict[int, tuple[Configuration, Figures]] = {}
        """Of axes as a configuration had them."""
        self.references_set = [0] * len(prepared.plan.axes)
        """How often each axis was given another reference."""

    @property
    def as_it_runs(self) -> dict[str, Any]:
        """The configuration as plain values, with what was tuned since, and the folder that its files are in."""
        configuration = self.prepared.configuration
        values = tomllib.loads(configuration.text)
        values["axis"] = [axis.model_dump(mode="json", exclude_unset=True) for axis in configuration.axes]
        return {"folder": str(configuration.folder.resolve()), "values": values}

    def axis_number(self, name: str) -> int:
        """Raises ConfigError for a name that is no axis."""
        if name not in self.prepared.plan.axes:
            raise _unsuitable(f"axis {name!r}: there are {', '.join(self.prepared.plan.axes)}")
        return self.prepared.plan.axes.index(name)

    def tune(self, axis: str, section: str, changes: Mapping[str, Any]) -> int:
        """Change keys of [axis.SECTION]; returns the tick. Raises ConfigError, Refused."""
        with self._building:
            return self._change(*self._tuned(axis, section, changes), f"{section}: {', '.join(changes)}")

    def load_controller(self, axis: str, controller: Mapping[str, Any]) -> int:
        """Swap [axis.controller] as a whole; returns the tick. Raises ConfigError, Refused."""
        with self._building:
            return self._change(*self._with_controller(self.axis_number(axis), controller, keep=False), "controller")

    def preview(self, axis: str, section: str, changes: Mapping[str, Any]) -> dict[str, Figures]:
        """Figures of the loop as it is, and as `tune` would make it; changes nothing. Raises ConfigError, Refused."""
        with self._building:
            number, configuration = self.axis_number(axis), self.prepared.configuration
            changed = self._configured(*self._tuned(axis, section, changes))
            if (known := self._figures.get(number)) is None or known[0] is not configuration:
                known = self._figures[number] = configuration, figures_limited(configuration, number)
            return {"before": known[1], "after": figures_limited(changed, number)}

    def undo(self, axis: str) -> tuple[int, str]:
        """Go back to before the last change of an axis, or of the controller that it shares; the tick, and what that
        change was. Raises ConfigError, and Refused where nothing was changed.
        """
        with self._building:
            number, configuration = self.axis_number(axis), self.prepared.configuration
            change = self._changes.last((number, configuration.owners[number]))
            if change is None:
                raise Refused(f"undo: axis {axis} was not changed since the loop started, or since a reload")
            reference = configuration.axes[change.number].reference
            tick = self._swap(change.number, change.before.model_copy(update={"reference": reference}))
            self._changes.forget(change)
            return tick, change.what

    def _change(self, number: int, axis: AxisOptions, what: str) -> int:
        """As `_swap`, and it can be undone."""
        change = Change(number, self.prepared.configuration.axes[number], what)
        try:
            tick = self._swap(number, axis)
        except Taken:
            self._changes.note(change)
            raise
        self._changes.note(change)
        return tick

    def _tuned(self, axis: str, section: str, changes: Mapping[str, Any]) -> tuple[int, AxisOptions]:
        """The axis whose section it is, with the changes. Raises ConfigError."""
        number = self.axis_number(axis)
        if section not in SECTIONS:
            raise _unsuitable(f"section {section!r}: {', '.join(SECTIONS)} may change")
        if section == "controller":
            return self._with_controller(number, changes, keep=True)
        merged = self.prepared.configuration.axes[number].model_dump(exclude_unset=True)
        merged[section] = {**(merged.get(section) or {}), **changes}
        return number, self._validated_axis(merged)

    def _with_controller(self, number: int, controller: Mapping[str, Any], keep: bool) -> tuple[int, AxisOptions]:
        """The axis that has the controller of axis `number`, with another one; `keep` what is not said."""
        configuration = self.prepared.configuration
        owner = configuration.owners[number]
        merged = configuration.axes[owner].model_dump(exclude_unset=True)
        merged["controller"] = {**((merged.get("controller") or {}) if keep else {}), **controller}
        return owner, self._validated_axis(merged)

    def set_reference(self, axis: str, reference: Mapping[str, Any]) -> int:
        """Change the generator of an axis; returns the tick. Raises ConfigError, Refused."""
        try:
            options = TypeAdapter(ReferenceOptions).validate_python(dict(reference))
        except ValidationError as error:
            raise ConfigError("reference", describe(error, "reference", reference)) from None
        values, samples = self._generator(options)
        with self._lock:
            return self._play(self.axis_number(axis), values, samples)

    def set_waveform(self, axis: str, samples: np.ndarray[Any, Any], hold_ticks: int, repeat: bool) -> int:
        """Play samples (n, 1 or 2), `hold_ticks` ticks each; returns the tick. Raises ConfigError, Refused.

        The second column is added to the command.
        """
        if samples.size == 0 or not np.all(np.abs(samples) < USABLE_MAGNITUDE):
            raise _unsuitable(f"waveform: {len(samples)} samples; at least one, and finite numbers only, are needed")
        table = TableOfSamples()
        values = list(table_values(samples, hold_ticks, repeat, table))
        with self._lock:
            return self._play(self.axis_number(axis), values, table.samples)

    def play_raw(self, number: int, volts: np.ndarray[Any, Any]) -> int:
        """Play `volts` (n,) once, for raw mode; returns the tick. Raises Refused."""
        with self._lock:
            return self._submit_table(number, [Generator.TABLE, 0, volts.size, 1.0, 0.0], volts)

    def restore_reference(self, number: int) -> int:
        """The reference that the configuration gives; returns the tick."""
        generator = self.prepared.plan.generators[number]
        return self._submit_reference(number, [float(generator["kind"]), *generator["parameters"].tolist()])

    def held(self, number: int) -> float:
        """The constant that is the reference of an axis. Raises Refused where it is none."""
        kind, value = self._playing[number]
        if kind != Generator.HOLD:
            name, is_one = self.prepared.plan.axes[number], Generator(kind).name.lower()
            raise Refused(f"reference of axis {name}: a {is_one}; a hold is needed: `rtloop ctl setpoint {name} VALUE`")
        return value

    def tare(self, number: int, offset_v: float) -> int:
        """Make `offset_v` the reading at position 0; returns the tick."""
        with self._lock:
            self.offsets_v[number] = offset_v
            return self._stage(number, self.prepared, self.prepared.configuration.axes[number])

    def replace_all(self, prepared: Prepared) -> list[str]:
        """Take over another configuration; what changed. Raises Refused where that needs a restart."""
        with self._building, self._lock:
            old, new = self.prepared.configuration, prepared.configuration
            fixed = [part for part in FIXED if getattr(old, part) != getattr(new, part)]
            if fixed or prepared.plan.axes != self.prepared.plan.axes:
                raise Refused(f"{', '.join(fixed) or 'axes'}: changed, which needs a restart")
            if old.owners != new.owners:
                raise Refused(OTHER_AXES)
            pairs = list(enumerate(zip(old.axes, new.axes, strict=True)))
            for _, (before, after) in pairs:
                if before.feedforward != after.feedforward:
                    raise Refused(f"axis.{after.name}.feedforward: changed, which needs a restart")
            references = {n: self._generator(after.reference) for n, (before, after) in pairs
                          if before.reference != after.reference}  # fmt: skip
            changed: list[str] = []
            try:
                for number, (before, after) in pairs:
                    law = after.model_copy(update={"reference": before.reference})
                    if law != before:
                        self._stage(number, prepared, law)
                        changed.append(f"axis.{after.name}")
                for number, (values, samples) in references.items():
                    self._play(number, values, samples)
                    self._note(number, prepared, new.axes[number])
                    changed.append(f"axis.{new.axes[number].name}")
            except RtloopError as error:
                if not changed:
                    raise
                faults = error.faults if isinstance(error, ConfigError) else [str(error)]
                raise Refused("; ".join([*faults, f"changed already: {', '.join(dict.fromkeys(changed))}"])) from None
            self.prepared = prepared
            if changed:
                self._changes.forget()
            return list(dict.fromkeys(changed))

    def _note(self, number: int, prepared: Prepared, axis: AxisOptions) -> None:
        """The loop has taken an axis of `prepared`, with those that share its controller, and of what that axis does
        `axis` is true; the others are as they were.
        """
        coefficients = np.asarray(self.prepared.plan.coefficients).copy()
        configuration = self.prepared.configuration
        for i in prepared.configuration.together(number):
            coefficients[i] = np.asarray(prepared.plan.coefficients)[i]
            beside = {"reference": configuration.axes[i].reference}
            options = axis if i == number else prepared.configuration.axes[i].model_copy(update=beside)
            configuration = _with_axis(configuration, i, options)
        self.prepared = replace(
            self.prepared, configuration=configuration, plan=replace(self.prepared.plan, coefficients=coefficients)
        )

    def _validated_axis(self, raw: Mapping[str, Any]) -> AxisOptions:
        """An axis with the laws that the loop has loaded. Raises ConfigError."""
        configuration = self.prepared.configuration
        library = Library(configuration.folder, configuration.laws)
        try:
            return AxisOptions.model_validate(raw, context={"library": library})
        except ValidationError as error:
            raise ConfigError("change", describe(error, f"axis.{raw['name']}", raw)) from None

    def _swap(self, number: int, axis: AxisOptions) -> int:
        """Build the configuration with another axis, verify it, swap its coefficients."""
        prepared = prepare_limited(self._configured(number, axis))
        with self._lock:
            return self._stage(number, prepared, axis)

    def _configured(self, number: int, axis: AxisOptions) -> Configuration:
        """The configuration with another axis. Raises ConfigError, and Refused for what needs a restart."""
        configuration = self.prepared.configuration
        if axis.feedforward != configuration.axes[number].feedforward:
            raise Refused("feedforward: the actuator's memory belongs to it; change it and restart")
        changed = _with_axis(configuration, number, axis)
        if faults := shared_faults(changed.axes):
            raise ConfigError("change", faults)
        if changed.owners != configuration.owners:
            raise Refused(OTHER_AXES)
        return changed

    def _stage(self, number: int, prepared: Prepared, axis: AxisOptions) -> int:
        """Copy coefficients to where the loop takes them from, have it take them; note `axis`. Raises Taken, too.

        Axes that share a controller are taken together, by the number of the first, where that one changes.
        """
        whole, now = np.asarray(prepared.plan.coefficients), np.asarray(self.prepared.plan.coefficients)
        first, *others = prepared.configuration.together(number)
        before, after = self.prepared.configuration.axes[first], prepared.configuration.axes[first]
        if number != first and whole[first].tobytes() == now[first].tobytes():
            first, others = number, []
        coefficients = whole[first : first + 1 + len(others)].copy()
        for place, i in enumerate((first, *others)):
            coefficients["offset_v"][place] = self.offsets_v.get(i, float(coefficients["offset_v"][place]))
        begin = first * coefficients.dtype.itemsize
        self._require_settled()
        self._block["staged"][begin : begin + coefficients.nbytes] = np.frombuffer(coefficients.tobytes(), np.uint8)
        another = before.controller != after.controller
        try:
            tick = self._settling(Kind.LOAD_LAW, first, [float(another)])
        except Taken:
            self._note(number, prepared, axis)
            raise
        self._note(number, prepared, axis)
        return tick

    def _require_settled(self) -> None:
        """Raise Refused while the loop may still take what was staged before."""
        if self._unsettled_tick is not None and int(self._block["ticks_head"][0]) <= self._unsettled_tick + 1:
            raise Refused("an earlier change has been taken by the loop, which stands still")
        self._unsettled_tick = None

    def _settling(self, kind: Kind, number: int, values: list[float]) -> int:
        """Submit what refers to shared memory, which must not change before the loop has read it. Raises Taken."""
        try:
            return self._desk.submit(kind, axis=number, values=values)
        except Taken:
            self._unsettled_tick = int(self._block["ticks_head"][0])
            raise

    def _generator(self, options: ReferenceOptions) -> tuple[list[Any], np.ndarray[Any, Any]]:
        """Kind and parameters of a generator, and the samples of its table. Raises ConfigError."""
        table, configuration = TableOfSamples(), self.prepared.configuration
        facts, rate_hz = self.prepared.facts, configuration.loop.rate_hz
        try:
            return list(generator_values(options, rate_hz, facts.inputs, configuration.folder, table)), table.samples
        except ValueError as error:
            raise ConfigError("reference", [f"reference.{error}"]) from None

    def _play(self, number: int, values: list[Any], samples: np.ndarray[Any, Any]) -> int:
        """Have a generator take over; its table's samples go where the loop finds them. Raises ConfigError, Refused."""
        limits = self.prepared.configuration.axes[number].limits
        lowest, highest = extent(values, samples)
        if self._in_raw_mode():
            if not limits.lowest_v <= lowest <= highest <= limits.drive_v:
                allowed = f"{limits.lowest_v:g} V … {limits.drive_v:g} V (limits.drive_v), and mode raw takes volts"
                raise _unsuitable(f"reference: {volts(lowest, highest)}, beyond the axis's {allowed}")
        elif not (most := max(-lowest, highest)) <= limits.command_um:
            limit = limits.command_um
            raise _unsuitable(f"reference: reaches {most:g}, beyond the axis's ±{limit:g} (limits.command_um)")
        if samples.size:
            return self._submit_table(number, values, samples)
        return self._submit_reference(number, [float(value) for value in values])

    def _submit_reference(self, number: int, values: list[float], *, table: bool = False) -> int:
        """Have a generator take over, and note which one it is."""
        self.references_set[number] += 1
        if table:
            tick = self._settling(Kind.SET_REFERENCE, number, values)
        else:
            tick = self._desk.submit(Kind.SET_REFERENCE, axis=number, values=values)
        self._playing[number] = int(values[0]), values[1]
        return tick

    def _in_raw_mode(self) -> bool:
        ring = self._block.ring("ticks")
        rows = np.empty((1, ring.slots.shape[1]))
        copied, _, _ = drain(ring, max(int(ring.head[0]) - 1, 0), rows)
        return copied == 1 and rows[0, MODE] == Mode.RAW

    def _submit_table(self, number: int, values: list[Any], samples: np.ndarray[Any, Any]) -> int:
        """Play `samples` from the one of the axis's two places in the shared table that does not play now."""
        self._require_settled()
        table, fixed, axes = self._block["table"], self._first_spare, len(self.prepared.plan.axes)
        room = (table.size - fixed) // (2 * axes)
        if samples.size > room:
            raise _unsuitable(f"waveform: {samples.size} samples; at most {room} are allowed")
        place = 1 - self._places[number]
        values[1] = fixed + (2 * number + place) * room
        table[values[1] : values[1] + samples.size] = samples
        tick = self._submit_reference(number, [float(value) for value in values], table=True)
        self._places[number] = place
        return tick


def _unsuitable(message: str) -> ConfigError:
    """The error of a request that could be granted in no state."""
    return ConfigError("request", [message])


def _with_axis(configuration: Configuration, number: int, axis: AxisOptions) -> Configuration:
    axes = list(configuration.axes)
    axes[number] = axis
    return replace(configuration, axes=tuple(axes))
