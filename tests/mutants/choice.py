"""The tests that are run for a mutant: those of its room that execute its line, the most telling first."""

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
from tests.mutants.trees import Tree, ended

SURVEY_LIMIT_S = 1200.0
"""For the tests of one file."""
LEFT_OUT_S = 5.0
"""A test that is left out uncompiled takes about so long with compiled kernels."""
CRASHED: dict[str, Any] = {"seconds": {}, "failed": {}, "starting": [], "lines": {}}
"""The survey of a file whose tests cannot run uncompiled, for a loop that is interrupted within C ends the process:
none of its tests is run, so that mutants may survive that would die.
"""
TEST_LIMIT_S = 60
"""A test that waits for longer is left out, as one is that computes for long."""


class Choice:
    """What was surveyed of the tests, kept in `folder` for as long as neither sources nor tests change."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[tuple[str, bool], dict[str, Any]] = {}
        self._sources = _digest(
            *(path for place in ("rtloop", "hil", "drivers") for path in (ROOT / place).rglob("*.py")),
            *(
                path
                for path in (ROOT / "tests").rglob("*.py")
                if not path.name.startswith("test_") and path.parent != Path(__file__).parent
            ),
        )

    def survey(self, rooms: set[str], trees: list[Tree]) -> None:
        """Survey the test files of rooms that were not yet, one process each, as many at once as there are trees.

        Raises RuntimeError for a file whose tests cannot be collected, or whose survey takes too long: mutants would
        be tried without its tests, and survive.
        """
        wanted = sorted({(file, ROOMS[room].compiled) for room in rooms for file in room_tests(ROOMS[room])})
        missing = [entry for entry in wanted if not self._path(*entry).exists()]
        idle, running = list(trees), list[tuple[int, float, Tree, Path]]()
        while missing or running:
            while missing and idle:
                file, compiled = missing.pop(0)
                tree, path = idle.pop(), self._path(file, compiled)
                running.append((_start(file, compiled, tree, path), time.monotonic(), tree, path))
            for entry in list(running):
                child, began, tree, path = entry
                code = ended(child, began + SURVEY_LIMIT_S)
                if code is not None:
                    if code == -signal.SIGSEGV:
                        _write(path, CRASHED)
                    _report_survey(path, code, tree, time.monotonic() - began)
                    running.remove(entry)
                    idle.append(tree)
            time.sleep(0.05)
        self._known = {entry: json.loads(self._path(*entry).read_text()) for entry in wanted}

    def _path(self, file: str, compiled: bool) -> Path:
        name = file.removesuffix(".py").replace("/", ".") + (".compiled" if compiled else "")
        return self._folder / f"{name}-{self._sources}{_digest(ROOT / file)}.json"

    def tests(self, mutant: Mutant) -> dict[str, float]:
        """The tests for a mutant, in order, with their seconds.

        For a line that runs at import: those that execute another line of its file, and all tests of files that name
        its module, which may read what the line made and execute nothing of it.
        """
        room = ROOMS[mutant.room]
        surveyed = [(file, self._known[file, room.compiled]) for file in room_tests(room)]
        chosen = {name: seconds for _, known in surveyed for name, seconds in _executing(known, mutant, line=True)}
        if not chosen:
            module = mutant.file.removesuffix(".py").replace("/", ".")
            for file, known in surveyed:
                is_named = module in (ROOT / file).read_text(encoding="utf-8")
                chosen |= known["seconds"] if is_named else dict(_executing(known, mutant))
        stem = Path(mutant.file).stem
        return dict(sorted(chosen.items(), key=lambda item: (stem not in item[0], item[1])))

    def second_look(self, mutant: Mutant) -> dict[str, float]:
        """Tests for a mutant that survived the others, in order, with their seconds.

        They start processes, in which its line may be reached unseen, or execute its file and take too long uncompiled:
        such a test was stopped before it had reached all of its lines.
        """
        room = ROOMS[mutant.room]
        surveyed = [self._known[file, room.compiled] for file in room_tests(room)]
        tests = {
            name: known["seconds"].get(name, LEFT_OUT_S) for known in surveyed for name in known["starting"] if name
        }
        for known in [] if room.compiled else surveyed:
            reaching = {_function(context) for context, lines in known["lines"].items() if mutant.file in lines}
            tests |= {name: LEFT_OUT_S for name in known["failed"] if _function(name) in reaching}
        stem = Path(mutant.file).stem
        return dict(sorted(tests.items(), key=lambda item: (stem not in item[0], item[1])))


def _function(test: str) -> str:
    """Name of a test without its parameters."""
    return test.partition("[")[0]


def _executing(known: dict[str, Any], mutant: Mutant, *, line: bool = False) -> list[tuple[str, float]]:
    def executes(name: str) -> bool:
        lines = known["lines"].get(name, {}).get(mutant.file, [])
        return mutant.line in lines if line else bool(lines)

    return [
        (name, seconds)
        for name, seconds in known["seconds"].items()
        if executes(name) or executes(f"{name.partition('::')[0]}::{SHARED}")
    ]


def _start(file: str, compiled: bool, tree: Tree, path: Path) -> int:
    """Number of a process that surveys one test file and writes what it found to `path`."""

    def run() -> int:
        survey = Survey(tree.root, compiled=compiled)
        code = pytest.main([*OPTIONS, f"--timeout={TEST_LIMIT_S}", file], plugins=[survey])
        if code in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            _write(path, survey.result())
        return int(code)

    return tree.start(run, compiled=compiled, writes_bytecode=True)


def _write(path: Path, told: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".part")
    partial.write_text(json.dumps(told))
    partial.rename(path)


def _report_survey(path: Path, code: int, tree: Tree, seconds: float) -> None:
    """Print the counts of a surveyed test file. Raises RuntimeError if the process `code` ended left no survey."""
    if not path.exists():
        raise RuntimeError(f"survey {path.stem}: exit code is {code}; allowed: 0, 1\n{tree.output()[-2000:]}")
    survey = json.loads(path.read_text())
    counts = f"{len(survey['seconds'])} tests, {len(survey['failed'])} left out"
    print(f"surveyed {path.stem}: {counts}, {seconds:.0f} s", file=sys.stderr, flush=True)


def _digest(*paths: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]
