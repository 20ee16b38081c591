"""Events as a person at the bench reads them."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.engine.messages import MESSAGE, Kind
from rtloop.law.reference import Generator
from rtloop.panel.views.words import words
from rtloop.recording.file.topics.events import event_of
from rtloop.signals import Flag, Mode


@pytest.mark.parametrize(
    ("kind", "values", "said"),
    [
        (Kind.SET_REFERENCE, (Generator.HOLD, 12.5), "12.5"),
        (Kind.SET_REFERENCE, (Generator.SINE, 9.0, 1.0, 0.0), "sine of 9 at 1 Hz"),
        (Kind.SET_REFERENCE, (Generator.TRIANGLE, 20.0, 10.0, -2.0), "triangle of 20 at 10 Hz about -2"),
        (Kind.SET_REFERENCE, (Generator.CHIRP, 1.0, 10.0, 500.0, 4.0), "chirp of 1 from 10 to 500 Hz in 4 s"),
        (Kind.SET_REFERENCE, (Generator.TABLE, 524288.0, 2.0, 1000.0, 1.0), "2 samples, again and again"),
        (Kind.SET_REFERENCE, (Generator.TABLE, 0.0, 1.0, 1.0, 0.0), "1 sample, once"),
        (Kind.SET_REFERENCE, (Generator.INPUT, 1.0), "an input"),
        (Kind.SET_MODE, (Mode.CLOSED_LOOP,), "closed loop"),
        (Kind.LOAD_LAW, (1.0,), "another controller"),
        (Kind.LOAD_LAW, (0.0,), "other numbers"),
        (Kind.TRIPPED, (float(Flag.TRIP_POSITION), 61.0, 60.0, float(Flag.TRIP_POSITION)),
         "x: position 61 µm, its limit 60 µm"),
        (Kind.PARKED, (), ""),
    ],
)  # fmt: skip
def test_what_an_event_is_about(kind: Kind, values: tuple[float, ...], said: str) -> None:
    record = np.zeros((), MESSAGE)
    record["kind"] = kind
    record["values"][: len(values)] = values
    assert words(event_of(record, ["x"], 0)) == said  # type: ignore[arg-type]
