"""Events have texts, and changes of reference, mode and law show the old and the new value."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rtloop.engine.messages import MESSAGE, Kind
from rtloop.kernel.reference import Generator
from rtloop.panel.events.event_text import RunState, event_text
from rtloop.recording.file.topics.events import event_from_message
from rtloop.signals import Flag, Mode


@pytest.mark.parametrize(
    ("kind", "values", "text"),
    [
        (Kind.SET_REFERENCE, (Generator.HOLD, 12.5), "12.5"),
        (Kind.SET_REFERENCE, (Generator.SINE, 9.0, 1.0, 0.0), "sine of 9 at 1 Hz"),
        (Kind.SET_REFERENCE, (Generator.TRIANGLE, 20.0, 10.0, -2.0), "triangle of 20 at 10 Hz about -2"),
        (Kind.SET_REFERENCE, (Generator.CHIRP, 1.0, 10.0, 500.0, 4.0), "chirp of 1 from 10 to 500 Hz in 4 s"),
        (Kind.SET_REFERENCE, (Generator.TABLE, 524288.0, 2.0, 1000.0, 1.0), "2 samples, repeated"),
        (Kind.SET_REFERENCE, (Generator.TABLE, 0.0, 1.0, 1.0, 0.0), "1 sample, once"),
        (Kind.SET_REFERENCE, (Generator.INPUT, 1.0), "an input"),
        (Kind.SET_MODE, (Mode.CLOSED_LOOP,), "closed loop"),
        (Kind.LOAD_LAW, (1.0,), "another controller"),
        (Kind.LOAD_LAW, (0.0,), "other coefficients"),
        (Kind.TRIPPED, (float(Flag.TRIP_POSITION), 61.0, 60.0, float(Flag.TRIP_POSITION)),
         "x: position 61 µm, its limit 60 µm"),
        (Kind.PARKED, (), ""),
    ],
)  # fmt: skip
def test_each_kind_of_event_has_its_text(kind: Kind, values: tuple[float, ...], text: str) -> None:
    record = np.zeros((), MESSAGE)
    record["kind"] = kind
    record["values"][: len(values)] = values
    assert event_text(event_from_message(record, ["x"], 0)) == text  # type: ignore[arg-type]


def change_texts(configured: dict, *messages: tuple[Kind, tuple[float, ...]]) -> list[str]:
    """Return the text of each event of a run of axis x, which begins with the reference `configured`."""
    run = RunState({"x": {"reference": configured}})
    records = np.zeros(len(messages), MESSAGE)
    for record, (kind, values) in zip(records, messages, strict=True):
        record["kind"] = kind
        record["values"][: len(values)] = values
    return [run.describe_change(event_from_message(record, ["x"], 0)) for record in records]  # type: ignore[arg-type]


def test_a_change_shows_the_old_and_the_new_value() -> None:
    sine = {"kind": "sine", "amplitude": 8.0, "offset": 20.0, "frequency_hz": 5.0}
    set_to = lambda value: (Kind.SET_REFERENCE, (Generator.HOLD, value))
    mode = lambda mode: (Kind.SET_MODE, (mode,))
    assert change_texts(sine, mode(Mode.CLOSED_LOOP), set_to(12.5), set_to(-3.0), mode(Mode.OFF)) == [
        "closed loop",
        "sine of 8 µm at 5 Hz about 20 µm → 12.5 µm",
        "12.5 µm → -3 µm",
        "closed loop → off",
    ]
    trip = (Kind.TRIPPED, (float(Flag.TRIP_POSITION), 61.0, 60.0, float(Flag.TRIP_POSITION)))
    assert change_texts({}, set_to(1.0), mode(Mode.CLOSED_LOOP), trip, mode(Mode.CLOSED_LOOP))[::3] == [
        "0 µm → 1 µm",
        "off → closed loop",
    ]


def test_references_in_raw_mode_are_in_volts_and_unknown_ones_are_left_out() -> None:
    """A change to or from mode raw makes the loop hold the value in force, which no event contains."""
    set_to = lambda value: (Kind.SET_REFERENCE, (Generator.HOLD, value))
    raw, closed = (Kind.SET_MODE, (Mode.RAW,)), (Kind.SET_MODE, (Mode.CLOSED_LOOP,))
    assert change_texts({}, raw, set_to(2.0), set_to(3.0), closed, set_to(1.0)) == [
        "raw", "2 V", "2 V → 3 V", "raw → closed loop", "1 µm",
    ]  # fmt: skip


def test_the_reference_of_each_axis_is_the_one_that_was_started_last() -> None:
    sine = {"kind": "sine", "amplitude": 8.0, "offset": 20.0, "frequency_hz": 5.0}
    run = RunState({"x": {"reference": sine}, "y": {}, "z": {"reference": {"kind": "steps", "levels": [1.0, 2.0]}}})

    def references_after(kind: Kind, *values: float, axis: int = 0) -> dict[str, Any]:
        """Return the reference of each axis after an event of this kind; axis −1 stands for all axes."""
        record = np.zeros((), MESSAGE)
        record["kind"], record["axis"] = kind, axis
        record["values"][: len(values)] = values
        run.describe_change(event_from_message(record, ["x", "y", "z"], 0))  # type: ignore[arg-type]
        return {name: tuple(reference) for name, reference in run.references.items()}

    first = {
        "x": ("sine", "sine of 8 µm at 5 Hz about 20 µm", None),
        "y": ("hold", "0 µm", 0.0),
        "z": ("steps", "", None),
    }
    assert references_after(Kind.SET_MODE, Mode.CLOSED_LOOP) == first
    assert references_after(Kind.SET_REFERENCE, Generator.HOLD, 12.5) == first | {"x": ("hold", "12.5 µm", 12.5)}
    assert references_after(Kind.SET_REFERENCE, Generator.TRIANGLE, 2.0, 3.0, 0.0, axis=1)["y"][0] == "triangle"
    assert references_after(Kind.SET_MODE, Mode.RAW) == dict.fromkeys("xyz", ("hold", "", None)), "the present drive"
    assert references_after(Kind.SET_REFERENCE, Generator.HOLD, 1.5, axis=-1) == dict.fromkeys(
        "xyz", ("hold", "1.5 V", 1.5)
    )


def test_a_table_of_samples_has_no_unit() -> None:
    table = (Kind.SET_REFERENCE, (Generator.TABLE, 0.0, 300.0, 1.0, 0.0))
    back = (Kind.SET_REFERENCE, (Generator.HOLD, 5.0))
    assert change_texts({"value": 5.0}, table, back) == ["5 µm → 300 samples, once", "300 samples, once → 5 µm"]


def test_a_change_of_a_law_has_the_text_of_the_service() -> None:
    record = np.zeros((), MESSAGE)
    record["kind"] = Kind.LOAD_LAW
    event = event_from_message(record, ["x"], 0)  # type: ignore[arg-type]
    event["what"]["change"] = "controller.gain 0.016 → 0.012"
    assert event_text(event) == "controller.gain 0.016 → 0.012"
