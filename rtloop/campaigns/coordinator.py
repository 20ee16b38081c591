"""Running a campaign: units go to workers a few at a time, results to the store as they come.

A rig whose worker died twice while it ran alone is set aside, as crashed; all others get their results. A campaign that
was interrupted continues where it was: the rigs in its store are not run again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import NamedTuple

from rtloop.campaigns.campaign_file import Campaign
from rtloop.campaigns.case import NOMINAL, CaseResult, CaseRunner
from rtloop.campaigns.dispatcher import Dispatcher, Task
from rtloop.campaigns.store import Store, crashed_case
from rtloop.campaigns.unit import Unit, WorkerFacts, run_unit
from rtloop.campaigns.workers import Workers
from rtloop.errors import LoopFault


class Progress(NamedTuple):
    """State of a campaign that runs: rigs that have results, and all rigs; the nominal one counts."""

    done: int
    total: int


class UnitRig(NamedTuple):
    """A rig of a campaign by its number, and its unit."""

    unit: Unit
    rig: int


class Coordinator:
    """Runs the rigs that `store` lacks on `workers`; `crashed` has the numbers of rigs that were set aside."""

    def __init__(self, campaign: Campaign, runner: CaseRunner, store: Store, workers: Workers) -> None:
        """Store the arguments and the package versions of this process; no rig is set aside yet."""
        self.crashed: list[int] = []
        self._campaign, self._runner, self._store, self._workers = campaign, runner, store, workers
        self._facts = WorkerFacts.of_this_process()

    def run(
        self, units: list[Unit], on_progress: Callable[[Progress], None], is_stop_requested: Callable[[], bool]
    ) -> bool:
        """Run the rigs of `units` without a result; return whether all of them have results now, crashed rigs included.

        After a request to stop, the tasks that were submitted end and no other one starts. Raises the error of a task,
        such as OtherVersion; UnavailableError if the scheduler is gone; LoopFault if the nominal rig kills its workers;
        OutputError if the store cannot be read or written. Results that came before an error are stored.
        """
        missing = [(unit, self._store.missing(unit)) for unit in units]
        tasks = (
            Task(tuple(UnitRig(unit, rig) for rig in rigs), alone=NOMINAL in unit.rigs)
            for unit, rigs in missing
            if rigs
        )
        total = sum(len(unit.rigs) for unit in units)
        stored = total - sum(len(rigs) for _, rigs in missing)
        on_progress(Progress(stored, total))
        dispatcher = Dispatcher(self._workers, self)
        done = dispatcher.run(tasks, lambda count: on_progress(Progress(stored + count, total)), is_stop_requested)
        return stored + done == total

    def submit(self, items: tuple[UnitRig, ...]) -> Future[list[CaseResult]]:
        """Start rigs of one unit in a worker; return the future of their results, in the order of `items`."""
        return self._workers.submit(run_unit, self._campaign, [item.rig for item in items], self._facts)

    def store(self, items: tuple[UnitRig, ...], result: Sequence[CaseResult]) -> None:
        """Store `result`, the results of rigs of one unit. Raises OutputError if the system refuses."""
        self._store.add(items[0].unit, result)

    def set_aside(self, item: UnitRig) -> None:
        """Store that each worker that ran a rig died, and add the rig to `crashed`.

        Raises LoopFault for the nominal rig: then workers cannot run at all. Raises OutputError if the system refuses.
        """
        if item.rig == NOMINAL:
            raise LoopFault(
                "each worker process that ran the nominal rig died; check that `rtloop run --unpaced` runs the "
                'configuration; a script must call rtloop.campaign below `if __name__ == "__main__":`'
            )
        self.crashed.append(item.rig)
        self._store.add(item.unit, [crashed_case(item.rig, self._runner.sample_values(item.rig))])
