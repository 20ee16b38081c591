"""Dispatching of tasks: workers get a few at a time, and an item that kills its worker costs no other item its result.

An item whose worker died twice while it ran alone is set aside; all others get their results.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from typing import Generic, NamedTuple, Protocol, TypeVar

from rtloop.campaigns.workers import WorkerDied, Workers

Item = TypeVar("Item")
TakenItem = TypeVar("TakenItem", contravariant=True)
Result = TypeVar("Result")
WAITING_FOR_EACH = 2
"""Tasks submitted for each worker: one runs, one waits."""
TRIES_ALONE = 2
"""Times that an item runs alone before it is set aside."""
POLL_S = 0.5
"""Time between looks at a request to stop."""


class Task(NamedTuple, Generic[Item]):
    """Items that one worker handles, one after the other. With `alone`, no further task starts until it has ended.

    `deaths` counts the workers that died while they ran it alone.
    """

    items: tuple[Item, ...]
    alone: bool = False
    deaths: int = 0


class Job(Protocol[TakenItem, Result]):
    """Work on items: its start in a worker, and the storage of its results."""

    def submit(self, items: tuple[TakenItem, ...]) -> Future[Result]:
        """Start the work on the items of a task in a worker; return the future of its result, which `store` takes."""
        ...

    def store(self, items: tuple[TakenItem, ...], result: Result) -> None:
        """Store the result of a task. Raises OutputError if the system refuses."""
        ...

    def set_aside(self, item: TakenItem) -> None:
        """Store that an item has no result, as each worker that ran it died.

        Raises OutputError if the system refuses.
        """
        ...


class Dispatcher(Generic[Item, Result]):
    """Runs the tasks of a job on workers."""

    def __init__(self, workers: Workers, job: Job[Item, Result]) -> None:
        """Store workers and job; no task runs, and no item waits to run again alone."""
        self._workers, self._job = workers, job
        self._suspects: deque[Task[Item]] = deque()
        self._running: dict[Future[Result], Task[Item]] = {}

    def run(
        self, tasks: Iterable[Task[Item]], on_progress: Callable[[int], None], is_stop_requested: Callable[[], bool]
    ) -> int:
        """Run the tasks; return the number of items that are stored or set aside.

        `on_progress` receives the number of such items of this call each time that tasks have ended. After a request to
        stop, submitted tasks end and are stored, and no other one starts. Raises the error of a task, UnavailableError
        if the scheduler is gone, and the errors of the job. Results that came before an error are stored.
        """
        waiting, done = iter(tasks), 0
        while self._fill(waiting, is_stop_requested()):
            completed, _ = wait(self._running, timeout=POLL_S, return_when=FIRST_COMPLETED)
            if completed:
                done += self._collect(completed)
                on_progress(done)
        return done

    def _fill(self, tasks: Iterator[Task[Item]], is_stopping: bool) -> int:
        """Submit the next tasks; return the number of submitted tasks whose results are not yet stored, 0 at the end.

        Each worker gets up to WAITING_FOR_EACH tasks. Items whose worker died go first, alone, once no other task runs.
        While `is_stopping`, no task is submitted. Replaces dead workers once no task runs; raises any other error of
        `Job.submit`.
        """
        while not is_stopping and len(self._running) < WAITING_FOR_EACH * self._workers.count:
            if any(task.alone for task in self._running.values()) or (self._suspects and self._running):
                break
            task = self._suspects.popleft() if self._suspects else next(tasks, None)
            if task is None:
                break
            try:
                self._running[self._job.submit(task.items)] = task
            except Exception as raised:
                if not isinstance(self._workers.explain(raised), WorkerDied):
                    raise
                self._suspects.appendleft(task)  # The workers died after the last result; the task was not submitted.
                if self._running:
                    break  # `_collect` replaces the workers.
                self._workers.recover()
        return len(self._running)

    def _collect(self, completed: Iterable[Future[Result]]) -> int:
        """Store the results of tasks that ended; return the number of items that this call stored or set aside.

        If a worker died, the results of all other tasks are awaited and stored, since some workers die together. The
        dead workers are then replaced; their items are queued to run again, each alone, or are set aside. Raises the
        error of a task, UnavailableError if the scheduler is gone, and the errors of the job.
        """
        died: list[Task[Item]] = []
        done = sum(self._store_result(future, died) for future in completed)
        if died:
            wait(self._running)
            done += sum(self._store_result(future, died) for future in list(self._running))
            self._workers.recover()
            done += sum(self._repeat(task) for task in died)
        return done

    def _store_result(self, future: Future[Result], died: list[Task[Item]]) -> int:
        """Store the result of the task of `future`, which ended; return its number of items.

        If the worker died, append the task to `died` and return 0. Raises any other error of the task, and the errors
        of the job.
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
        self._job.store(task.items, result)
        return len(task.items)

    def _repeat(self, task: Task[Item]) -> int:
        """Queue the items of a task whose worker died, to run again each alone; return the number of items set aside.

        An item is set aside in place of queueing once TRIES_ALONE workers died while they ran it alone.
        """
        if not task.alone:
            self._suspects.extend(Task((item,), alone=True) for item in task.items)
        elif task.deaths + 1 < TRIES_ALONE:
            self._suspects.appendleft(task._replace(deaths=task.deaths + 1))
        else:
            for item in task.items:
                self._job.set_aside(item)
            return len(task.items)
        return 0
