"""Every planted mistake fits the current sources, and a stale one is reported."""

from __future__ import annotations

from dataclasses import replace

from tests.planted.mistakes import all_mistakes


def test_every_mistake_can_be_planted():
    mistakes = all_mistakes()
    assert len({mistake.name for mistake in mistakes}) == len(mistakes) > 0
    assert {mistake.name: fault for mistake in mistakes if (fault := mistake.fault())} == {}


def test_an_entry_that_no_longer_fits_is_told(tmp_path):
    mistake = replace(all_mistakes()[0], file="a.py", old="one", new="two", tests=("a.py::test_it",))
    (tmp_path / "a.py").write_text("one")
    assert mistake.fault(tmp_path) is None
    for text, fault in (("", "0 times"), ("one, one", "2 times")):
        (tmp_path / "a.py").write_text(text)
        assert fault in str(mistake.fault(tmp_path))
    (tmp_path / "a.py").write_text("one")
    assert "no such file" in str(replace(mistake, tests=("b.py",)).fault(tmp_path))
