"""Recordings of rtloop 0.1.0 as if they had been made today, for replay.

There one C(z) and one inverse lay within the records of the axes; both are plug-ins now, with records of their own.
What they compute has stayed the same to the bit. The pre-filter's has not: its taps were summed in another order, and a
change of mode did not fill it anew. So a recording with a pre-filter is refused, and any other can be replayed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtloop import signals
from rtloop.law.layout import LOOP_STATE, Records
from rtloop.law.memory import records, view
from rtloop.laws.registry import LawReference, layout_of
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Rows, Snapshot
from rtloop.recording.file.topics.checked import extras_of
from rtloop.recording.load import Recording

TABLES = ("coefficients", "state", "loop_state")
SHA256 = "d11a764170c4accb16ab09ec83cdbc666a1d7933f5be6d8c9e9fa79486a71348"
"""Of these tables in the header, as JSON: the one layout of the law before there were plug-ins."""
LAYOUT = layout_of((LawReference("prandtl_ishlinskii"), LawReference("transfer")))
"""Today's of such a law."""
TICK_BYTES = 8
WITHOUT_EFFECT = {"sums", "scratch", "tap_history", "tap_index", "section_history", "reserved"}
"""What a kernel writes before it reads it, the memory of a pre-filter that is not there, and fill."""


def as_of_today(recording: Recording) -> Recording:
    """The recording, or what it would be today where its columns are those of before."""
    if "imported" in recording.header or recording.columns == _columns(recording.header):
        return recording
    return EarlierRecording(recording.paths)


def with_effect(recording: Recording, law: bytes) -> bytes:
    """The law's bytes (those of a snapshot behind its tick) as far as a replay is to find the same."""
    if not isinstance(recording, EarlierRecording):
        return law
    _, *parts = LAYOUT.split(bytes(TICK_BYTES) + law, len(recording.header["axes"]))
    return _joined(*parts)


class EarlierRecording(Recording):
    """A recording with today's columns, and with today's snapshots where the layout of its law is known."""

    def __init__(self, paths: Sequence[Path]) -> None:
        super().__init__(paths)
        self._before, self._tables, law = self.columns, *_described(self.header["law"])
        self.columns = _columns(self.header)
        self.header = {**self.header, "columns": list(self.columns), "law": law}

    def blocks(self, names: Sequence[str] | None = None) -> Generator[Rows]:
        """As ever, with 0 for what was not recorded: nothing was added to a command."""
        wanted = self.columns if names is None else names
        places = [place for place, name in enumerate(wanted) if name in self._before]
        for rows in super().blocks([wanted[place] for place in places]):
            widened = np.zeros((len(rows), len(wanted)))
            widened[:, places] = rows
            yield widened

    def snapshots(self) -> Generator[Snapshot]:
        """As ever. Raises RecordingError for one that cannot be replayed."""
        for snapshot in super().snapshots():
            yield self._translated(snapshot) if self._tables else snapshot

    def _translated(self, snapshot: Snapshot) -> Snapshot:
        own, own_state, own_loop = self._split(snapshot)
        if own["tap_count"].any() or own["section_count"].any():
            raise RecordingError(
                f"{self.paths[0]}: recorded by rtloop 0.1.0 with a pre-filter, which is computed in another order now; "
                "replay it with that version"
            )
        coefficients, state = records(LAYOUT.coefficients, own.size), records(LAYOUT.state, own.size)
        loop = records(LOOP_STATE, 1)
        _copy(loop, own_loop)
        for axis in range(own.size):
            _copy(coefficients[axis], own[axis])
            _copy(state[axis], own_state[axis])
            for law in LAYOUT.laws:
                _copy(view(coefficients[axis], law.slot, law.coefficients), own[axis])
                _copy(view(state[axis], law.slot, law.state), own_state[axis])
        coefficients["resting_error"][:, 0] = own["resting_error"]
        coefficients["controller_law"] = coefficients["controller_axes"] = 1
        return Snapshot(snapshot.tick, snapshot.data[:TICK_BYTES] + _joined(coefficients, state, loop))

    def _split(self, snapshot: Snapshot) -> list[np.ndarray[Any, Any]]:
        axes = len(self.header["axes"])
        counts = (axes, axes, 1)
        ends = TICK_BYTES + np.cumsum([0, *(n * table.itemsize for n, table in zip(counts, self._tables, strict=True))])
        if len(snapshot.data) != ends[-1]:
            raise RecordingError(
                f"{self.paths[0]}: snapshot of the law at tick {snapshot.tick}: {len(snapshot.data)} bytes, but "
                f"{axes} axes take {ends[-1]}"
            )
        tables = zip(self._tables, counts, ends, strict=False)
        return [np.frombuffer(snapshot.data, table, count, begin) for table, count, begin in tables]


def _columns(header: Mapping[str, Any]) -> tuple[str, ...]:
    return signals.columns(header["axes"], header["observed"], extras_of(header).columns)


def _described(law: Mapping[str, Any]) -> tuple[list[np.dtype[Any]], Mapping[str, Any]]:
    """The types in a header, and what today's header would say; no types where their layout is not known."""
    text = json.dumps([law.get(name) for name in TABLES])
    if hashlib.sha256(text.encode()).hexdigest() != SHA256:
        return [], law
    fields = [[(name, kind, *map(tuple, shape)) for name, kind, *shape in law[table]] for table in TABLES]
    return [np.dtype(found) for found in fields], LAYOUT.description()


def _copy(target: Any, source: Any) -> None:
    """All fields that both have."""
    for name in set(target.dtype.names) & set(source.dtype.names):
        if target.dtype[name] == source.dtype[name]:
            target[name] = source[name]


def _joined(coefficients: Records, states: Records, loop: Records) -> bytes:
    """The bytes of a law without what has no effect: states of C(z) beyond its order are none either."""
    feedforward, controller = LAYOUT.laws
    for axis, state in zip(coefficients, states, strict=True):
        own = [state, *(view(state, law.slot, law.state) for law in (feedforward, controller))]
        for record in own:
            for name in WITHOUT_EFFECT.intersection(record.dtype.names):
                record[name] = 0
        own[-1]["controller"][view(axis, controller.slot, controller.coefficients)["order"] :] = 0.0
    return coefficients.tobytes() + states.tobytes() + loop.tobytes()
