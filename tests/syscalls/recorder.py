"""Component: the recorder, a process on a real shared block, and the supervisor's repair after its end."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any, cast

from rtloop.configuration.recording import RecordingOptions
from rtloop.engine.memory import ProcessState, Word
from rtloop.recording.capture import recorder, session
from rtloop.recording.capture.recorder import Recorder, SupervisorOrders
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.file.run_readers import run_files
from rtloop.recording.file.topics.format import chunk_rows
from rtloop.supervision.child import Child
from rtloop.supervision.recorder_keeper import RecorderKeeper
from tests.syscalls.component import Case
from tests.syscalls.recordings import (
    SNAPSHOT_TICKS,
    TICKS,
    header,
    new_block,
    run_file_problems,
    ticks_in_files,
    ticks_on_disk,
)
from tests.syscalls.traced import Outcome

OPTIONS = {"min_free_bytes": 1, "rotate_bytes": 14_000, "message_index": True}
"""Options of a run with several files and a check of the free space: all of a recorder's calls on a disk."""


class Recording(Case):
    """Recording of a finished loop by a process; a dead recorder is replaced, and its file repaired."""

    may_crash = True

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.block = new_block()
        self.block.store(Word.LOOP_STATE, ProcessState.FINISHED)
        self.path = folder / "run.mcap"
        options = RecordingOptions(min_free_mib=0.0)
        self.keeper = RecorderKeeper(cast(Child, None), self.block, cast(RequesterNames, None), self.path, options)
        self.output = folder / "totals"

    def prepare_child(self) -> None:
        """Put the order into a pipe as stdin, make a file stdout, and set the recorder's waits to 0."""
        order = {"path": str(self.path), "header": header(), "options": OPTIONS}
        reading, writing = os.pipe()
        os.write(writing, json.dumps(order).encode() + b"\n")
        os.dup2(reading, 0)
        os.dup2(os.open(self.output, os.O_WRONLY | os.O_CREAT), 1)
        sys.stdout = os.fdopen(1, "w", closefd=False)
        recorder.POLL_S = session.FLUSH_S = 0.0

    def work(self) -> None:
        recorder.record_run(self.block.fd)

    def warm_up(self) -> None:
        self._record(1)

    def judge(self, outcome: Outcome) -> list[str]:
        """Record the rest if the recorder died, repair the files, and check files and printed totals."""
        totals = self._printed_totals()
        self.output.unlink(missing_ok=True)
        flushed = ticks_on_disk(self.folder.glob("*.mcap*"))
        counted = self.block.load(Word.FLUSHED_TICKS) - self.block.load(Word.LOST_TICKS)
        problems = [] if len(flushed) >= counted else [f"{counted} ticks counted as written, {len(flushed)} are"]
        if outcome.killed or outcome.crash:
            self.keeper.replacements = 1
            self._record(self.keeper._next_sequence())
            flushed = set(range(TICKS))  # the ring holds all ticks
        for part in run_files(self.keeper._path, ".mcap.part"):
            self.keeper._repair(part)
        paths = run_files(self.keeper._path, ".mcap")
        problems += run_file_problems(paths, flushed)
        problems += self._totals_problems(totals, len(ticks_in_files(paths)))
        unexpected = [path.name for path in self.folder.iterdir() if path not in paths and path.suffix != ".new"]
        return [*problems, *(f"{name} is unexpected" for name in unexpected)]

    def _totals_problems(self, totals: dict[str, Any], ticks: int) -> list[str]:
        """Return the problems of the printed totals; a failing call may cost the ticks of a snapshot and two chunks."""
        if not totals or (totals["error"] and not totals.get("paths")):
            return ["the recorder refused, and ticks are on the disk"] if totals and ticks else []
        problems = []
        if totals["complete"] != (ticks == TICKS and totals["error"] is None):
            problems.append(f"the recorder says complete: {totals['complete']}; {ticks} of {TICKS} ticks are there")
        if TICKS - ticks > SNAPSHOT_TICKS + 2 * chunk_rows(header()["columns"]):
            problems.append(f"{TICKS - ticks} ticks are missing after one failing call")
        return problems

    def _printed_totals(self) -> dict[str, Any]:
        """Return the totals that the recorder printed; empty if it died before."""
        text = self.output.read_text() if self.output.exists() else ""
        return json.loads(text) if text.endswith("\n") else {}

    def _record(self, sequence: int) -> None:
        """Record the rest of the loop in this process, as the next recorder does."""
        next_recorder = Recorder(self.block)
        options = Options(**{**OPTIONS, "sequence": sequence})
        next_session = Session(self.block, self.path, header(), options)
        orders = SupervisorOrders()
        orders.next = lambda wait_s=0.0: None  # type: ignore[method-assign]  # no order ever comes
        next_session.finish(next_recorder.record(next_session, orders, 0.0))
