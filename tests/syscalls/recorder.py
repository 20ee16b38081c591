"""The recorder, a process on a real shared block, and what the supervisor does when it has ended."""

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
from tests.syscalls.recordings import SNAPSHOT_TICKS, TICKS, header, problems_of, published, ticks_of, ticks_on_disk
from tests.syscalls.traced import Outcome

OPTIONS = {"min_free_bytes": 1, "rotate_bytes": 14_000, "message_index": True}
"""Several files, with the free room looked at: all that a recorder does with a disk."""


class Recording(Case):
    """A loop that has run, recorded by a process; a recorder that dies is replaced, and its file repaired."""

    may_crash = True

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.block = published()
        self.block.store(Word.LOOP_STATE, ProcessState.FINISHED)
        self.path = folder / "run.mcap"
        options = RecordingOptions(min_free_mib=0.0)
        self.keeper = RecorderKeeper(cast(Child, None), self.block, cast(RequesterNames, None), self.path, options)
        self.output = folder / "said"

    def prepare_child(self) -> None:
        """Take the order from a pipe as stdin, say the totals to a file, and wait for nothing."""
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
        said = self._said()
        self.output.unlink(missing_ok=True)
        flushed = ticks_on_disk(self.folder.glob("*.mcap*"))
        written = self.block.load(Word.FLUSHED_TICKS) - self.block.load(Word.LOST_TICKS)
        problems = [] if len(flushed) >= written else [f"{written} ticks are said to be written, {len(flushed)} are"]
        if outcome.killed or outcome.crash:
            self.keeper.replacements = 1
            self._record(self.keeper._next_sequence())
            flushed = set(range(TICKS))  # the ring holds them all
        for part in run_files(self.keeper._path, ".mcap.part"):
            self.keeper._repair(part)
        paths = run_files(self.keeper._path, ".mcap")
        problems += problems_of(paths, flushed)
        problems += self._problems_of_totals(said, len(ticks_of(paths)))
        strange = [path.name for path in self.folder.iterdir() if path not in paths and path.suffix != ".new"]
        return [*problems, *(f"{name} is left" for name in strange)]

    def _problems_of_totals(self, said: dict[str, Any], ticks: int) -> list[str]:
        """Whether the recorder's account is true; one failing call costs the ticks up to a snapshot, and a chunk."""
        if not said or (said["error"] and not said.get("paths")):
            return ["the recorder refused, and there are ticks"] if said and ticks else []
        problems = []
        if said["complete"] != (ticks == TICKS and said["error"] is None):
            problems.append(f"the recorder says complete: {said['complete']}; {ticks} of {TICKS} ticks are there")
        if TICKS - ticks > SNAPSHOT_TICKS + 2 * chunk_rows(header()["columns"]):
            problems.append(f"{TICKS - ticks} ticks lack after one failing call")
        return problems

    def _said(self) -> dict[str, Any]:
        """The totals that the recorder printed; none if it died."""
        text = self.output.read_text() if self.output.exists() else ""
        return json.loads(text) if text.endswith("\n") else {}

    def _record(self, sequence: int) -> None:
        """As another recorder does."""
        following = Recorder(self.block)
        options = Options(**{**OPTIONS, "sequence": sequence})
        begun = Session(self.block, self.path, header(), options)
        orders = SupervisorOrders()
        orders.next = lambda wait_s=0.0: None  # type: ignore[method-assign]  # it gets none
        begun.finish(following.record(begun, orders, 0.0))
