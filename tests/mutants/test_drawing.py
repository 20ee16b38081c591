"""Mutants are drawn only where a change alters behaviour, and the same ones for one seed. Needs cosmic-ray."""

from __future__ import annotations

import pytest

pytest.importorskip("cosmic_ray", reason="cosmic-ray is missing: `make mutants` installs it")

from tests.mutants import draw, rooms
from tests.mutants.places import apply_change, places

SOURCE = '''"""1 + 1 is 2."""

def limited(value: int | None = 3, *, limit: float) -> float | None:
    if value is None or value - 1 > limit:
        raise ValueError(f"value is {value + 1}; allowed: {limit}", 7)
    return value

class Limit:
    def __repr__(self):
        return str(1 + 1)
'''


def test_only_what_changes_behaviour_is_mutated():
    texts = [apply_change(SOURCE, change) for changes in places(SOURCE).values() for change in changes]
    lines = {line.strip() for text in texts if text for line in set(text.splitlines()) - set(SOURCE.splitlines())}
    assert lines == {
        *(f"def limited(value: int | None = {value}, *, limit: float) -> float | None:" for value in (4, 2)),
        "if not value is None or value - 1 > limit:",
        "if value is not None or value - 1 > limit:",
        "if value is None and value - 1 > limit:",
        "if value is None or value + 1 > limit:",
        *(f"if value is None or value - {value} > limit:" for value in (2, 0)),
        *(f"if value is None or value - 1 {sign} limit:" for sign in (">=", "<=")),
    }


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """Return a folder with a small room of one module and a large room of eight."""
    monkeypatch.setattr(draw, "ROOMS", {name: rooms.Room(name, (), compiled=False) for name in ("small", "large")})
    for name, count in (("small", 1), ("large", 8)):
        (tmp_path / name).mkdir()
        for number in range(count):
            (tmp_path / name / f"{number}.py").write_text(SOURCE)
    return tmp_path


def test_drawing_depends_on_the_seed_alone_and_fewer_are_the_first_of_more(tree):
    first = draw.draw_mutants(20, 1, tree)
    assert first == draw.draw_mutants(20, 1, tree)
    assert first != draw.draw_mutants(20, 2, tree)
    fewer = draw.draw_mutants(8, 1, tree)
    for room, number in (("small", 4), ("large", 4)):
        of_room = [mutant for mutant in first if mutant.room == room]
        assert [mutant for mutant in fewer if mutant.room == room] == of_room[:number]


def test_no_place_is_drawn_twice(tree):
    mutants = draw.draw_mutants(60, 1, tree)
    assert len({(mutant.file, mutant.operator, mutant.occurrence) for mutant in mutants}) == len(mutants)
