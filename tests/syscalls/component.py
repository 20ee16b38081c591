"""A component under test: its work in a separate traced process, and the check by the next process."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from tests.syscalls.kinds import RETRIED
from tests.syscalls.traced import Call, EndedTooEarly, Injection, Outcome, Traced

ATTEMPTS = 3
"""Number of attempts at a work that ends before its trace begins."""


class Case:
    """One try in the empty `folder`. Subclasses prepare the files of the work there, before the trace."""

    may_crash = False
    """Whether an uncaught error counts as a death of the process, from which the next process must recover."""

    is_all_traced = True
    """Whether all of the work is traced; otherwise `traced_work` calls `begin_here` where the trace begins."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def warm_up(self) -> None:
        """Do the work in the parent, so that the child finds all modules imported."""
        self.work()

    def prepare_child(self) -> None:
        """Prepare the child for the work, before the trace."""

    def work(self) -> None:
        """Do the work of the component."""
        raise NotImplementedError

    def traced_work(self, logs: Path) -> None:
        """Do the work in the traced process, whose trace and marks are in `logs`."""
        self.work()

    def judge(self, outcome: Outcome) -> list[str]:
        """Do the same work again in the parent, as the next process would, and return the problems."""
        raise NotImplementedError

    def traced(self, injection: Injection | None, logs: Path) -> Traced:
        """Return the traced process that will do the work; `begin` starts it."""
        prepare = self.prepare_child if self.is_all_traced else None
        return Traced(lambda: self.traced_work(logs), logs, injection, prepare)

    def trace(self, injection: Injection | None, logs: Path) -> Outcome:
        """Do the work in a traced process and return its outcome."""
        traced = self.traced(injection, logs)
        traced.begin()
        return traced.wait()


class Result(NamedTuple):
    """Result of a try; `injection` None: of the undisturbed work. `reached`: the injection took place. `crashed`: an
    uncaught error ended the work."""

    component: str
    injection: Injection | None
    calls: list[Call]
    reached: bool
    crashed: bool
    problems: list[str]


class Component(NamedTuple):
    """A component. `case` makes a try in an empty folder; `share` is its part of a sample; `is_thinned`: see
    `kinds.thinned`. `max_calls` is the number of its calls that are tried, evenly spread; None: all."""

    name: str
    case: Callable[[Path], Case]
    share: int
    is_thinned: bool = False
    max_calls: int | None = None

    def warm_up(self, folder: Path) -> None:
        """Call `Case.warm_up` in a new folder below `folder`."""
        self.case(_emptied(folder / "warm")).warm_up()

    def measure(self, folder: Path, injection: Injection | None = None) -> Result:
        """Do the work, with or without an injection, check the files and outputs afterwards, return the result."""
        logs = folder / "logs"
        logs.mkdir(exist_ok=True)
        for _ in range(ATTEMPTS):
            case = self.case(_emptied(folder / "case"))
            with suppress(EndedTooEarly):
                outcome = case.trace(injection, logs)
                break
        else:
            if injection is None:
                raise EndedTooEarly(f"{self.name}: {ATTEMPTS} times")
            return Result(self.name, injection, [], False, False, [])
        problems = [f"a crash: {outcome.crash}"] if outcome.hung or (outcome.crash and not case.may_crash) else []
        if injection and injection.kind == "EINTR" and injection.call.name in RETRIED and outcome.reached:
            problems += [] if outcome.finished else [f"an interruption does harm: {outcome.refusal or outcome.crash}"]
        problems += case.judge(outcome)
        return Result(self.name, injection, outcome.calls, outcome.reached, bool(outcome.crash), problems)


def _emptied(folder: Path) -> Path:
    """Create `folder` empty, and return it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder
