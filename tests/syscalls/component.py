"""A component under test: its work, done in a process of its own, and a judge who comes after it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from tests.syscalls.kinds import RETRIED
from tests.syscalls.traced import Call, EndedTooEarly, Injection, Outcome, Traced

ATTEMPTS = 3
"""Where the work ends before it is traced."""


class Case:
    """One try in `folder`, which is empty. Subclasses put there what the work needs, before anything is traced."""

    may_crash = False
    """Whether an error that nobody catches counts as a death, after which somebody else goes on."""

    is_all_traced = True
    """Whether all of the work is traced; otherwise `traced_work` says where its trace begins."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def warm_up(self) -> None:
        """Do the work in the parent, so that it imports then what is imported when it is first done."""
        self.work()

    def prepare_child(self) -> None:
        """Make the child ready for the work, before it is traced."""

    def work(self) -> None:
        """Do the work, in the traced process."""
        raise NotImplementedError

    def traced_work(self, logs: Path) -> None:
        """Do the work in the traced process, whose trace is in `logs`."""
        self.work()

    def judge(self, outcome: Outcome) -> list[str]:
        """Let the next hand do the same work, and return what is wrong then; in the parent."""
        raise NotImplementedError

    def traced(self, injection: Injection | None, logs: Path) -> Traced:
        """The process that does the work, traced, before it begins."""
        prepare = self.prepare_child if self.is_all_traced else None
        return Traced(lambda: self.traced_work(logs), logs, injection, prepare)

    def trace(self, injection: Injection | None, logs: Path) -> Outcome:
        """Do the work in a traced process, from fork to end."""
        traced = self.traced(injection, logs)
        traced.begin()
        return traced.wait()


class Result(NamedTuple):
    """What came of one injection; None in the place of an injection is the work as it is. `crashed`: by an error that
    nobody caught, where that counts as a death."""

    component: str
    injection: Injection | None
    calls: list[Call]
    reached: bool
    crashed: bool
    problems: list[str]


class Component(NamedTuple):
    """`case` makes a try in an empty folder; `share` is its part of a sample; `is_thinned`: see `kinds.thinned`.
    `most` is how many of its calls are tried, evenly spread; None: all."""

    name: str
    case: Callable[[Path], Case]
    share: int
    is_thinned: bool = False
    most: int | None = None

    def warm_up(self, folder: Path) -> None:
        """As `Case.warm_up`, in a folder of its own."""
        self.case(_empty(folder / "warm")).warm_up()

    def measure(self, folder: Path, injection: Injection | None = None) -> Result:
        """Do the work with an injection, or without one, and judge what it leaves."""
        logs = folder / "logs"
        logs.mkdir(exist_ok=True)
        for _ in range(ATTEMPTS):
            case = self.case(_empty(folder / "case"))
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


def _empty(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder
