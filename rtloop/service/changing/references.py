"""What the axes of a running loop follow: generators and waveforms that take over at one tick."""

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
from rtloop.kernel.reference import Generator
from rtloop.kernel.safety import USABLE_MAGNITUDE
from rtloop.service.changing.staging import Staging
from rtloop.service.desk import Refused

Samples = np.ndarray[Any, Any]


class LiveReferences:
    """The references as they are played, and the ways to change them. Thread-safe.

    `prepared` gives what runs now: a tuned limit holds for the next reference.
    """

    def __init__(self, prepared: Callable[[], Prepared], staging: Staging) -> None:
        self._prepared, self._staging = prepared, staging
        plan = prepared().plan
        self._first_spare = plan.table.size
        self._places = [0] * len(plan.axes)
        self._playing = [(int(generator["kind"]), float(generator["parameters"][0])) for generator in plan.generators]
        self.times_set = [0] * len(plan.axes)
        """How often each axis was given another one."""

    def set(self, axis: str, reference: Mapping[str, Any], *, restores: bool = False) -> int:
        """Change the generator of an axis; returns the tick. Raises ConfigError, Refused.

        `restores`: the reference is one that was in force before; a position interlock that was narrowed meanwhile
        does not keep it from coming back.
        """
        try:
            options = TypeAdapter(ReferenceOptions).validate_python(dict(reference))
        except ValidationError as error:
            raise ConfigError("reference", describe(error, "reference", reference)) from None
        values, samples = self.generator(options)
        with self._staging.lock:
            return self.play(axis_number(self._prepared(), axis), values, samples, restores=restores)

    def set_waveform(self, axis: str, samples: Samples, hold_ticks: int, repeat: bool) -> int:
        """Play samples (n, 1 or 2), `hold_ticks` ticks each; returns the tick. Raises ConfigError, Refused.

        The second column is added to the command.
        """
        if samples.size == 0 or not np.all(np.abs(samples) < USABLE_MAGNITUDE):
            raise unsuitable(f"waveform: {len(samples)} samples; at least one, and finite numbers only, are needed")
        table = TableOfSamples()
        values = list(table_values(samples, hold_ticks, repeat, table))
        with self._staging.lock:
            return self.play(axis_number(self._prepared(), axis), values, table.samples)

    def play_raw(self, number: int, volts: Samples) -> int:
        """Play `volts` (n,) once, for raw mode; returns the tick. Raises Refused."""
        with self._staging.lock:
            return self._submit_table(number, [Generator.TABLE, 0, volts.size, 1.0, 0.0], volts)

    def restore(self, number: int) -> int:
        """The reference that the configuration gives; returns the tick."""
        generator = self._prepared().plan.generators[number]
        return self._submit(number, [float(generator["kind"]), *generator["parameters"].tolist()])

    def held(self, number: int) -> float:
        """The constant that is the reference of an axis. Raises Refused where it is none."""
        kind, value = self._playing[number]
        if kind != Generator.HOLD:
            name, kind_name = self._prepared().plan.axes[number], Generator(kind).name.lower()
            raise Refused(
                f"reference of axis {name}: a {kind_name}; a hold is needed: `rtloop ctl setpoint {name} VALUE`"
            )
        return value

    def generator(self, options: ReferenceOptions) -> tuple[list[Any], Samples]:
        """Kind and parameters of a generator, and the samples of its table. Raises ConfigError."""
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
        """Have a generator take over, the lock being held; its table's samples go where the loop finds them.

        `restores` as in `set`. Raises ConfigError, Refused.
        """
        options = self._prepared().configuration.axes[number]
        limits = options.limits
        lowest, highest = extent(values, samples)
        if self._staging.in_raw_mode:
            if not limits.lowest_v <= lowest <= highest <= limits.drive_v:
                allowed = f"{limits.lowest_v:g} V … {limits.drive_v:g} V (limits.drive_v), and mode raw takes volts"
                raise unsuitable(f"reference: {volts(lowest, highest)}, beyond the axis's {allowed}")
        elif not (largest := max(-lowest, highest)) <= limits.command_um:
            limit = limits.command_um
            raise unsuitable(f"reference: reaches {largest:g}, beyond the axis's ±{limit:g} (limits.command_um)")
        elif not restores and (fault := _setpoint_fault(values, options.interlocks.position_um)) is not None:
            raise unsuitable(f"reference: {fault}")
        if samples.size:
            return self._submit_table(number, values, samples)
        return self._submit(number, [float(value) for value in values])

    def _submit(self, number: int, values: list[float], *, table: bool = False) -> int:
        """Have a generator take over, and note which one it is."""
        self.times_set[number] += 1
        if table:
            tick = self._staging.submit(Kind.SET_REFERENCE, number, values)
        else:
            tick = self._staging.desk.submit(Kind.SET_REFERENCE, axis=number, values=values)
        self._playing[number] = int(values[0]), values[1]
        return tick

    def _submit_table(self, number: int, values: list[Any], samples: Samples) -> int:
        """Play `samples` from the one of the axis's two places in the shared table that does not play now."""
        self._staging.require_settled()
        table, first_spare, axis_count = self._staging.block["table"], self._first_spare, len(self._places)
        capacity = (table.size - first_spare) // (2 * axis_count)
        if samples.size > capacity:
            raise unsuitable(f"waveform: {samples.size} samples; at most {capacity} are allowed")
        place = 1 - self._places[number]
        values[1] = first_spare + (2 * number + place) * capacity
        table[values[1] : values[1] + samples.size] = samples
        tick = self._submit(number, [float(value) for value in values], table=True)
        self._places[number] = place
        return tick


def _setpoint_fault(values: Sequence[float], position_limit_um: float) -> str | None:
    """Why the generator `values` is refused as a setpoint; None for one within the interlock, and for what moves."""
    return setpoint_fault(values[1], position_limit_um) if values[0] == Generator.HOLD else None


def axis_number(prepared: Prepared, name: str) -> int:
    """Raises ConfigError for a name that is no axis."""
    if name not in prepared.plan.axes:
        raise unsuitable(f"axis {name!r}: there are {', '.join(prepared.plan.axes)}")
    return prepared.plan.axes.index(name)


def unsuitable(message: str) -> ConfigError:
    """The error of a request that could be granted in no state."""
    return ConfigError("request", [message])
