"""Selection of the tests for a mutant: the tests of its room that execute its line, likely killers first."""

from __future__ import annotations

import hashlib
import json
import signal
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tests.mutants.mutant import Mutant
from tests.mutants.rooms import ROOMS, ROOT, room_tests
from tests.mutants.steady import OPTIONS
from tests.mutants.survey import SHARED, Survey
from tests.mutants.trees import Tree, poll_process

SURVEY_LIMIT_S = 1200.0
"""Limit for the survey of one test file."""
LEFT_OUT_S = 5.0
"""Typical duration, with compiled kernels, of a test that is left out with uncompiled ones."""
CRASHED: dict[str, Any] = {"seconds": {}, "failed": {}, "starting": [], "lines": {}}
"""The empty survey of a file whose tests cannot run uncompiled, because a loop interrupted within C ends the process.
Its tests are not run for any mutant, so that mutants may survive that would die.
"""
TEST_LIMIT_S = 60
"""Limit of wall time in s; a test that takes longer is left out."""


class Selection:
    """Selects tests by surveys, which `folder` stores and which hold until the sources or the tests change."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._surveys: dict[tuple[str, bool], dict[str, Any]] = {}
        self._sources = _digest(
            *(path for place in ("rtloop", "hil", "drivers") for path in (ROOT / place).rglob("*.py")),
            *(
                path
                for path in (ROOT / "tests").rglob("*.py")
                if not path.name.startswith("test_") and path.parent != Path(__file__).parent
            ),
        )

    def survey(self, rooms: set[str], trees: list[Tree]) -> None:
        """Survey the test files of `rooms` without a survey, one process a file, one file at a time in each tree.

        Raises RuntimeError for a file whose tests cannot be collected, or whose survey takes too long: without its
        tests, mutants would survive.
        """
        required = sorted({(file, ROOMS[room].compiled) for room in rooms for file in room_tests(ROOMS[room])})
        missing = [entry for entry in required if not self._path(*entry).exists()]
        idle, running = list(trees), list[tuple[int, float, Tree, Path]]()
        while missing or running:
            while missing and idle:
                file, compiled = missing.pop(0)
                tree, path = idle.pop(), self._path(file, compiled)
                running.append((_start_survey(file, compiled, tree, path), time.monotonic(), tree, path))
            for entry in list(running):
                child, began, tree, path = entry
                code = poll_process(child, began + SURVEY_LIMIT_S)
                if code is not None:
                    if code == -signal.SIGSEGV:
                        _store_survey(path, CRASHED)
                    _report_survey(path, code, tree, time.monotonic() - began)
                    running.remove(entry)
                    idle.append(tree)
            time.sleep(0.05)
        self._surveys = {entry: json.loads(self._path(*entry).read_text()) for entry in required}

    def _path(self, file: str, compiled: bool) -> Path:
        """Return the file of a survey; its name changes with the sources, the shared test code and the test file."""
        name = file.removesuffix(".py").replace("/", ".") + (".compiled" if compiled else "")
        return self._folder / f"{name}-{self._sources}{_digest(ROOT / file)}.json"

    def tests(self, mutant: Mutant) -> dict[str, float]:
        """Return the tests for a mutant in the order of their execution, with their durations in s.

        For a line that runs at import: the tests that execute another line of its file, and all tests of files that
        name its module, which may read a value made by that line without executing the module.
        """
        room = ROOMS[mutant.room]
        surveys = [(file, self._surveys[file, room.compiled]) for file in room_tests(room)]
        chosen = {name: seconds for _, survey in surveys for name, seconds in _executing(survey, mutant, line=True)}
        if not chosen:
            module = mutant.file.removesuffix(".py").replace("/", ".")
            for file, survey in surveys:
                is_named = module in (ROOT / file).read_text(encoding="utf-8")
                chosen |= survey["seconds"] if is_named else dict(_executing(survey, mutant))
        stem = Path(mutant.file).stem
        return dict(sorted(chosen.items(), key=lambda item: (stem not in item[0], item[1])))

    def second_round(self, mutant: Mutant) -> dict[str, float]:
        """Return the tests for a mutant that survived the first round, in order, with their durations in s.

        These tests start processes, whose executed lines are not surveyed; or they execute the mutant's file but take
        too long uncompiled: their survey was stopped before they had executed all of their lines.
        """
        room = ROOMS[mutant.room]
        surveys = [self._surveys[file, room.compiled] for file in room_tests(room)]
        tests = {
            name: survey["seconds"].get(name, LEFT_OUT_S) for survey in surveys for name in survey["starting"] if name
        }
        for survey in [] if room.compiled else surveys:
            reaching = {_test_function(context) for context, lines in survey["lines"].items() if mutant.file in lines}
            tests |= {name: LEFT_OUT_S for name in survey["failed"] if _test_function(name) in reaching}
        stem = Path(mutant.file).stem
        return dict(sorted(tests.items(), key=lambda item: (stem not in item[0], item[1])))


def _test_function(test: str) -> str:
    """Return the name of a test without its parameters."""
    return test.partition("[")[0]


def _executing(survey: dict[str, Any], mutant: Mutant, *, line: bool = False) -> list[tuple[str, float]]:
    """Return (name, seconds) of the surveyed tests that execute the mutant's file, or its line if `line`."""

    def executes(name: str) -> bool:
        lines = survey["lines"].get(name, {}).get(mutant.file, [])
        return mutant.line in lines if line else bool(lines)

    return [
        (name, seconds)
        for name, seconds in survey["seconds"].items()
        if executes(name) or executes(f"{name.partition('::')[0]}::{SHARED}")
    ]


def _start_survey(file: str, compiled: bool, tree: Tree, path: Path) -> int:
    """Start a process that surveys one test file and writes the survey to `path`; return its process id."""

    def run() -> int:
        survey = Survey(tree.root, compiled=compiled)
        code = pytest.main([*OPTIONS, f"--timeout={TEST_LIMIT_S}", file], plugins=[survey])
        if code in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            _store_survey(path, survey.result())
        return int(code)

    return tree.start(run, compiled=compiled, writes_bytecode=True)


def _store_survey(path: Path, survey: dict[str, Any]) -> None:
    """Write a survey as JSON to a temporary file, then rename the file to `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".part")
    partial.write_text(json.dumps(survey))
    partial.rename(path)


def _report_survey(path: Path, code: int, tree: Tree, seconds: float) -> None:
    """Print the counts of a surveyed test file. Raises RuntimeError if there is none; the process ended with `code`."""
    if not path.exists():
        raise RuntimeError(f"survey {path.stem}: exit code is {code}; allowed: 0, 1\n{tree.output()[-2000:]}")
    survey = json.loads(path.read_text())
    counts = f"{len(survey['seconds'])} tests, {len(survey['failed'])} left out"
    print(f"surveyed {path.stem}: {counts}, {seconds:.0f} s", file=sys.stderr, flush=True)


def _digest(*paths: Path) -> str:
    """Return twelve hexadecimal digits of the SHA-256 of the files' contents."""
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]
