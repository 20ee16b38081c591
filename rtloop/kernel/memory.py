"""Memory of a loop: the records of its axes, each followed by the records of its laws, and the snapshots.

    axis:  COEFFICIENTS | feedforward | controller        and likewise STATE

The slots for the records of laws have a fixed size in a run: the size of the longest record of its laws.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rtloop.kernel.extras import Extras
from rtloop.kernel.interlocks import TRIP
from rtloop.kernel.layout import (
    ALLOWED_COEFFICIENTS,
    ALLOWED_LOOP_STATE,
    ALLOWED_STATE,
    COEFFICIENTS,
    CONTROL,
    EXTRA_OUTPUT,
    LAW,
    LINE_BYTES,
    LOOP_STATE,
    MAX_EXTRAS,
    REVISION,
    RULE,
    STATE,
    Records,
)
from rtloop.kernel.validity import Allowed, Bits, require_allowed

NO_EXTRAS = Extras()
Slot = Literal["feedforward", "controller"]
RecordKind = Literal["coefficients", "state"]
Rules = Mapping[str, Allowed | Bits]


@dataclass(frozen=True)
class LawRecords:
    """Records of one kind of law: number of its axes (0 for a feedforward), types, allowed whole numbers."""

    name: str
    axes: int
    coefficients: np.dtype[np.void]
    state: np.dtype[np.void]
    allowed_coefficients: Rules
    allowed_state: Rules

    @property
    def slot(self) -> Slot:
        """Slot of an axis that the law fills: "controller", or "feedforward" for a law of 0 axes."""
        return "controller" if self.axes else "feedforward"


@dataclass(frozen=True)
class Layout:
    """Records of a loop with these laws, which are numbered in this order."""

    laws: tuple[LawRecords, ...]

    def slot_bytes(self, slot: Slot) -> tuple[int, int]:
        """Return the sizes of a slot for coefficients and for state, in bytes.

        Each is the size of the largest record among the laws that fill this slot, 0 if there is none.
        """
        slot_laws = [law for law in self.laws if law.slot == slot]
        return (
            max((law.coefficients.itemsize for law in slot_laws), default=0),
            max((law.state.itemsize for law in slot_laws), default=0),
        )

    @cached_property
    def coefficients(self) -> np.dtype[np.void]:
        """Type of an axis's coefficients: COEFFICIENTS, then `feedforward` and `controller` as bytes."""
        return self._extend_record(COEFFICIENTS, 0)

    @cached_property
    def state(self) -> np.dtype[np.void]:
        """Type of an axis's state: STATE, then `feedforward` and `controller` as bytes."""
        return self._extend_record(STATE, 1)

    def _extend_record(self, axis_record: np.dtype[np.void], part: int) -> np.dtype[np.void]:
        """Return the type of `axis_record` followed by both slots; `part` is 0 for coefficients, 1 for state."""
        slots: tuple[Slot, ...] = ("feedforward", "controller")
        return np.dtype([*axis_record.descr, *((slot, np.uint8, (self.slot_bytes(slot)[part],)) for slot in slots)])

    def snapshot_bytes(self, axes: int) -> int:
        """Return the length of a snapshot in bytes: tick, coefficients and states of the axes, state of the loop."""
        return 8 + axes * (self.coefficients.itemsize + self.state.itemsize) + LOOP_STATE.itemsize

    def slot_law(self, coefficients: np.void, slot: Slot) -> LawRecords | None:
        """Return the law in a slot of an axis with these coefficients.

        None for the slot "controller" if a preceding axis has the controller.
        """
        if slot == "controller" and not coefficients["controller_axes"]:
            return None
        return self.laws[int(coefficients[f"{slot}_law"])]

    def split_snapshot(
        self, snapshot: bytes | npt.NDArray[np.uint8], axes: int
    ) -> tuple[int, Records, Records, Records]:
        """Return tick, coefficients (axes,), states of the axes (axes,) and state of the loop (1,), aligned copies,
        from a snapshot of a loop's memory.

        Raises ValueError if the length does not fit `axes`, a count, an index or a switch is not allowed, a law is in a
        wrong slot, or an axis has not exactly one controller.
        """
        data = bytes(snapshot)
        if len(data) != self.snapshot_bytes(axes):
            raise ValueError(
                f"the snapshot has {len(data)} bytes; allowed for {axes} axes: {self.snapshot_bytes(axes)}"
            )
        offset, parts = 8, []
        for dtype, count in ((self.coefficients, axes), (self.state, axes), (LOOP_STATE, 1)):
            parts.append(copy_records(np.frombuffer(data, dtype, count, offset)))
            offset += count * dtype.itemsize
        coefficients, states, loop = parts
        for number in range(axes):
            self.require_allowed_axis(number, coefficients, states)
        require_owners(coefficients["controller_axes"].tolist())
        require_allowed("the loop", loop[0], ALLOWED_LOOP_STATE)
        return int.from_bytes(data[:8], "little"), coefficients, states, loop

    def require_allowed_axis(self, number: int, coefficients: Records, states: Records) -> None:
        """Raise ValueError if an integer field of axis `number` (from 0), or of its laws, is outside its allowed range.

        `coefficients` and `states` are the records of all axes. Also raises it for a law that controls another
        number of axes than the axis's field `controller_axes` states.
        """
        axis, state, owner = coefficients[number], states[number], f"axis {number}"
        require_allowed(owner, axis, {**ALLOWED_COEFFICIENTS, **self._law_number_rules(number, len(coefficients))})
        require_allowed(owner, state, ALLOWED_STATE)
        for slot in ("feedforward", "controller"):
            law = self.slot_law(axis, slot)
            if law is None:
                continue
            expected = int(axis["controller_axes"]) if slot == "controller" else 0
            if law.axes != expected:
                raise ValueError(
                    f"{slot}_law of {owner} is {law.name!r}, which states {law.axes} axes; allowed: {expected} axes "
                    "here (a feedforward states 0, a controller the axes that it controls)"
                )
            require_allowed(owner, slot_view(axis, slot, law.coefficients), law.allowed_coefficients)
            require_allowed(owner, slot_view(state, slot, law.state), law.allowed_state)

    def _law_number_rules(self, number: int, axes: int) -> Rules:
        """Return the ranges of `feedforward_law`, `controller_law` and `controller_axes`, by name, for axis `number` of
        `axes`.
        """
        laws = Allowed(0, len(self.laws) - 1)
        return {"feedforward_law": laws, "controller_law": laws, "controller_axes": Allowed(0, axes - number)}

    def description(self) -> dict[str, Any]:
        """Return the description of the layout in a recording; each type is as of `np.lib.format.dtype_to_descr`.

        Keys: `coefficients`, `state`, `loop_state` (types), `laws` (list of {name, axes, coefficients, state}; the last
        two are types), `sha256` of all these (hexadecimal text), `revision`.
        """
        tables = {"coefficients": COEFFICIENTS, "state": STATE, "loop_state": LOOP_STATE}
        content: dict[str, object] = {name: np.lib.format.dtype_to_descr(dtype) for name, dtype in tables.items()}
        content["laws"] = [
            {
                "name": law.name,
                "axes": law.axes,
                "coefficients": np.lib.format.dtype_to_descr(law.coefficients),
                "state": np.lib.format.dtype_to_descr(law.state),
            }
            for law in self.laws
        ]
        return {**content, "sha256": hashlib.sha256(repr(content).encode()).hexdigest(), "revision": REVISION}

    def rules(self) -> list[npt.NDArray[np.void]]:
        """Return the rules for coefficients of each law, in the order of the laws, as arrays of RULE records.

        Raises ValueError for a rule other than a range.
        """
        return [_rules(law.coefficients, law.allowed_coefficients) for law in self.laws]


def _rules(record: np.dtype[np.void], allowed: Rules) -> npt.NDArray[np.void]:
    """Return the allowed ranges of a record's whole numbers as RULE records. Raises ValueError for `Bits`."""
    rules = np.zeros(len(allowed), RULE)
    for rule, (name, limits) in zip(rules, allowed.items(), strict=True):
        if isinstance(limits, Bits):
            raise ValueError(
                f"coefficient {name}: the rule is a set of bits ({limits}); allowed: a range, of class Allowed"
            )
        kind, offset, *_ = record.fields[str(name)]  # type: ignore[index]
        rule["offset"], rule["octets"], rule["count"] = offset, kind.base.itemsize, max(int(np.prod(kind.shape)), 1)
        rule["low"], rule["high"], rule["step"] = limits
    return rules


def require_owners(controller_axes: Sequence[int]) -> None:
    """Raise ValueError unless each axis has exactly one controller.

    `controller_axes` has, for each axis, the count of axes of the controller that begins there, 0 for none.
    """
    owned_axes = 0
    for number, count in enumerate(controller_axes):
        if (count == 0) != (number < owned_axes):
            owners = "no controller" if count == 0 else "two controllers"
            raise ValueError(
                f"axis {number} has {owners}: its own field controller_axes is {count}, and controllers of axes before "
                f"it cover {max(owned_axes - number, 0)} axes from it on; allowed: one controller"
            )
        owned_axes = max(owned_axes, number + count)


def slot_view(axis: np.void, slot: Slot, dtype: np.dtype[np.void]) -> np.record:
    """Return a law's record in the slot of an axis's record `axis`, as a view with attributes."""
    return axis[slot][: dtype.itemsize].view(dtype).view(np.recarray)[0]


def new_records(dtype: np.dtype[np.void], count: int) -> Records:
    """Return zeroed records (count,), aligned to cache lines, whose fields are also attributes."""
    buffer = np.zeros(count * dtype.itemsize + LINE_BYTES, np.uint8)
    begin = -buffer.ctypes.data % LINE_BYTES
    return buffer[begin : begin + count * dtype.itemsize].view(dtype).view(np.recarray)


def copy_records(source: npt.NDArray[np.void]) -> Records:
    """Return a copy of records as `new_records` makes them: aligned to cache lines."""
    copy = new_records(source.dtype, source.size)
    copy[:] = source
    return copy


class LawMemory:
    """Coefficients and state of a loop, at rest or at a tick of a run, and `law`, the LAW record with their addresses.

    `functions` has one FUNCTIONS record for each law of the layout. The memory lives as long as this object.
    """

    def __init__(
        self,
        layout: Layout,
        functions: npt.NDArray[np.void],
        coefficients: Records,
        axes: Records,
        state: Records,
        extras: Extras = NO_EXTRAS,
    ) -> None:
        """Take the records without copying them: `axes` are the states of the axes, `state` is the loop's.

        `functions` is copied, and completed with the sizes and rules of the layout's laws. Raises ValueError as
        `Layout.rules` does. Coefficients and states are not checked.
        """
        self.layout, self.coefficients, self.axes, self.state = layout, coefficients, axes, state
        rules = layout.rules()
        self._functions, count = functions.copy(), 0
        for record, law, law_rules in zip(self._functions, layout.laws, rules, strict=True):
            record["axes"], record["coefficients_bytes"] = law.axes, law.coefficients.itemsize
            record["state_bytes"], record["first_rule"] = law.state.itemsize, count
            record["rule_count"] = len(law_rules)
            count += len(law_rules)
        self._arrays = {
            "coefficients": coefficients,
            "axes": axes,
            "loop": state,
            "controls": new_records(CONTROL, axes.size),
            "together": new_records(CONTROL, axes.size),
            "functions": self._functions,
            "rules": np.concatenate([np.zeros(0, RULE), *rules]),
            "result": np.zeros(1),
            "raised": np.zeros(1, np.int64),
            "trip": np.zeros(1, TRIP),
            "extra_inputs": np.zeros(MAX_EXTRAS),
            "extra_outputs": new_records(EXTRA_OUTPUT, MAX_EXTRAS),
        }
        for record, output in zip(self._arrays["extra_outputs"], extras.outputs, strict=False):
            record["value_v"] = record["safe_v"] = output.safe_v
            record["lowest_v"], record["highest_v"], record["axis"] = output.lowest_v, output.highest_v, output.axis
            record["mark"], record["level_um"] = output.mark, output.level_um
        self.records = new_records(LAW, 1)
        for name, array in self._arrays.items():
            self.records[name] = array.ctypes.data
        self.law = self.records[0]
        self.law.coefficients_bytes, self.law.axes_bytes = coefficients.itemsize, axes.itemsize
        self.law.axis_count, self.law.law_count = axes.size, len(layout.laws)
        self.law.extra_input_count, self.law.extra_output_count = len(extras.inputs), len(extras.outputs)
        self.law.extra_count = len(extras.inputs) + len(extras.outputs)
        coefficients_bytes, state_bytes = layout.slot_bytes("feedforward")
        self.law.controller_coefficients = COEFFICIENTS.itemsize + coefficients_bytes
        self.law.controller_state = STATE.itemsize + state_bytes

    @classmethod
    def create_at_rest(
        cls,
        layout: Layout,
        functions: npt.NDArray[np.void],
        coefficients: npt.NDArray[np.void],
        extras: Extras = NO_EXTRAS,
    ) -> LawMemory:
        """Return the memory of a loop at rest: mode OFF, outputs at their safe values, an actuator that never moved.

        `coefficients` are copied, and not checked. Raises ValueError as `Layout.rules` does.
        """
        owned_coefficients = copy_records(coefficients)
        axes = new_records(layout.state, owned_coefficients.size)
        axes["drive_v"] = owned_coefficients["safe_v"]
        return cls(layout, functions, owned_coefficients, axes, new_records(LOOP_STATE, 1), extras)

    def copy_arrays(self) -> dict[str, npt.NDArray[np.generic]]:
        """Return a copy of every array of the memory by name, for `restore_arrays`."""
        return {name: array.copy() for name, array in self._arrays.items()}

    def restore_arrays(self, copies: dict[str, npt.NDArray[np.generic]]) -> None:
        """Set every array to its copy, which this memory's `copy_arrays` returned."""
        for name, array in self._arrays.items():
            array[...] = copies[name]

    def slot_record(self, axis: int, slot: Slot, kind: RecordKind) -> np.record | None:
        """Return a view of the record of the law in a slot of an axis; None if a preceding axis has the controller."""
        law = self.layout.slot_law(self.coefficients[axis], slot)
        records = self.coefficients if kind == "coefficients" else self.axes
        return None if law is None else slot_view(records[axis], slot, getattr(law, kind))


def field_tables(
    layout: Layout, coefficients: Records, record_kind: RecordKind
) -> list[list[tuple[str, np.dtype[np.generic], int]]]:
    """Return, for each axis, (name, dtype, offset in bytes) of every field of its coefficients or state.

    The fields of its laws precede the slot's own entry, which has the remaining bytes of the slot.
    """
    tables: list[list[tuple[str, np.dtype[np.generic], int]]] = []
    for axis in coefficients:
        table = getattr(layout, record_kind)
        rows: list[tuple[str, np.dtype[np.generic], int]] = []
        for name, (dtype, start, *_) in table.fields.items():
            law = layout.slot_law(axis, name) if name in ("feedforward", "controller") else None
            if law is not None:
                inner = getattr(law, record_kind)
                rows += [(field, kind, start + place) for field, (kind, place, *_) in inner.fields.items()]
                start, dtype = start + inner.itemsize, np.dtype((np.uint8, (dtype.itemsize - inner.itemsize,)))
            rows.append((name, dtype, start))
        tables.append(rows)
    return tables
