"""After a reload that the loop accepts in part, the service knows the running law; the next reload adds the rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.engine.commands import QueueFull
from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import Kind
from rtloop.errors import ConfigError
from rtloop.service.changing.live import LiveLaw
from rtloop.service.changing.preview import loop_figures
from rtloop.service.desk import Refusal, UnconfirmedCommand

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
TEXT = (DEPLOY / "two-axis.toml").read_text(encoding="utf-8")
FIRST, SECOND = (axis.name for axis in parse(TEXT, "lab", DEPLOY, "lab.toml").axes)


class FakeDesk:
    """Desk that accepts commands, refuses those in `refuses` and all if `is_full`, and does not confirm the kinds in
    `unconfirmed`.
    """

    def __init__(self) -> None:
        self.refuses: set[tuple[Kind, int]] = set()
        self.unconfirmed: set[Kind] = set()
        self.is_full = False
        self.accepted: list[tuple[Kind, int]] = []

    def submit(self, kind: Kind, *, axis: int, values=(), change: str | None = None) -> int:
        if self.is_full:
            raise QueueFull("256 commands wait for the loop already; try again")
        if (kind, axis) in self.refuses:
            raise Refusal(f"{kind.name.lower()}: refused at tick 7, because the loop is tripped or is stopping")
        if kind in self.unconfirmed:
            raise UnconfirmedCommand("the loop has taken the command and stands still")
        self.accepted.append((kind, axis))
        return 7


def prepare_changed(*changes: tuple[str, str]) -> Prepared:
    """Return the prepared two-axis configuration; each of `changes` replaces a text on both axes."""
    text = TEXT
    for old, new in changes:
        assert text.count(old) >= 2, old
        text = text.replace(old, new)
    return prepare(parse(text, "lab", DEPLOY, "lab.toml"), paced=False)


@pytest.fixture
def live():
    """Return a live law with two axes, on a desk that the test controls."""
    before = prepare_changed()
    sizes = before.plan.sizes._replace(table_samples=1000)
    return LiveLaw(before, SharedBlock.create(sizes), FakeDesk(), {})  # type: ignore[arg-type]


TIGHTER = ("position_um = 60.0", "position_um = 50.0")


def position_limits_um(live: LiveLaw) -> list[float]:
    """Return the position limit (µm) of each axis, which is the same in configuration and coefficients."""
    limits_um = [axis.interlocks.position_um for axis in live.prepared.configuration.axes]
    assert np.asarray(live.prepared.plan.coefficients)["position_limit_um"].tolist() == limits_um
    return limits_um


def test_what_one_axis_refused_is_not_noted_and_comes_with_the_next_reload(live):
    desk = live._staging.desk
    desk.refuses.add((Kind.LOAD_LAW, 1))
    with pytest.raises(Refusal, match=f"tripped or is stopping; these axes are changed already: axis.{FIRST}"):
        live.replace_all(prepare_changed(TIGHTER))
    assert position_limits_um(live) == [50.0, 60.0]
    desk.refuses.clear()
    assert live.replace_all(prepare_changed(TIGHTER)) == [f"axis.{SECOND}"]
    assert position_limits_um(live) == [50.0, 50.0]
    assert desk.accepted == [(Kind.LOAD_LAW, 0), (Kind.LOAD_LAW, 1)]
    assert live.replace_all(prepare_changed(TIGHTER)) == []


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("rate_hz = 10000", "rate_hz = 10000\nspin_us = 7.0", "loop"),
        ("seed = 1", "seed = 77", "driver"),
        ("um_per_v = ", "um_per_v = 1", "driver.channels"),
    ],
)
def test_a_part_that_needs_a_restart_is_named_as_in_the_file(live, old: str, new: str, place: str):
    assert old in TEXT
    changed = prepare(parse(TEXT.replace(old, new, 1), "lab", DEPLOY, "lab.toml"), paced=False)
    with pytest.raises(Refusal, match=rf"^{place}: changed in the configuration file; restart the service to apply"):
        live.replace_all(changed)


def test_what_is_known_of_a_loop_is_that_of_the_law_that_runs(live):
    before, changed = live.prepared.checks, prepare_changed(("gain = 0.016", "gain = 0.012"))
    live._staging.desk.refuses.add((Kind.LOAD_LAW, 1))
    with pytest.raises(Refusal):
        live.replace_all(changed)
    assert live.prepared.checks == (changed.checks[0], before[1])
    assert live.prepared.checks[0].margins.gain_margin > 1.2 * before[0].margins.gain_margin


def test_a_refusal_of_the_first_changes_nothing(live):
    live._staging.desk.refuses.add((Kind.LOAD_LAW, 0))
    with pytest.raises(Refusal, match=r"tripped or is stopping$"):
        live.replace_all(prepare_changed(TIGHTER))
    assert position_limits_um(live) == [60.0, 60.0]


def test_a_reference_that_was_refused_is_played_by_the_next_reload(live):
    text = TEXT.replace("levels = [10.0, 0.0]", "levels = [5.0, 0.0]").replace("amplitude = 20.0", "amplitude = 9.0")
    changed = prepare(parse(text, "lab", DEPLOY, "lab.toml"), paced=False)
    live._staging.desk.refuses.add((Kind.SET_REFERENCE, 1))
    with pytest.raises(Refusal, match=f"changed already: axis.{FIRST}"):
        live.replace_all(changed)
    live._staging.desk.refuses.clear()
    assert live.replace_all(changed) == [f"axis.{SECOND}"]
    assert live._staging.desk.accepted == [(Kind.SET_REFERENCE, 0), (Kind.SET_REFERENCE, 1)]


def test_undo_leaves_the_reference_that_came_after_the_change(live, monkeypatch: pytest.MonkeyPatch):
    """After a tuned limit and a reload that changed the reference of the axis, undo restores the limit alone."""
    monkeypatch.setattr("rtloop.service.changing.live.prepare_limited", prepare)
    live.tune(FIRST, "interlocks", {"position_um": 50.0})
    text = TEXT.replace("levels = [10.0, 0.0]", "levels = [5.0, 0.0]").replace("amplitude = 20.0", "amplitude = 9.0")
    text = text.replace(*TIGHTER)
    changed = prepare(parse(text, "lab", DEPLOY, "lab.toml"), paced=False)
    live._staging.desk.refuses.add((Kind.SET_REFERENCE, 1))
    with pytest.raises(Refusal, match="changed already"):
        live.replace_all(changed)
    live.undo(FIRST)
    first = live.current_configuration["values"]["axis"][0]
    assert first["reference"] == changed.configuration.axes[0].reference.model_dump(mode="json", exclude_unset=True)
    assert position_limits_um(live) == [60.0, 50.0]


def test_a_preview_compares_with_the_law_of_its_axis(live, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rtloop.service.changing.live.prepare_limited", prepare)
    monkeypatch.setattr(
        "rtloop.service.changing.live.figures_limited", lambda c, *rest: loop_figures(prepare(c), *rest)
    )
    live.tune(SECOND, "controller", {"gain": 0.012})
    first_hz, second_hz = (
        live.preview(axis, "limits", {"command_um": 40.0})["before"]["crossover_hz"] for axis in (FIRST, SECOND)
    )
    assert second_hz < 0.9 * first_hz


def test_a_reload_ends_what_can_be_undone_and_one_that_changes_nothing_does_not(live, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rtloop.service.changing.live.prepare_limited", prepare)
    live.tune(FIRST, "interlocks", {"position_um": 50.0})
    live.replace_all(live.prepared)
    live.undo(FIRST)
    assert position_limits_um(live) == [60.0, 60.0]
    live.tune(FIRST, "interlocks", {"position_um": 50.0})
    assert live.replace_all(prepare_changed()) == [f"axis.{FIRST}"]
    with pytest.raises(Refusal, match="has no change since"):
        live.undo(FIRST)


def test_a_change_that_may_still_be_loaded_is_noted_as_loaded(live, monkeypatch: pytest.MonkeyPatch):
    """A loop that stands still loads the change when it continues; until then the next change is refused."""
    monkeypatch.setattr("rtloop.service.changing.live.prepare_limited", prepare)
    live._staging.desk.unconfirmed.add(Kind.LOAD_LAW)
    with pytest.raises(UnconfirmedCommand):
        live.tune(SECOND, "interlocks", {"position_um": 50.0})
    assert position_limits_um(live) == [60.0, 50.0]
    live._staging.desk.unconfirmed.clear()
    with pytest.raises(Refusal, match="stands still"):
        live.tune(FIRST, "interlocks", {"position_um": 50.0})
    live._staging.block["ticks_head"][0] += 2
    live.tune(FIRST, "interlocks", {"position_um": 50.0})
    assert position_limits_um(live) == [50.0, 50.0]


def test_each_waveform_has_a_place_of_its_own_until_the_next_but_one(live):
    """The table has four places for two axes: a place that plays is never overwritten."""
    table, played = live._staging.block["table"], []
    live._staging.desk.submit = lambda kind, *, axis, values=(), change=None: played.append((axis, values)) or 7
    for number, axis in enumerate((FIRST, SECOND, SECOND, FIRST, SECOND, FIRST)):
        live.references.set_waveform(axis, np.full((100, 1), 1.0 + number), 1, repeat=False)
        _, (_, start, count, *_) = played[-1]
        assert (count, live.prepared.plan.table.size <= start <= table.size - 100) == (100, True)
        np.testing.assert_array_equal(table[int(start) : int(start) + 100], 1.0 + number)
        newest = {axis: int(values[1]) for axis, values in played}
        for playing_axis, first in newest.items():
            playing_number = max(k for k, (axis, _) in enumerate(played) if axis == playing_axis)
            np.testing.assert_array_equal(table[first : first + 100], 1.0 + playing_number)
    assert len({int(values[1]) for _, values in played}) == 4


def test_samples_wait_for_a_loop_that_may_still_read_the_earlier_ones(live):
    live._staging.desk.unconfirmed.add(Kind.SET_REFERENCE)
    with pytest.raises(UnconfirmedCommand):
        live.references.set_waveform(FIRST, np.ones((100, 1)), 1, repeat=False)
    live._staging.desk.unconfirmed.clear()
    with pytest.raises(Refusal, match="stands still"):
        live.references.set_waveform(FIRST, np.ones((100, 1)), 1, repeat=False)


def test_samples_do_not_wait_for_a_held_value_which_lies_in_the_command_itself(live):
    live._staging.desk.unconfirmed.add(Kind.SET_REFERENCE)
    with pytest.raises(UnconfirmedCommand):
        live.references.set(FIRST, {"kind": "hold", "value": 1.0})
    live._staging.desk.unconfirmed.clear()
    assert live.references.set_waveform(FIRST, np.ones((100, 1)), 1, repeat=False) == 7


@pytest.mark.parametrize(
    "reference",
    [{"kind": "sawtooth"}, {"kind": "hold", "value": "5 µm"}, {"kind": "table", "file": "nowhere.csv"}],
)
def test_a_reference_that_is_none_is_a_fault_of_the_request(live, reference: dict):
    with pytest.raises(ConfigError, match="reference"):
        live.references.set(FIRST, reference)
    assert live._staging.desk.accepted == []


def test_a_refused_tare_does_not_come_with_the_next_change(live):
    def loaded_offsets_v() -> list[float]:
        size = live.prepared.plan.coefficients.dtype.itemsize
        staged = live._staging.block["staged"][: 2 * size].tobytes()
        return np.frombuffer(staged, live.prepared.plan.coefficients.dtype)["offset_v"].tolist()

    desk = live._staging.desk
    desk.refuses |= {(Kind.LOAD_LAW, 0), (Kind.LOAD_LAW, 1)}
    with pytest.raises(Refusal):
        live.tare(1, 0.4)
    desk.refuses.clear()
    assert live.tare(0, 0.25) == 7
    desk.refuses.add((Kind.LOAD_LAW, 0))
    with pytest.raises(Refusal):
        live.tare(0, 0.5)
    desk.refuses.clear()
    desk.is_full = True
    with pytest.raises(QueueFull):
        live.tare(0, 0.6)
    desk.is_full = False
    live.replace_all(prepare_changed(TIGHTER))
    assert loaded_offsets_v() == [0.25, 0.0]
    desk.unconfirmed.add(Kind.LOAD_LAW)
    with pytest.raises(UnconfirmedCommand):
        live.tare(0, 0.75)  # the loop may have loaded this tare, so the next change must keep it
    desk.unconfirmed.clear()
    live._staging.block["ticks_head"][0] = 10  # the loop continues
    live.tare(1, 0.1)
    live.replace_all(prepare_changed())
    assert loaded_offsets_v() == [0.75, 0.1]
