"""The tool that plants mistakes tells dead mutants from survivors, computes their score and selects tests."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass

import pytest

from tests.mutants import choice
from tests.mutants.account import (
    EQUIVALENT,
    Equivalent,
    Result,
    Verdict,
    append_result,
    read_equivalents,
    read_results,
    summarise_results,
)
from tests.mutants.mutant import Mutant
from tests.mutants.rooms import MIN_PER_ROOM, ROOMS, ROOT, room_sources, room_tests, shares
from tests.mutants.trees import Tree
from tests.mutants.trial import Trial

pytestmark = pytest.mark.system

SOURCE = """def limited(value, limit):
    if value > limit:
        return limit
    return value
"""
TEST = """from rtloop.limits import limited

def test_a_value_beyond_the_limit_is_the_limit():
    assert limited(3, 2) == 2
"""


def make_mutant(room: str = "kernel", after: str = "if value <= limit:") -> Mutant:
    """Return a mutant of line 2 of a module; `after` is the changed line."""
    return Mutant(room, "rtloop/foundation/modal.py", 2, "operator", hash(after), "if value > limit:", after)


@dataclass
class Scratch:
    """A project of one module with tests, in a temporary folder."""

    tree: Tree

    def verdict(self, text: str, tests: tuple[str, ...]) -> Result:
        """Run `tests` with `text` as the module's source; return the result."""
        trial = Trial(
            self.tree, make_mutant()._replace(file="rtloop/limits.py"), text, dict.fromkeys(tests, 1.0), compiled=True
        )
        while (result := trial.result()) is None:
            time.sleep(0.01)
        return result


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    """Return a scratch project whose mutants all have the key "key"."""
    project = tmp_path / "project"
    files = {
        "rtloop/limits.py": SOURCE,
        "tests/test_limits.py": TEST,
        "tests/recordings/test_limits.py": TEST,
        "recordings/run.mcap": "",
        "pytest.ini": "[pytest]\n",
    }
    for name, text in files.items():
        (project / name).parent.mkdir(parents=True, exist_ok=True)
        (project / name).write_text(text)
    monkeypatch.setattr(Mutant, "key", "key")
    return Scratch(Tree(tmp_path / "work", project))


def test_a_mutant_that_a_test_sees_dies_and_one_that_none_sees_survives(scratch):
    test = "tests/test_limits.py::test_a_value_beyond_the_limit_is_the_limit"
    died = scratch.verdict(SOURCE.replace(">", "<="), (test,))
    assert (died.verdict, died.test) == (Verdict.DIED, test)
    assert (scratch.tree.root / "rtloop/limits.py").read_text() == SOURCE
    survived = scratch.verdict(SOURCE.replace(">", ">="), (test,))
    assert (survived.verdict, survived.test) == (Verdict.SURVIVED, "")
    assert scratch.verdict(SOURCE.replace(">", "<="), ()).verdict is Verdict.UNTESTED


def test_a_test_that_is_not_there_is_no_death(scratch):
    with pytest.raises(RuntimeError, match="exit code is 4"):
        scratch.verdict(SOURCE, ("tests/test_limits.py::test_of_another_name",))


def test_a_copy_leaves_out_recordings_of_the_project_and_no_folder_of_tests(scratch):
    assert (scratch.tree.root / "tests/recordings/test_limits.py").is_file()
    assert not (scratch.tree.root / "recordings").exists()


def test_every_room_gets_its_share():
    counts = {"small": 30, "middle": 300, "large": 3000}
    assert shares(counts, 12) == {"small": 4, "middle": 4, "large": 4}
    numbers = shares(counts, 175)
    assert sum(numbers.values()) == 175
    assert numbers == {"small": MIN_PER_ROOM + 1, "middle": MIN_PER_ROOM + 9, "large": MIN_PER_ROOM + 90}
    assert shares({"small": 3, "large": 3000}, 100)["small"] == 3


def test_every_room_has_sources_and_tests_and_no_source_is_in_two():
    sources = [path for room in ROOMS.values() for path in room_sources(room)]
    assert len(sources) == len(set(sources))
    for room in ROOMS.values():
        assert room_sources(room)
        assert all((ROOT / path).is_file() for path in room_tests(room))


def test_each_mutant_that_is_called_equivalent_still_fits_its_source():
    for entry in read_equivalents(EQUIVALENT):
        text = " ".join(line.strip() for line in (ROOT / entry.file).read_text(encoding="utf-8").splitlines())
        assert entry.before in text, entry
        assert entry.after != entry.before, entry
        assert entry.reason, entry


def test_the_score_counts_deaths_among_mutants_that_change_something():
    verdicts = [Verdict.DIED, Verdict.TIMED_OUT, Verdict.SURVIVED, Verdict.UNTESTED, Verdict.SURVIVED]
    mutants = [make_mutant(after=str(number)) for number in range(len(verdicts) + 1)]
    results = {
        mutant.key: Result(mutant.key, verdict, 1.0, "") for mutant, verdict in zip(mutants, verdicts, strict=False)
    }  # The last mutant was not tried.
    equivalents = [Equivalent(mutants[4].file, mutants[4].before, mutants[4].after, "a reason")]
    _, survivors, score = summarise_results(mutants, results, equivalents)
    assert survivors == mutants[2:4]
    assert score == 0.5


def test_the_newest_result_of_a_mutant_counts(tmp_path):
    path, mutant = tmp_path / "folder" / "results.jsonl", make_mutant()
    assert read_results(path) == {}
    for verdict in (Verdict.SURVIVED, Verdict.DIED):
        append_result(path, mutant, Result(mutant.key, verdict, 1.5, "a test"))
    assert read_results(path) == {mutant.key: Result(mutant.key, Verdict.DIED, 1.5, "a test")}


def test_a_test_file_that_cannot_be_collected_stops_the_survey(scratch, tmp_path, monkeypatch):
    (scratch.tree.root / "tests" / "test_limits.py").write_text("import rtloop.no_such_module\n")
    monkeypatch.setattr(choice, "room_tests", lambda room: ["tests/test_limits.py"])
    monkeypatch.setattr(choice.Selection, "_path", lambda self, file, compiled: tmp_path / "survey.json")
    with pytest.raises(RuntimeError, match=r"survey survey: exit code is 2; allowed: 0, 1\n(.|\n)*no_such_module"):
        choice.Selection(tmp_path).survey({"analysis"}, [scratch.tree])


def test_loop_and_drivers_can_be_imported_without_the_compiler():
    modules = "rtloop.engine.assembly, rtloop.engine.ring, rtloop.drivers.sim, rtloop.drivers.shm"
    script = f"from tests.mutants.uncompiled import install; install(); import {modules}"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    subprocess.run([sys.executable, "-c", script], cwd=ROOT, env=environment, check=True)


def test_a_survey_knows_lines_seconds_and_the_tests_that_start_processes(scratch, tmp_path, monkeypatch):
    test = scratch.tree.root / "tests" / "test_limits.py"
    test.write_text(TEST + "\n\ndef test_of_a_process():\n    import subprocess\n    subprocess.run(['true'])\n")
    monkeypatch.setattr(choice, "room_tests", lambda room: ["tests/test_limits.py"])
    monkeypatch.setattr(choice.Selection, "_path", lambda self, file, compiled: tmp_path / "survey.json")
    selection = choice.Selection(tmp_path)
    selection.survey({"analysis"}, [scratch.tree])
    line = make_mutant("analysis")._replace(file="rtloop/limits.py", line=2)
    assert list(selection.tests(line)) == ["tests/test_limits.py::test_a_value_beyond_the_limit_is_the_limit"]
    assert list(selection.second_round(line)) == ["tests/test_limits.py::test_of_a_process"]
