"""Running a campaign: units go to workers a few at a time, results to the store as they come.

A rig whose worker died twice while it ran alone is set aside, as crashed; all others get their results. A campaign that
was interrupted continues where it was: the rigs in its store are not run again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from typing import NamedTuple

from rtloop.campaigns.campaign_file import Campaign
from rtloop.campaigns.case import NOMINAL, CaseRunner
from rtloop.campaigns.store import Store, crashed_case
from rtloop.campaigns.unit import Unit, UnitResult, WorkerFacts
from rtloop.campaigns.workers import WorkerDied, Workers

WAITING_FOR_EACH = 2
"""Units submitted for each worker: one runs, one waits."""
TRIES_ALONE = 2
"""Times that a rig runs alone before it is set aside."""
POLL_S = 0.5
"""Time between looks at a request to stop."""


class Progress(NamedTuple):
    """State of a campaign that runs: rigs that have results, and all rigs; the nominal one counts."""

    done: int
    total: int


class _Task(NamedTuple):
    """Rigs of a unit that have no result yet. With `alone`, no other task runs beside it."""

    unit: Unit
    rigs: tuple[int, ...]
    alone: bool = False
    deaths: int = 0


class Coordinator:
    """Runs the rigs that `store` lacks on `workers`; `crashed` has the numbers of rigs that were set aside."""

    def __init__(self, campaign: Campaign, runner: CaseRunner, store: Store, workers: Workers) -> None:
        self.crashed: list[int] = []
        self.workers_seen: set[WorkerFacts] = set()
        self._campaign, self._runner, self._store, self._workers = campaign, runner, store, workers
        self._suspects: deque[_Task] = deque()
        self._running: dict[Future[UnitResult], _Task] = {}

    def run(
        self, units: list[Unit], on_progress: Callable[[Progress], None], is_stop_requested: Callable[[], bool]
    ) -> bool:
        """Run the units; return whether all rigs have results now. A stop lets the units end that run.

        Raises the error of a unit, such as OtherVersion; UnavailableError if the scheduler is gone; OutputError if the
        store cannot be written. Results that came before are stored.
        """
        tasks = [_Task(unit, tuple(rigs)) for unit in units if (rigs := self._store.missing(unit))]
        total = sum(len(unit.rigs) for unit in units)
        done = total - sum(len(task.rigs) for task in tasks)
        waiting = iter(tasks)
        on_progress(Progress(done, total))
        while self._fill(waiting, is_stop_requested()):
            completed, _ = wait(self._running, timeout=POLL_S, return_when=FIRST_COMPLETED)
            if completed:
                done += self._collect(completed)
                on_progress(Progress(done, total))
        return done == total

    def _fill(self, tasks: Iterator[_Task], is_stopping: bool) -> int:
        """Submit tasks up to the limit, the nominal rig first and alone; return the number of tasks that run."""
        while not is_stopping and len(self._running) < WAITING_FOR_EACH * self._workers.count:
            if any(task.alone for task in self._running.values()) or (self._suspects and self._running):
                break
            task = self._suspects.popleft() if self._suspects else next(tasks, None)
            if task is None:
                break
            task = task._replace(alone=task.alone or NOMINAL in task.rigs)
            self._running[self._workers.submit(self._campaign, task.rigs)] = task
        return len(self._running)

    def _collect(self, completed: Iterable[Future[UnitResult]]) -> int:
        """Store the results of tasks that ended; return the number of rigs that have results by them.

        Where a worker died, all other tasks are awaited, since some workers die together; then new ones are started.
        """
        died: list[_Task] = []
        done = sum(self._store_result(future, died) for future in completed)
        if died:
            wait(self._running)
            done += sum(self._store_result(future, died) for future in list(self._running))
            self._workers.recover()
            done += sum(self._repeat(task) for task in died)
        return done

    def _store_result(self, future: Future[UnitResult], died: list[_Task]) -> int:
        """Store the result of a task; return its number of rigs. A task whose worker died is appended to `died`.

        Raises any other error of the task.
        """
        task = self._running.pop(future)
        try:
            result = future.result()
        except (Exception, CancelledError) as raised:
            error = self._workers.explain(raised)
            if not isinstance(error, WorkerDied):
                raise error from None
            died.append(task)
            return 0
        self.workers_seen.add(result.worker)
        self._store.add(task.unit, result.cases)
        return len(result.cases)

    def _repeat(self, task: _Task) -> int:
        """Run the rigs of a task again, each alone; set a rig aside that killed its worker TRIES_ALONE times alone.

        Returns the number of rigs that were set aside.
        """
        if not task.alone:
            self._suspects.extend(_Task(task.unit, (rig,), alone=True) for rig in task.rigs)
        elif task.deaths + 1 < TRIES_ALONE:
            self._suspects.appendleft(task._replace(deaths=task.deaths + 1))
        else:
            self.crashed += task.rigs
            self._store.add(task.unit, [crashed_case(rig, self._runner.sample_values(rig)) for rig in task.rigs])
            return len(task.rigs)
        return 0
