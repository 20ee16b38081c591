"""Rows of events: the names of operators, which a slow service sends later, and late ticks in one row."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.engine.messages import MESSAGE, Kind, Origin
from rtloop.errors import UnavailableError
from rtloop.panel.events.events import MAX_ROWS, Events
from rtloop.panel.feed.feed import Feed
from rtloop.signals import Mode

KINDS = {"m": Kind.PERIODS_MISSED, "o": Kind.LATENESS_OVER, "t": Kind.TRIPPED}
LOOP: Any = SimpleNamespace(rate_hz=1000.0, axes={"x": {}}, values={})


def test_a_silent_service_is_asked_once_and_again_when_it_answers() -> None:
    resources: list[str] = []

    def exchange(_: str, resource: str, *__: object) -> tuple[int, str, bytes]:
        resources.append(resource)
        if len(resources) == 2:
            raise UnavailableError("no answer")
        return 200, "application/json", b'{"name": "ada"}'

    messages = np.zeros(50, MESSAGE)
    messages["kind"], messages["origin"], messages["identity"] = Kind.SET_MODE, Origin.OPERATOR, np.arange(50)
    service: Any = SimpleNamespace(client=SimpleNamespace(exchange=exchange, path=Path("none")))
    events = Events(service)
    events.append(messages, LOOP, 0)
    assert resources == ["/asked_by?identity=0", "/asked_by?identity=1"]
    names = [event["who"] for _, event in events.events_after(0)]
    assert (names[0], set(names[1:]), len(names)) == ("ada", {"operator"}, 50)
    number = events.newest
    events.append(messages[:0], LOOP, 0)
    assert resources[2:] == [f"/asked_by?identity={identity}" for identity in range(1, 50)]
    updated = events.events_after(number)
    assert ([event["who"] for _, event in updated], len(events.events_after(0))) == (["ada"] * 49, 50)
    events.append(messages[:0], LOOP, 0)
    assert len(resources) == 51


def make_messages(text: str, first: int = 0) -> np.ndarray:
    """Return a message for each word of, say, "m3 o9,2,6 t", a letter of KINDS and values, from tick `first` on."""
    messages = np.zeros(len(text.split()), MESSAGE)
    for place, word in enumerate(text.split()):
        values = [float(value) for value in word[1:].split(",") if value]
        messages[place]["tick"], messages[place]["kind"] = first + place, KINDS[word[0]]
        messages[place]["values"][: len(values)] = values
    return messages


def rows_after(events: Events, number: int = 0) -> list[tuple[int, str]]:
    """Return tick and text of each row that is new or has changed since the row number `number`."""
    return [(event["tick"], event["what"]["text"]) for _, event in events.events_after(number)]


def test_late_ticks_are_one_row_until_something_else_happens() -> None:
    events = Events(SimpleNamespace())  # type: ignore[arg-type]
    events.append(make_messages("m3"), LOOP, 0)
    assert rows_after(events) == [(0, "1 late tick, worst 3 ms")]
    events.append(make_messages("o9,2,6 m1 m2", 1), LOOP, 0)
    assert rows_after(events) == [(0, "4 late ticks, worst 6 ms")]
    assert rows_after(events, 1) == rows_after(events), "the row has grown, and is sent again"
    assert rows_after(events, events.newest) == []
    events.append(make_messages("t o20,12,8 m1", 4), LOOP, 0)
    assert [tick for tick, _ in rows_after(events)] == [0, 4, 6], "in the order in which they happened"
    assert rows_after(events)[::2] == [(0, "15 late ticks, worst 8 ms"), (6, "1 late tick, worst 1 ms")]
    events.append(make_messages("m1", 7), LOOP, 1)
    assert rows_after(events)[-1] == (7, "1 late tick, worst 1 ms"), "another run"


def test_lost_ticks_are_one_row_for_each_gap_with_number_and_cause() -> None:
    """A gap ends after a second without a lost tick, which is 1000 ticks here, and at the end of a run."""
    events = Events(SimpleNamespace())  # type: ignore[arg-type]
    add = lambda who, ticks, tick, run=0: events.add_lost_ticks(who, ticks, "the disk is full", tick, LOOP, run)
    for tick in range(0, 5000, 50):
        add("recorder", 50, tick)
    add("panel", 3, 4900)
    assert rows_after(events) == [
        (0, "5,000 ticks not recorded: the disk is full"),
        (4900, "3 ticks not shown: the disk is full"),
    ]
    add("recorder", 1, 5951)
    add("panel", 1, 4900, run=1)
    assert [(tick, text.split(":")[0]) for tick, text in rows_after(events)[2:]] == [
        (5951, "1 tick not recorded"),
        (4900, "1 tick not shown"),
    ]


def test_the_feed_reports_each_lost_tick_once() -> None:
    """Ticks that wait without a record count as soon as the recorder fails, and not again when it gives them up."""
    feed = Feed(SimpleNamespace())  # type: ignore[arg-type]
    feed.loop = LOOP
    reports = [(0, 0, None), (7, 100, "the disk is full"), (0, 160, "the disk is full"), (0, 150, None), (0, 160, None)]
    for number, (lost, unrecorded, reason) in enumerate(reports):
        stretch = Stretch(("tick",), 1000 + 100 * number, np.zeros((100, 1)), lost, run=0)
        reader: Any = SimpleNamespace(recording_state={"ticks_lost": unrecorded, "reason": reason})
        feed._report_lost_ticks(stretch, reader)
    texts = [text for _, text in rows_after(feed.events)]
    assert (texts[0][:19], texts[1]) == ("7 ticks not shown: ", "160 ticks not recorded: the disk is full")
    reader = SimpleNamespace(recording_state={"ticks_lost": 5, "reason": None})
    feed._report_lost_ticks(Stretch(("tick",), 0, np.zeros((100, 1)), 0, run=1), reader)
    assert rows_after(feed.events)[2][1].startswith("5 ticks not recorded: the recorder did not read them")


def test_late_ticks_push_off_no_trip() -> None:
    events = Events(SimpleNamespace())  # type: ignore[arg-type]
    events.append(make_messages("t"), LOOP, 0)
    for tick in range(1, 2 * MAX_ROWS, 2):
        events.append(make_messages("m3 o9,2,6", tick), LOOP, 0)
    assert [event["kind"] for _, event in events.events_after(0)] == ["tripped", "periods_missed"]
    assert events.events_after(0)[-1][1]["what"]["late_ticks"] == 2 * MAX_ROWS


def test_a_stop_names_its_operator_and_a_change_of_a_law_its_keys() -> None:
    """The names come from the service, at once or after a silence; a run without a schedule starts in mode off."""
    is_silent = [False]

    def exchange(_: str, resource: str, *__: object) -> tuple[int, str, bytes]:
        if is_silent[0]:
            raise UnavailableError("no answer")
        change = '"controller.gain 0.016 → 0.012"' if resource.endswith("=3") else "null"
        return 200, "application/json", f'{{"name": "bob", "change": {change}}}'.encode()

    messages = np.zeros(3, MESSAGE)
    messages["kind"] = Kind.SET_MODE, Kind.SET_MODE, Kind.LOAD_LAW
    messages["origin"], messages["identity"] = Origin.OPERATOR, (1, 2, 3)
    messages["values"][:, 0] = Mode.CLOSED_LOOP, Mode.OFF, 0.0
    service: Any = SimpleNamespace(client=SimpleNamespace(exchange=exchange, path=Path("none")))
    for is_silent[0] in (False, True):
        events = Events(service)
        events.append(messages, LOOP, 0)
        is_silent[0] = False
        events.append(messages[:0], LOOP, 0)
        rows = [(event["who"], event["what"]["text"]) for _, event in events.events_after(0)]
        texts = ["off → closed loop", "closed loop → off", "controller.gain 0.016 → 0.012"]
        assert rows == [("bob", text) for text in texts]
