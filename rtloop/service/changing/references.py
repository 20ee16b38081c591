"""References of a running loop: generators and waveforms, which start at one tick."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from pydantic import ValidationError

from rtloop.configuration.file import describe, type_adapter
from rtloop.configuration.prepare import Prepared
from rtloop.configuration.reference_options import ReferenceOptions
from rtloop.configuration.references import (
    TableOfSamples,
    extent,
    generator_values,
    table_values,
    volts,
)
from rtloop.configuration.schedule import setpoint_fault
from rtloop.engine.messages import Kind
from rtloop.errors import ConfigError
from rtloop.foundation.arrays import Real
from rtloop.kernel.limits import USABLE_MAGNITUDE
from rtloop.kernel.reference import Generator
from rtloop.service.changing.active_references import ActiveReferences, Trip
from rtloop.service.changing.staging import Staging
from rtloop.service.desk import Refusal, UnconfirmedCommand


class Setting(NamedTuple):
    """A reference: [kind, *parameters] of its generator, in V or µm, and the samples of a table that a client set.

    `samples` (n,) are column after column; None for a configured table, and for generators without a table.
    """

    values: tuple[float, ...]
    in_volts: bool
    samples: Real | None = None


class ReferenceReplaced(Refusal):
    """The reference of axis `axis` was replaced by another client."""

    def __init__(self, axis: str) -> None:
        """Make the message, which names `axis`."""
        super().__init__(f"reference of axis {axis}: replaced by another client")


class LiveReferences:
    """The active references, and their changes. Thread-safe.

    `prepared` returns the running configuration: a changed limit holds for the next reference.
    """

    def __init__(self, prepared: Callable[[], Prepared], staging: Staging) -> None:
        """Begin with the references of the plan. `prepared` returns the running configuration, also after a change;
        `staging` gives access to the loop.
        """
        self._prepared, self._staging = prepared, staging
        plan = prepared().plan
        self._first_spare = plan.table.size
        self._active_places = [0] * len(plan.axes)
        self._active_references = ActiveReferences(plan, staging)
        self._set_counts = [0] * len(plan.axes)
        """Number of references set on each axis, which the loop accepted or may still start."""
        self._own_counts = [0] * len(plan.axes)
        """Number of these references that the service itself set: sines that depolarise, and the ramps of a return."""
        self._activity = ""
        """Reason for refusing the references of clients, in words; empty while clients may set references."""

    def set(self, axis: str, reference: Mapping[str, object], *, restores: bool = False) -> int:
        """Start a generator, {kind, …} as in [axis.reference], on the axis of this name. Returns its first tick.

        Its values are in µm, in raw mode in V. `restores`: the reference, in µm, was active before, so a constant one
        is not refused beyond the position interlock, which may have been narrowed since. Raises ConfigError for an
        unknown axis, invalid keys, a table that cannot be read and values beyond the limits; Refusal within `reserved`,
        with `restores` in raw mode, and as `Desk.submit`.
        """
        try:
            options = type_adapter(ReferenceOptions).validate_python(dict(reference))
        except ValidationError as error:
            raise ConfigError("reference", describe(error, "reference", reference)) from None
        values, samples = self.generator(options)
        with self._staging.lock:
            return self.play(axis_number(self._prepared(), axis), values, samples, restores=restores)

    def set_waveform(self, axis: str, samples: Real, hold_ticks: int, repeat: bool) -> int:
        """Play samples (n, 1 or 2) in µm (V in raw mode), `hold_ticks` ticks each, once or endlessly (`repeat`).

        Played once, the last sample is held. The second column, µm, is added to the command. Returns the tick of the
        first sample; does not wait for the others. Raises ConfigError for an unknown axis, and for samples that are
        none, not finite, too many or beyond the limits; Refusal within `reserved` and while the loop may still read an
        earlier table; else as `Desk.submit`.
        """
        if samples.size == 0 or not np.all(np.abs(samples) < USABLE_MAGNITUDE):
            raise invalid_request(
                f"waveform: {len(samples)} samples, with {np.sum(~(np.abs(samples) < USABLE_MAGNITUDE))} values out of "
                f"range; allowed: at least one sample, values between {-USABLE_MAGNITUDE:g} and {USABLE_MAGNITUDE:g} "
                "µm (V in mode raw)"
            )
        table = TableOfSamples()
        values = list(table_values(samples, hold_ticks, repeat, table))
        with self._staging.lock:
            return self.play(axis_number(self._prepared(), axis), values, table.samples)

    def play_raw(self, number: int, samples_v: Real) -> int:
        """Play `samples_v` (n,), V, once, a tick each, as the reference of axis `number`; the last one is held.

        The caller sets mode raw, in which the reference is the drive. Limits are not checked. Returns the tick of the
        first sample. Raises ConfigError for too many samples, Refusal while the loop may still read an earlier table,
        else as `Desk.submit`.
        """
        with self._service_change(number):
            return self._submit_table(number, [Generator.TABLE, 0, samples_v.size, 1.0, 0.0], samples_v)

    def play_once(self, number: int, samples: Real, hold_ticks: int, replaces: int) -> int:
        """Play samples (n, 1 or 2) once on axis `number`, `hold_ticks` ticks each, as `set_waveform` does.

        `replaces` is the axis's entry of `client_counts` when the caller decided to play; ReferenceReplaced is raised
        if a client has set a reference since. Limits are not checked. Returns the tick of the first sample. Raises also
        ConfigError for too many samples, Refusal while the loop may still read an earlier table, else as `Desk.submit`.
        """
        count, columns = samples.shape
        with self._service_change(number, replaces):
            values: list[float] = [Generator.TABLE, 0, count, hold_ticks, 0.0, float(columns == 2)]
            return self._submit_table(number, values, samples.T.ravel())

    def setting(self, number: int) -> Setting | None:
        """Return the reference of axis `number` for `restart`, with a copy of the samples of a client's table; None if
        the reference is unknown.

        Does not wait for the loop.
        """
        active = self._active_references.values(number)
        if active is None:
            return None
        values, in_volts = active
        if values[0] != Generator.TABLE or values[1] < self._first_spare:
            return Setting(values, in_volts)
        first, size = int(values[1]), int(values[2]) * (2 if values[5] else 1)
        return Setting(values, in_volts, self._staging.block["table"][first : first + size].copy())

    def restart(self, number: int, setting: Setting, replaces: int) -> int:
        """Start a reference again, from its beginning, without a check of limits. Returns its first tick.

        The loop must have the configured tables that it had when `setting` was stored. `replaces` and errors as in
        `play_once`.
        """
        with self._service_change(number, replaces):
            values = list(setting.values)
            if setting.samples is None:
                return self._submit(number, values)
            return self._submit_table(number, values, setting.samples)

    @contextmanager
    def reserved(self, activity: str) -> Iterator[None]:
        """Refuse the references of clients during the work within, in which the loop would take their µm for V.

        `activity` is the reason in the refusal, in words. References of the service itself are accepted.
        """
        with self._staging.lock:
            self._activity = activity
        try:
            yield
        finally:
            self._activity = ""

    @contextmanager
    def _service_change(self, number: int, replaces: int | None = None) -> Iterator[None]:
        """Hold the staging lock during the work within, and count the references that this work sets on axis `number`
        as the service's own.

        Raises ReferenceReplaced, before the work, if the axis's entry of `client_counts` is no longer `replaces`: a
        client has set a reference since. None: without this check.
        """
        with self._staging.lock:
            if replaces is not None and self.client_counts[number] != replaces:
                raise ReferenceReplaced(self._prepared().plan.axes[number])
            before = self._set_counts[number]
            try:
                yield
            finally:
                self._own_counts[number] += self._set_counts[number] - before

    @property
    def trip(self) -> Trip:
        """The newest trip in the events that `follow` has read; NO_TRIP, whose number is 0, before the first."""
        return self._active_references.trip

    def set_count(self, number: int) -> int:
        """Return how many references clients and service have set on axis `number` since the loop's start.

        Waits for the end of a change under way. References that the loop refused do not count.
        """
        with self._staging.lock:
            return self._set_counts[number]

    @property
    def client_counts(self) -> tuple[int, ...]:
        """Number of references that clients have set on each axis since the loop's start; one that is being set may not
        be counted yet.
        """
        return tuple(count - own for count, own in zip(self._set_counts, self._own_counts, strict=True))

    def follow(self) -> None:
        """Read the loop's new events. Call this often: the loop overwrites old ones."""
        self._active_references.follow()

    def restore_configured(self, number: int) -> int:
        """Start the configured reference of axis `number`, without a check of limits. Returns its first tick.

        Raises as `Desk.submit`.
        """
        generator = self._prepared().plan.generators[number]
        with self._staging.lock:
            return self._submit(number, [float(generator["kind"]), *generator["parameters"].tolist()])

    def constant_reference_um(self, number: int) -> float:
        """Return the value, µm, of the constant reference that the loop has for axis `number`.

        Waits for a change under way. Raises Refusal if the reference is not constant, is in V or is unknown, and if the
        loop stands still.
        """
        reference, name = self._active_references.newest(number), self._prepared().plan.axes[number]
        setpoint = f"`rtloop ctl setpoint {name} VALUE`"
        if reference.kind is None:
            raise Refusal(
                f"reference of axis {name}: unknown, because events of the loop were lost; set the mode again "
                f"(`rtloop ctl mode closed_loop`), then a setpoint ({setpoint})"
            )
        if reference.in_volts:
            raise Refusal(
                f"reference of axis {name}: in V (mode raw); allowed: a reference in µm; use `rtloop ctl mode "
                "closed_loop`"
            )
        if reference.kind is not Generator.HOLD:
            kind_name = reference.kind.name.lower()
            raise Refusal(
                f"reference of axis {name}: kind is {kind_name}; allowed: hold, a constant reference; set one with "
                f"{setpoint}"
            )
        return reference.value

    def generator(self, options: ReferenceOptions) -> tuple[list[float], Real]:
        """Return [kind, *parameters] of a generator, and the samples (n,) of its table, column after column.

        The samples are empty for other kinds than steps and table. Raises ConfigError for a table that cannot be read
        and for invalid values.
        """
        table, prepared = TableOfSamples(), self._prepared()
        configuration = prepared.configuration
        try:
            values = generator_values(
                options, configuration.loop.rate_hz, prepared.facts.inputs, configuration.folder, table
            )
        except ValueError as error:
            raise ConfigError("reference", [f"reference.{error}"]) from None
        return list(values), table.samples

    def play(self, number: int, values: list[float], samples: Real, *, restores: bool = False) -> int:
        """Start a generator on axis `number` and return its first tick; the staging lock must be held.

        Table samples go to shared memory. `values` and `samples` as `generator` returns them, `restores` as in `set`.
        Raises ConfigError for values beyond limits.command_um (in raw mode: beyond the limits of the drive), for a
        constant reference beyond the position interlock (not in raw mode) and for too many samples; Refusal within
        `reserved`, with `restores` in raw mode, and while the loop may still read an earlier table; else as
        `Desk.submit`.
        """
        if self._activity:
            raise Refusal(f"reference: {self._activity}; send the request again afterwards")
        options = self._prepared().configuration.axes[number]
        limits = options.limits
        lowest, highest = extent(values, samples)
        if self._staging.in_raw_mode:
            if restores:
                raise Refusal("reference: the earlier reference is in µm; references in mode raw are in V")
            if not limits.lowest_v <= lowest <= highest <= limits.drive_v:
                allowed = f"{limits.lowest_v:g} V … {limits.drive_v:g} V (limits.drive_min_v, limits.drive_v)"
                raise invalid_request(
                    f"reference: {volts(lowest, highest)}; allowed: {allowed}; references in mode raw are in V"
                )
        elif not (largest := max(-lowest, highest)) <= limits.command_um:
            allowed = f"at most {limits.command_um:g} µm (limits.command_um)"
            raise invalid_request(f"reference: reaches a magnitude of {largest:g} µm; allowed: {allowed}")
        elif not restores and (fault := _setpoint_fault(values, options.interlocks.position_um)) is not None:
            raise invalid_request(f"reference: {fault}")
        if samples.size:
            return self._submit_table(number, values, samples)
        return self._submit(number, [float(value) for value in values])

    def _submit(self, number: int, values: list[float], *, table: bool = False) -> int:
        """Start a generator on axis `number` and count it, unless it is refused. Returns its first tick.

        `values` are [kind, *parameters]. The staging lock must be held. With `table`, the samples are in the free one
        of the axis's two places in shared memory, which then is the place in use. Raises as `Desk.submit`.
        """
        try:
            if table:
                tick = self._staging.submit(Kind.SET_REFERENCE, number, values)
            else:
                tick = self._staging.desk.submit(Kind.SET_REFERENCE, axis=number, values=values)
        except UnconfirmedCommand:  # The loop starts the reference if it goes on.
            self._record_set(number, table)
            raise
        self._record_set(number, table)
        return tick

    def _record_set(self, number: int, table: bool) -> None:
        """Count a reference of axis `number`; with `table`, exchange the axis's free place in shared memory and the
        place in use.
        """
        self._set_counts[number] += 1
        if table:
            self._active_places[number] = 1 - self._active_places[number]

    def _submit_table(self, number: int, values: list[float], samples: Real) -> int:
        """Copy `samples` to the free one of the axis's two places in the shared table, play them, and return the tick.

        `values` as in `play`; `values[1]`, the index of the first sample, is set here. Raises ConfigError for too many
        samples, Refusal while the loop may still read an earlier table (`Staging.require_settled`), else as
        `Desk.submit`.
        """
        self._staging.require_settled()
        table, first_spare, axis_count = self._staging.block["table"], self._first_spare, len(self._active_places)
        capacity = (table.size - first_spare) // (2 * axis_count)
        if samples.size > capacity:
            raise invalid_request(f"waveform: {samples.size} samples; allowed: at most {capacity}")
        place = 1 - self._active_places[number]
        values[1] = first_spare + (2 * number + place) * capacity
        table[values[1] : values[1] + samples.size] = samples
        return self._submit(number, [float(value) for value in values], table=True)


def _setpoint_fault(values: Sequence[float], position_limit_um: float) -> str | None:
    """Return the fault, in words, of a constant reference beyond ±`position_limit_um`; None for a smaller one and for
    generators of another kind.

    `values` are [kind, *parameters] of the generator.
    """
    return setpoint_fault(values[1], position_limit_um) if values[0] == Generator.HOLD else None


def axis_number(prepared: Prepared, name: str) -> int:
    """Return the number of an axis, from 0. Raises ConfigError for an unknown name."""
    if name not in prepared.plan.axes:
        raise invalid_request(f"axis {name!r}: unknown; allowed: {', '.join(prepared.plan.axes)}")
    return prepared.plan.axes.index(name)


def invalid_request(message: str) -> ConfigError:
    """Return, without raising it, the error for a request that no state allows; `message` is its only fault."""
    return ConfigError("request", [message])
