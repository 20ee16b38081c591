"""A reload that the loop takes in part leaves no doubt about what runs: the next one applies the rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import Kind
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Refusal

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
TEXT = (DEPLOY / "two-axis.toml").read_text(encoding="utf-8")
FIRST, SECOND = (axis.name for axis in parse(TEXT, "lab", DEPLOY, "lab.toml").axes)


class FakeDesk:
    """Takes commands, but for those of the axes and kinds in `refuses`."""

    def __init__(self) -> None:
        self.refuses: set[tuple[Kind, int]] = set()
        self.taken: list[tuple[Kind, int]] = []

    def submit(self, kind: Kind, *, axis: int, values=(), change: str | None = None) -> int:
        if (kind, axis) in self.refuses:
            raise Refusal(f"{kind.name.lower()}: refused at tick 7: the loop is tripped or stops")
        self.taken.append((kind, axis))
        return 7


def prepared(*changes: tuple[str, str]) -> Prepared:
    text = TEXT
    for old, new in changes:
        assert text.count(old) >= 2, old
        text = text.replace(old, new)
    return prepare(parse(text, "lab", DEPLOY, "lab.toml"), paced=False)


@pytest.fixture
def live():
    before = prepared()
    sizes = before.plan.sizes._replace(table_samples=1000)
    return LiveLaw(before, SharedBlock.create(sizes), FakeDesk(), {})  # type: ignore[arg-type]


TIGHTER = ("position_um = 60.0", "position_um = 50.0")


def positions_um(live: LiveLaw) -> list[float]:
    """What is noted of the loop, in the configuration and in the coefficients alike."""
    noted = [axis.interlocks.position_um for axis in live.prepared.configuration.axes]
    assert np.asarray(live.prepared.plan.coefficients)["position_limit_um"].tolist() == noted
    return noted


def test_what_one_axis_refused_is_not_noted_and_comes_with_the_next_reload(live):
    desk = live._staging.desk
    desk.refuses.add((Kind.LOAD_LAW, 1))
    with pytest.raises(Refusal, match=f"tripped or stops; these axes are changed already: axis.{FIRST}"):
        live.replace_all(prepared(TIGHTER))
    assert positions_um(live) == [50.0, 60.0]
    desk.refuses.clear()
    assert live.replace_all(prepared(TIGHTER)) == [f"axis.{SECOND}"]
    assert positions_um(live) == [50.0, 50.0]
    assert desk.taken == [(Kind.LOAD_LAW, 0), (Kind.LOAD_LAW, 1)]
    assert live.replace_all(prepared(TIGHTER)) == []


def test_what_is_known_of_a_loop_is_that_of_the_law_that_runs(live):
    before, other = live.prepared.checks, prepared(("gain = 0.016", "gain = 0.012"))
    live._staging.desk.refuses.add((Kind.LOAD_LAW, 1))
    with pytest.raises(Refusal):
        live.replace_all(other)
    assert live.prepared.checks == (other.checks[0], before[1])
    assert live.prepared.checks[0].margins.gain_margin > 1.2 * before[0].margins.gain_margin


def test_a_refusal_of_the_first_changes_nothing(live):
    live._staging.desk.refuses.add((Kind.LOAD_LAW, 0))
    with pytest.raises(Refusal, match=r"tripped or stops$"):
        live.replace_all(prepared(TIGHTER))
    assert positions_um(live) == [60.0, 60.0]


def test_a_reference_that_was_refused_is_played_by_the_next_reload(live):
    text = TEXT.replace("levels = [10.0, 0.0]", "levels = [5.0, 0.0]").replace("amplitude = 20.0", "amplitude = 9.0")
    other = prepare(parse(text, "lab", DEPLOY, "lab.toml"), paced=False)
    live._staging.desk.refuses.add((Kind.SET_REFERENCE, 1))
    with pytest.raises(Refusal, match=f"changed already: axis.{FIRST}"):
        live.replace_all(other)
    live._staging.desk.refuses.clear()
    assert live.replace_all(other) == [f"axis.{SECOND}"]
    assert live._staging.desk.taken == [(Kind.SET_REFERENCE, 0), (Kind.SET_REFERENCE, 1)]


def test_undo_leaves_the_reference_that_came_after_the_change(live, monkeypatch: pytest.MonkeyPatch):
    """A tuned limit, then a reload of which the reference of that axis was taken: the limit alone goes back."""
    monkeypatch.setattr("rtloop.service.changing.live.prepare_limited", prepare)
    live.tune(FIRST, "interlocks", {"position_um": 50.0})
    text = TEXT.replace("levels = [10.0, 0.0]", "levels = [5.0, 0.0]").replace("amplitude = 20.0", "amplitude = 9.0")
    text = text.replace(*TIGHTER)
    other = prepare(parse(text, "lab", DEPLOY, "lab.toml"), paced=False)
    live._staging.desk.refuses.add((Kind.SET_REFERENCE, 1))
    with pytest.raises(Refusal, match="changed already"):
        live.replace_all(other)
    live.undo(FIRST)
    first = live.current_configuration["values"]["axis"][0]
    assert first["reference"] == other.configuration.axes[0].reference.model_dump(mode="json", exclude_unset=True)
    assert positions_um(live) == [60.0, 50.0]
