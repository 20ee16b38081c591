"""References of a running loop: generators and waveforms, which start at one tick."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from rtloop.configuration.axis import ReferenceOptions
from rtloop.configuration.file import describe
from rtloop.configuration.prepare import Prepared
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
from rtloop.kernel.limits import USABLE_MAGNITUDE
from rtloop.kernel.reference import Generator
from rtloop.service.changing.staging import Staging
from rtloop.service.desk import Refusal

Samples = np.ndarray[Any, Any]


class LiveReferences:
    """The active references, and their changes. Thread-safe.

    `prepared` returns the running configuration: a changed limit holds for the next reference.
    """

    def __init__(self, prepared: Callable[[], Prepared], staging: Staging) -> None:
        self._prepared, self._staging = prepared, staging
        plan = prepared().plan
        self._first_spare = plan.table.size
        self._active_places = [0] * len(plan.axes)
        self._active_generators = [
            (int(generator["kind"]), float(generator["parameters"][0])) for generator in plan.generators
        ]
        self.set_counts = [0] * len(plan.axes)
        """Number of references set on each axis."""

    def set(self, axis: str, reference: Mapping[str, Any], *, restores: bool = False) -> int:
        """Start a generator, {kind, …} as in [axis.reference], on an axis. Returns its first tick.

        `restores`: the reference was active before, so a position interlock that was narrowed since does not refuse it.
        Raises ConfigError for an unknown axis, invalid keys or values beyond the limits; Refusal, UnconfirmedCommand.
        """
        try:
            options = TypeAdapter(ReferenceOptions).validate_python(dict(reference))
        except ValidationError as error:
            raise ConfigError("reference", describe(error, "reference", reference)) from None
        values, samples = self.generator(options)
        with self._staging.lock:
            return self.play(axis_number(self._prepared(), axis), values, samples, restores=restores)

    def set_waveform(self, axis: str, samples: Samples, hold_ticks: int, repeat: bool) -> int:
        """Play samples (n, 1 or 2) in µm (V in raw mode), `hold_ticks` ticks each, once or endlessly (`repeat`).

        The second column, µm, is added to the command. Returns the tick of the first sample. Raises ConfigError for an
        unknown axis, and for samples that are none, not finite, too many or beyond the limits; Refusal,
        UnconfirmedCommand.
        """
        if samples.size == 0 or not np.all(np.abs(samples) < USABLE_MAGNITUDE):
            raise invalid_request(
                f"waveform: {len(samples)} samples; allowed: at least one sample, and finite numbers only"
            )
        table = TableOfSamples()
        values = list(table_values(samples, hold_ticks, repeat, table))
        with self._staging.lock:
            return self.play(axis_number(self._prepared(), axis), values, table.samples)

    def play_raw(self, number: int, samples_v: Samples) -> int:
        """Start drives `samples_v` (n,), V, once, a tick each, as reference of axis `number`; the caller sets mode raw.

        Limits are not checked. Returns the tick of the first sample. Raises Refusal, UnconfirmedCommand; ConfigError
        for too many samples.
        """
        with self._staging.lock:
            return self._submit_table(number, [Generator.TABLE, 0, samples_v.size, 1.0, 0.0], samples_v)

    def restore_configured(self, number: int) -> int:
        """Start the configured reference of axis `number`, without a check of limits.

        Returns the tick at which it took effect; raises as `Desk.submit`.
        """
        generator = self._prepared().plan.generators[number]
        return self._submit(number, [float(generator["kind"]), *generator["parameters"].tolist()])

    def held_value(self, number: int) -> float:
        """Return the constant reference of axis `number`, µm (V in raw mode). Raises Refusal if it is not constant."""
        kind, value = self._active_generators[number]
        if kind != Generator.HOLD:
            name, kind_name = self._prepared().plan.axes[number], Generator(kind).name.lower()
            raise Refusal(
                f"reference of axis {name}: kind is {kind_name}; allowed: hold (`rtloop ctl setpoint {name} VALUE`)"
            )
        return value

    def generator(self, options: ReferenceOptions) -> tuple[list[Any], Samples]:
        """Return [kind, *parameters] of a generator, and the samples of its table, which are empty for other kinds.

        Raises ConfigError for a table that cannot be read and for invalid values.
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

    def play(self, number: int, values: list[Any], samples: Samples, *, restores: bool = False) -> int:
        """Start a generator on axis `number` and return its first tick; the staging lock must be held.

        Table samples go to shared memory. `values` and `samples` as `generator` returns them, `restores` as in `set`.
        Raises ConfigError beyond limits.command_um (raw mode: beyond the drive's limits), for a setpoint beyond the
        position interlock and for too many samples; Refusal, UnconfirmedCommand.
        """
        options = self._prepared().configuration.axes[number]
        limits = options.limits
        lowest, highest = extent(values, samples)
        if self._staging.in_raw_mode:
            if not limits.lowest_v <= lowest <= highest <= limits.drive_v:
                allowed = f"{limits.lowest_v:g} V … {limits.drive_v:g} V (limits.drive_v), and mode raw takes volts"
                raise invalid_request(f"reference: {volts(lowest, highest)}, beyond the axis's {allowed}")
        elif not (largest := max(-lowest, highest)) <= limits.command_um:
            allowed = f"±{limits.command_um:g} µm (limits.command_um)"
            raise invalid_request(f"reference: reaches {largest:g} µm, beyond the axis's {allowed}")
        elif not restores and (fault := _setpoint_fault(values, options.interlocks.position_um)) is not None:
            raise invalid_request(f"reference: {fault}")
        if samples.size:
            return self._submit_table(number, values, samples)
        return self._submit(number, [float(value) for value in values])

    def _submit(self, number: int, values: list[float], *, table: bool = False) -> int:
        """Start a generator, count it in `set_counts`, record it as active. Returns the tick; raises as `Desk.submit`.

        `table`: it plays from shared memory, which must not change until the loop has read it.
        """
        self.set_counts[number] += 1
        if table:
            tick = self._staging.submit(Kind.SET_REFERENCE, number, values)
        else:
            tick = self._staging.desk.submit(Kind.SET_REFERENCE, axis=number, values=values)
        self._active_generators[number] = int(values[0]), values[1]
        return tick

    def _submit_table(self, number: int, values: list[Any], samples: Samples) -> int:
        """Copy `samples` to the free one of the axis's two places in the shared table, play them, and return the tick.

        Raises ConfigError for too many samples, Refusal, UnconfirmedCommand.
        """
        self._staging.require_settled()
        table, first_spare, axis_count = self._staging.block["table"], self._first_spare, len(self._active_places)
        capacity = (table.size - first_spare) // (2 * axis_count)
        if samples.size > capacity:
            raise invalid_request(f"waveform: {samples.size} samples; allowed: at most {capacity}")
        place = 1 - self._active_places[number]
        values[1] = first_spare + (2 * number + place) * capacity
        table[values[1] : values[1] + samples.size] = samples
        tick = self._submit(number, [float(value) for value in values], table=True)
        self._active_places[number] = place
        return tick


def _setpoint_fault(values: Sequence[float], position_limit_um: float) -> str | None:
    """Return the fault of a constant reference beyond ±`position_limit_um`; None within it and for other generators.

    `values` are [kind, *parameters] of the generator.
    """
    return setpoint_fault(values[1], position_limit_um) if values[0] == Generator.HOLD else None


def axis_number(prepared: Prepared, name: str) -> int:
    """Return the number of an axis. Raises ConfigError for an unknown name."""
    if name not in prepared.plan.axes:
        raise invalid_request(f"axis {name!r}: unknown; allowed: {', '.join(prepared.plan.axes)}")
    return prepared.plan.axes.index(name)


def invalid_request(message: str) -> ConfigError:
    """Return the error for a request that no state allows."""
    return ConfigError("request", [message])
