"""Changes to a law that runs: built and verified beside the loop, staged in shared memory, swapped at one tick."""

from __future__ import annotations

import threading
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from pydantic import ValidationError

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration, describe, shared_faults
from rtloop.configuration.laws import Library
from rtloop.configuration.prepare import Prepared
from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import Kind
from rtloop.errors import ConfigError, RtloopError
from rtloop.laws.limited.trial import needs_limited_process, try_limited
from rtloop.service.changing.building import figures_limited, prepare_limited
from rtloop.service.changing.change_history import Change, Changes
from rtloop.service.changing.differences import differences
from rtloop.service.changing.preview import Figures, running_check, step_end_ms, with_longer_step
from rtloop.service.changing.references import LiveReferences, axis_number, unsuitable
from rtloop.service.changing.staging import Staging
from rtloop.service.desk import Desk, Refused, Taken

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
        self._staging = Staging(block, desk)
        self.references = LiveReferences(lambda: self.prepared, self._staging)
        self._building = threading.Lock()
        """Held while another law is built and verified: references do not wait for that."""
        self._changes = Changes()
        self._figures: dict[int, tuple[Configuration, Figures]] = {}
        """Of axes as a configuration had them."""

    @property
    def as_it_runs(self) -> dict[str, Any]:
        """The configuration as plain values, with what was tuned since, and the folder that its files are in."""
        configuration = self.prepared.configuration
        values = tomllib.loads(configuration.text)
        values["axis"] = [axis.model_dump(mode="json", exclude_unset=True) for axis in configuration.axes]
        return {"folder": str(configuration.folder.resolve()), "values": values}

    def axis_number(self, name: str) -> int:
        """Raises ConfigError for a name that is no axis."""
        return axis_number(self.prepared, name)

    def change_of(self, identity: int) -> str | None:
        """The change that a command made, in words, by the `identity` of its event; None where it is not known."""
        return self._staging.desk.change_of(identity)

    def tune(self, axis: str, section: str, changes: Mapping[str, Any]) -> int:
        """Change keys of [axis.SECTION]; returns the tick. Raises ConfigError, Refused."""
        with self._building:
            return self._change(*self._tuned(axis, section, changes), f"{section}: {', '.join(changes)}")

    def load_controller(self, axis: str, controller: Mapping[str, Any]) -> int:
        """Swap [axis.controller] as a whole; returns the tick. Raises ConfigError, Refused."""
        with self._building:
            return self._change(*self._with_controller(self.axis_number(axis), controller, keep=False), "controller")

    def preview(self, axis: str, section: str, changes: Mapping[str, Any]) -> dict[str, Figures]:
        """Figures of the loop as it is, and as `tune` would make it, both with a step of one length; changes nothing.
        Raises ConfigError, Refused.
        """
        with self._building:
            number, configuration = self.axis_number(axis), self.prepared.configuration
            changed_configuration = self._configured(*self._tuned(axis, section, changes))
            if (cached := self._figures.get(number)) is None or cached[0] is not configuration:
                cached = self._figures[number] = configuration, figures_limited(configuration, number)
            after = figures_limited(changed_configuration, number, step_end_ms(cached[1]))
            before = with_longer_step(cached[1], running_check(self.prepared, number), step_end_ms(after))
            return {"before": before, "after": after}

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
            raise unsuitable(f"section {section!r}: {', '.join(SECTIONS)} may change")
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

    def tare(self, number: int, offset_v: float) -> int:
        """Make `offset_v` the reading at position 0; returns the tick."""
        with self._staging.lock:
            self.offsets_v[number] = offset_v
            axis = self.prepared.configuration.axes[number]
            return self._stage(number, self.prepared, axis, f"position 0 is now at {offset_v:.4g} V")

    def replace_all(self, prepared: Prepared) -> list[str]:
        """Take over another configuration; what changed. Raises Refused where that needs a restart."""
        with self._building, self._staging.lock:
            old, new = self.prepared.configuration, prepared.configuration
            fixed_parts = [part for part in FIXED if getattr(old, part) != getattr(new, part)]
            if fixed_parts or prepared.plan.axes != self.prepared.plan.axes:
                raise Refused(f"{', '.join(fixed_parts) or 'axes'}: changed, which needs a restart")
            if old.owners != new.owners:
                raise Refused(OTHER_AXES)
            pairs = list(enumerate(zip(old.axes, new.axes, strict=True)))
            for _, (before, after) in pairs:
                if before.feedforward != after.feedforward:
                    raise Refused(f"axis.{after.name}.feedforward: changed, which needs a restart")
            references = {n: self.references.generator(after.reference) for n, (before, after) in pairs
                          if before.reference != after.reference}  # fmt: skip
            changed_axes: list[str] = []
            try:
                for number, (before, after) in pairs:
                    options = after.model_copy(update={"reference": before.reference})
                    if options != before:
                        self._stage(number, prepared, options)
                        changed_axes.append(f"axis.{after.name}")
                for number, (values, samples) in references.items():
                    self.references.play(number, values, samples)
                    self._note(number, prepared, new.axes[number])
                    changed_axes.append(f"axis.{new.axes[number].name}")
            except RtloopError as error:
                if not changed_axes:
                    raise
                faults = error.faults if isinstance(error, ConfigError) else [str(error)]
                raise Refused(
                    "; ".join([*faults, f"changed already: {', '.join(dict.fromkeys(changed_axes))}"])
                ) from None
            self.prepared = prepared
            if changed_axes:
                self._changes.forget()
            return list(dict.fromkeys(changed_axes))

    def _note(self, number: int, prepared: Prepared, axis: AxisOptions) -> None:
        """The loop has taken an axis of `prepared`, with those that share its controller, and of what that axis does
        `axis` is true; the others are as they were.
        """
        coefficients, checks = np.asarray(self.prepared.plan.coefficients).copy(), list(self.prepared.checks)
        configuration = self.prepared.configuration
        for i in prepared.configuration.axes_sharing(number):
            coefficients[i], checks[i] = np.asarray(prepared.plan.coefficients)[i], prepared.checks[i]
            unchanged = {"reference": configuration.axes[i].reference}
            options = axis if i == number else prepared.configuration.axes[i].model_copy(update=unchanged)
            configuration = _with_axis(configuration, i, options)
        plan = replace(self.prepared.plan, coefficients=coefficients)
        self.prepared = replace(self.prepared, configuration=configuration, plan=plan, checks=tuple(checks))

    def _validated_axis(self, raw: Mapping[str, Any]) -> AxisOptions:
        """An axis with the laws that the loop has loaded. Raises ConfigError."""
        configuration = self.prepared.configuration
        library = Library(configuration.folder, configuration.laws)
        if needs_limited_process(configuration.laws):
            try_limited("change", partial(AxisOptions.model_validate, context={"library": library}), raw)
        try:
            return AxisOptions.model_validate(raw, context={"library": library})
        except ValidationError as error:
            raise ConfigError("change", describe(error, f"axis.{raw['name']}", raw)) from None

    def _swap(self, number: int, axis: AxisOptions) -> int:
        """Build the configuration with another axis, verify it, swap its coefficients."""
        prepared = prepare_limited(self._configured(number, axis))
        with self._staging.lock:
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

    def _stage(self, number: int, prepared: Prepared, axis: AxisOptions, change: str | None = None) -> int:
        """Copy coefficients to where the loop takes them from, have it take them; note `axis`. Raises Taken, too.

        `change` says in words what changes; by default, the keys of `axis` that differ.

        Axes that share a controller are taken together, by the number of the first, where that one changes.
        """
        new_coefficients, current_coefficients = (
            np.asarray(prepared.plan.coefficients),
            np.asarray(self.prepared.plan.coefficients),
        )
        first, *other_axes = prepared.configuration.axes_sharing(number)
        before, after = self.prepared.configuration.axes[first], prepared.configuration.axes[first]
        if number != first and new_coefficients[first].tobytes() == current_coefficients[first].tobytes():
            first, other_axes = number, []
        coefficients = new_coefficients[first : first + 1 + len(other_axes)].copy()
        for place, i in enumerate((first, *other_axes)):
            coefficients["offset_v"][place] = self.offsets_v.get(i, float(coefficients["offset_v"][place]))
        begin = first * coefficients.dtype.itemsize
        self._staging.require_settled()
        destination = self._staging.block["staged"][begin : begin + coefficients.nbytes]
        destination[:] = np.frombuffer(coefficients.tobytes(), np.uint8)
        is_new_controller = before.controller != after.controller
        change = change or differences(self.prepared.configuration.axes[number], axis) or None
        try:
            tick = self._staging.submit(Kind.LOAD_LAW, first, [float(is_new_controller)], change)
        except Taken:
            self._note(number, prepared, axis)
            raise
        self._note(number, prepared, axis)
        return tick


def _with_axis(configuration: Configuration, number: int, axis: AxisOptions) -> Configuration:
    axes = list(configuration.axes)
    axes[number] = axis
    return replace(configuration, axes=tuple(axes))
