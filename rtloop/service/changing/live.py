"""Live changes of a law: built and verified beside the loop, staged in shared memory, loaded at one tick."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from pydantic import ValidationError

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration, describe, shared_faults
from rtloop.configuration.laws import Library
from rtloop.configuration.prepare import Prepared
from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import Kind
from rtloop.errors import ConfigError, RtloopError
from rtloop.foundation import timing
from rtloop.laws.limited.trial import needs_limited_process, try_limited
from rtloop.service.changing.building import figures_limited, prepare_limited
from rtloop.service.changing.change_history import Change, ChangeHistory
from rtloop.service.changing.differences import differences
from rtloop.service.changing.preview import Figures, lengthen_step, running_check, step_duration_ms
from rtloop.service.changing.references import LiveReferences, axis_number, invalid_request
from rtloop.service.changing.staging import Staging
from rtloop.service.desk import Desk, Refusal, UnconfirmedCommand

FIXED_PARTS = {
    "loop": "loop",
    "driver_kind": "driver.kind",
    "driver_options": "driver",
    "channels": "driver.channels",
    "inputs": "inputs",
    "outputs": "outputs",
}
"""Fields of `Configuration` that only a restart can change, and their places in the file."""
CONTROLLER_AXES_CHANGED = (
    "controller.axes: differs from the running loop, whose axes share controllers in another way; restart the service"
)
TUNABLE_SECTIONS = ("controller", "limits", "interlocks", "prefilter", "model")
"""Sections of an axis whose keys may change in a running loop."""


class LiveLaw:
    """The running law, and its changes. Thread-safe.

    `prepared` is the running configuration with its coefficients. `offsets_v` are the readings at position 0 of tared
    axes, by number; other changes keep them.
    """

    def __init__(self, prepared: Prepared, block: SharedBlock, desk: Desk, offsets_v: dict[int, float]) -> None:
        """Begin with `prepared`, which the loop of `block` runs; `desk` sends to this loop.

        `offsets_v` are the readings at position 0 of tared axes, by number; `tare` changes this dict itself.
        """
        self.prepared = prepared
        self.offsets_v = offsets_v
        self._staging = Staging(block, desk)
        self.references = LiveReferences(lambda: self.prepared, self._staging)
        self._build_lock = timing.lock()
        """Held while a law is built and verified; references do not wait for it."""
        self._history = ChangeHistory()
        self._figures: dict[int, tuple[Configuration, Figures]] = {}
        """Cached figures of axes, each with its configuration."""

    @property
    def current_configuration(self) -> dict[str, object]:
        """{folder: folder of the configuration's files, values: the configuration with all changes, as JSON values}."""
        configuration = self.prepared.configuration
        values = tomllib.loads(configuration.text)
        values["axis"] = [axis.model_dump(mode="json", exclude_unset=True) for axis in configuration.axes]
        return {"folder": str(configuration.folder.resolve()), "values": values}

    def axis_number(self, name: str) -> int:
        """Return the number of an axis. Raises ConfigError for an unknown name."""
        return axis_number(self.prepared, name)

    def change_text(self, identity: int) -> str | None:
        """Return in words the change of the law that the command with `identity`, the number in its event, made; None
        if it is unknown.
        """
        return self._staging.desk.change_text(identity)

    def tune(self, axis: str, section: str, changes: Mapping[str, object]) -> int:
        """Build and verify the law with other values of keys of [axis.SECTION], `changes`, and load it.

        Returns the tick of the load; `undo` takes the change back. Raises ConfigError for an unknown axis, a section
        that is not in TUNABLE_SECTIONS, invalid values and a law that fails verification, DriverError, UnavailableError
        if the build takes too long or its process fails, Refusal if a restart is needed or the loop refuses: the law
        then stays. Raises UnconfirmedCommand if the loop stands still: the change then counts as loaded, since the loop
        may still load it.
        """
        with self._build_lock:
            number, options = self._axis_with_keys(axis, section, changes)
            return self._apply_change(number, options, section, f"{section}: {', '.join(changes)}")

    def load_controller(self, axis: str, controller: Mapping[str, object]) -> int:
        """Replace [axis.controller] as a whole: build, verify and load it. Returns the tick of the load.

        `controller` are all its keys with their values; `undo` takes the change back. Raises as `tune`, ConfigError
        also for invalid keys.
        """
        with self._build_lock:
            owner, options = self._axis_with_controller(self.axis_number(axis), controller, keep_other_keys=False)
            return self._apply_change(owner, options, "controller", "controller")

    def preview(self, axis: str, section: str, changes: Mapping[str, object]) -> dict[str, Figures]:
        """Return {before, after}: `loop_figures` without and with a `tune`, with steps of equal length.

        The running law stays. Raises as `tune`, except for UnconfirmedCommand.
        """
        with self._build_lock:
            number, configuration = self.axis_number(axis), self.prepared.configuration
            changed_configuration = self._changed_configuration(*self._axis_with_keys(axis, section, changes))
            if (cached := self._figures.get(number)) is None or cached[0] is not configuration:
                cached = self._figures[number] = configuration, figures_limited(configuration, number)
            after = figures_limited(changed_configuration, number, step_duration_ms(cached[1]))
            before = lengthen_step(cached[1], running_check(self.prepared, number), step_duration_ms(after))
            return {"before": before, "after": after}

    def undo(self, axis: str) -> tuple[int, str]:
        """Undo the newest change of an axis or of its controller: load the options that the changed axis had before.

        The reference stays; the change leaves the history, except after an error. Returns the tick of the load, and the
        undone change in words. Raises ConfigError for an unknown axis, Refusal if there is no change, Refusal for a
        change of a shared controller if its owner, another axis, has a newer change of another section, and as `tune`.
        """
        with self._build_lock:
            number, configuration = self.axis_number(axis), self.prepared.configuration
            owner = configuration.owners[number]
            change, blocker = self._history.newest(number, owner)
            if change is None:
                raise Refusal(f"undo: axis {axis} has no change since the loop started or was reloaded")
            if blocker is not None:
                name = configuration.axes[owner].name
                raise Refusal(
                    f"undo: axis {axis} shares the controller of axis {name}, which has a newer change "
                    f"({blocker.text}); undo that change of axis {name} first"
                )
            reference = configuration.axes[change.number].reference
            tick = self._swap(change.number, change.before.model_copy(update={"reference": reference}))
            self._history.remove(change)
            return tick, change.text

    def _apply_change(self, number: int, axis: AxisOptions, section: str, change_text: str) -> int:
        """Load options of axis `number` with a changed section, add the change to the history, and return the tick.

        The history also gets a change that was not confirmed: the loop may still load it. Raises as `_swap`.
        """
        change = Change(number, section, self.prepared.configuration.axes[number], change_text)
        try:
            tick = self._swap(number, axis)
        except UnconfirmedCommand:
            self._history.add(change)
            raise
        self._history.add(change)
        return tick

    def _axis_with_keys(self, axis: str, section: str, changes: Mapping[str, object]) -> tuple[int, AxisOptions]:
        """Return number and options, with the changes, of the axis that owns the section: for "controller" the axis
        whose controller `axis` uses, else `axis` itself.

        Raises ConfigError for an unknown axis, a section that is not in TUNABLE_SECTIONS and invalid values.
        """
        number = self.axis_number(axis)
        if section not in TUNABLE_SECTIONS:
            raise invalid_request(
                f"section {section!r}: cannot change while the loop runs; allowed: {', '.join(TUNABLE_SECTIONS)}"
            )
        if section == "controller":
            return self._axis_with_controller(number, changes, keep_other_keys=True)
        merged = self.prepared.configuration.axes[number].model_dump(exclude_unset=True)
        merged[section] = {**(merged.get(section) or {}), **changes}
        return number, self._validated_axis(merged)

    def _axis_with_controller(
        self, number: int, controller: Mapping[str, object], keep_other_keys: bool
    ) -> tuple[int, AxisOptions]:
        """Return number and options of the axis that owns the controller of axis `number`, with another controller.

        With `keep_other_keys`, `controller` has only the keys that change; else it has all keys. Raises ConfigError for
        invalid values.
        """
        configuration = self.prepared.configuration
        owner = configuration.owners[number]
        merged = configuration.axes[owner].model_dump(exclude_unset=True)
        merged["controller"] = {**((merged.get("controller") or {}) if keep_other_keys else {}), **controller}
        return owner, self._validated_axis(merged)

    def tare(self, number: int, offset_v: float) -> int:
        """Make `offset_v` the reading at position 0 of axis `number`, now and after later changes.

        Returns the tick at which the offset took effect. Raises Refusal if the loop refuses, or an earlier change is
        unconfirmed, QueueFull as `Desk.submit`; the earlier offset then stays. Raises UnconfirmedCommand if the loop
        took the command and stands still: it may still load the new offset, so later changes carry it.
        """
        with self._staging.lock:
            axis, earlier_v = self.prepared.configuration.axes[number], self.offsets_v.get(number)
            self.offsets_v[number] = offset_v
            try:
                return self._stage(
                    number, self.prepared, axis, f"position 0 µm is now at a reading of {offset_v:.4g} V"
                )
            except UnconfirmedCommand:
                raise
            except RtloopError:
                if earlier_v is None:
                    del self.offsets_v[number]
                else:
                    self.offsets_v[number] = earlier_v
                raise

    def replace_all(self, prepared: Prepared) -> list[str]:
        """Load the options and references of another configuration, axis by axis, where they differ from the present.

        Afterwards `self.prepared` is `prepared`; the undo history is cleared if an axis changed. Returns the changed
        axes as ["axis.NAME", …], [] if none changed. Raises Refusal if the other configuration needs a restart,
        ConfigError for a reference that is invalid or beyond the limits, and as `Desk.submit`. An RtloopError after the
        first change of an axis becomes a Refusal that names the axes changed already: these stay changed, and the
        history stays.
        """
        with self._build_lock, self._staging.lock:
            old, new = self.prepared.configuration, prepared.configuration
            fixed_parts = [place for part, place in FIXED_PARTS.items() if getattr(old, part) != getattr(new, part)]
            if fixed_parts or prepared.plan.axes != self.prepared.plan.axes:
                raise Refusal(
                    f"{', '.join(fixed_parts) or 'axes'}: changed in the configuration file; restart the service to "
                    "apply the change"
                )
            if old.owners != new.owners:
                raise Refusal(CONTROLLER_AXES_CHANGED)
            pairs = list(enumerate(zip(old.axes, new.axes, strict=True)))
            for _, (before, after) in pairs:
                if before.feedforward != after.feedforward:
                    raise Refusal(
                        f"axis.{after.name}.feedforward: changed in the configuration file; restart the service to "
                        "apply the change"
                    )
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
                    self._record_axis(number, prepared, new.axes[number])
                    changed_axes.append(f"axis.{new.axes[number].name}")
            except RtloopError as error:
                if not changed_axes:
                    raise
                faults = error.faults if isinstance(error, ConfigError) else [str(error)]
                names = ", ".join(dict.fromkeys(changed_axes))
                raise Refusal(
                    "; ".join([*faults, f"these axes are changed already: {names}; they stay changed"])
                ) from None
            self.prepared = prepared
            if changed_axes:
                self._history.remove()
            return list(dict.fromkeys(changed_axes))

    def _record_axis(self, number: int, prepared: Prepared, axis: AxisOptions) -> None:
        """Record in `self.prepared` that the loop has loaded axis `number` and the axes that share its controller.

        `prepared` has the coefficients that were loaded and the options of these axes; `axis` are the options of axis
        `number` in their place. The other axes keep their references.
        """
        coefficients, checks = np.asarray(self.prepared.plan.coefficients).copy(), list(self.prepared.checks)
        configuration = self.prepared.configuration
        for i in prepared.configuration.axes_sharing(number):
            coefficients[i], checks[i] = np.asarray(prepared.plan.coefficients)[i], prepared.checks[i]
            unchanged = {"reference": configuration.axes[i].reference}
            options = axis if i == number else prepared.configuration.axes[i].model_copy(update=unchanged)
            configuration = _replace_axis(configuration, i, options)
        plan = replace(self.prepared.plan, coefficients=coefficients)
        self.prepared = replace(self.prepared, configuration=configuration, plan=plan, checks=tuple(checks))

    def _validated_axis(self, raw: Mapping[str, object]) -> AxisOptions:
        """Return the options of an axis from `raw`, the keys of its section [[axis]], with the name.

        The options are checked against the laws that the loop has loaded; a user's laws are tried in the limited
        process first. Raises ConfigError for invalid values and for a law whose code ends that process or does not
        return, and as `try_limited`.
        """
        configuration = self.prepared.configuration
        library = Library(configuration.folder, configuration.laws)
        if needs_limited_process(configuration.laws):
            try_limited("change", partial(AxisOptions.model_validate, context={"library": library}), raw)
        try:
            return AxisOptions.model_validate(raw, context={"library": library})
        except ValidationError as error:
            raise ConfigError("change", describe(error, f"axis.{raw['name']}", raw)) from None

    def _swap(self, number: int, axis: AxisOptions) -> int:
        """Build and verify the configuration with other options of axis `number`, and load its coefficients.

        Returns the tick of the load; `prepared` then has the new options. The build lock must be held. Raises
        ConfigError for faults of the configuration, DriverError, UnavailableError if the building process takes too
        long, prints too much or ends, Refusal if a restart is needed or the loop refuses: these change nothing. Raises
        UnconfirmedCommand if the loop stands still: `prepared` then has the new options, since it may still load them.
        """
        prepared = prepare_limited(self._changed_configuration(number, axis))
        with self._staging.lock:
            return self._stage(number, prepared, axis)

    def _changed_configuration(self, number: int, axis: AxisOptions) -> Configuration:
        """Return the configuration with a changed axis. Raises ConfigError for faults between axes, Refusal for another
        feedforward or other axes that share a controller: both need a restart.
        """
        configuration = self.prepared.configuration
        if axis.feedforward != configuration.axes[number].feedforward:
            raise Refusal(
                "feedforward: cannot change while the loop runs, because the feedforward holds the actuator's present "
                "hysteresis state; restart the service"
            )
        changed = _replace_axis(configuration, number, axis)
        if faults := shared_faults(changed.axes):
            raise ConfigError("change", faults)
        if changed.owners != configuration.owners:
            raise Refusal(CONTROLLER_AXES_CHANGED)
        return changed

    def _stage(self, number: int, prepared: Prepared, axis: AxisOptions, change: str | None = None) -> int:
        """Copy the coefficients that `prepared` has for axis `number` to shared memory, let the loop load them, and
        record `axis`, its options, as loaded. Returns the tick of the load.

        `change` describes the change; None: the keys of `axis` that differ. Axes that share a controller are loaded in
        one command with the number of the first of them, unless `number` is another one and the first keeps its
        coefficients. The staging lock must be held. Raises as `Staging.require_settled` and `Desk.submit`: nothing
        changes, except for UnconfirmedCommand, when `axis` is recorded, since the loop may still load it.
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
        except UnconfirmedCommand:
            self._record_axis(number, prepared, axis)
            raise
        self._record_axis(number, prepared, axis)
        return tick


def _replace_axis(configuration: Configuration, number: int, axis: AxisOptions) -> Configuration:
    """Return a copy of the configuration in which `axis` are the options of axis `number`."""
    axes = list(configuration.axes)
    axes[number] = axis
    return replace(configuration, axes=tuple(axes))
