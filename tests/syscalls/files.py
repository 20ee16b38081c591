"""Components that write, repair and remove files: recover, cut and quota."""

from __future__ import annotations

import json
import shutil
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from types import SimpleNamespace
from typing import Any, cast

from rtloop.engine.messages import Kind, message
from rtloop.recording.cutting.cut import cut, cut_path
from rtloop.recording.file.recover import find_leftovers
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import event_from_message
from rtloop.recording.file.topics.format import EVENTS
from rtloop.recording.file.writer import Writer
from rtloop.signals import Flag
from rtloop.supervision.quota import Quota
from rtloop.supervision.recorder_keeper import RecorderKeeper
from tests.recording.hand_made_loop import AXES, START_UNIX_NS, final_message, make_header, make_rows
from tests.syscalls.component import Case
from tests.syscalls.recordings import SNAPSHOT_TICKS, TICKS, run_file_problems, ticks_on_disk, write
from tests.syscalls.traced import Outcome

NAME = "run.mcap"


@cache
def _original(finished: bool) -> Path:
    """Return the path of a finished recording, or of the unfinished file of a killed recorder."""
    path = Path(mkdtemp(prefix="rtloop-syscalls-")) / NAME
    write(path, finished=finished)
    return path if finished else path.with_name(f"{NAME}.part")


class Recovering(Case):
    """The supervisor's repair of a killed recorder's file: it is recovered, then the unfinished file is removed."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.part = Path(shutil.copy(_original(False), folder))
        self.flushed = ticks_on_disk([_original(False)])

    def work(self) -> None:
        self._repair(self.part)

    def judge(self, outcome: Outcome) -> list[str]:
        """Require an intact finished file or the unfinished one, then all flushed ticks after the next repair."""
        problems = [] if outcome.killed or self._is_recovered() or self.part.exists() else ["both files are gone"]
        problems += run_file_problems(self._finished(), set(), complete_ticks=self.flushed)
        for part in find_leftovers(self.folder):
            self._repair(part)
        problems += run_file_problems(self._finished(), self.flushed, complete_ticks=self.flushed)
        unexpected = {path.name for path in self.folder.iterdir()} - {NAME, f"{NAME}.part"}
        return [*problems, *(f"{name} is unexpected" for name in unexpected)]

    def _repair(self, part: Path) -> None:
        RecorderKeeper._repair(cast(RecorderKeeper, SimpleNamespace(notes=[])), part)

    def _finished(self) -> list[Path]:
        return sorted(self.folder.glob("*.mcap"))

    def _is_recovered(self) -> bool:
        return (self.folder / NAME).exists()


class Cutting(Case):
    """The cut: a range of ticks of a recording is copied to a new recording."""

    FIRST, END = 2 * SNAPSHOT_TICKS, TICKS

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.recording = Path(shutil.copy(_original(True), folder))
        self.output = cut_path(self.recording, self.FIRST)

    def work(self) -> None:
        cut(self.recording, self.FIRST, self.END)

    def judge(self, outcome: Outcome) -> list[str]:
        """Require an unchanged recording, a complete cut or none, and a complete cut by the next process."""
        ticks, problems = set(range(self.FIRST, self.END)), []
        if self.recording.read_bytes() != _original(True).read_bytes():
            problems.append("the recording was changed")
        if self.output.exists():  # a killed cut may have been finished
            problems += run_file_problems([self.output], ticks, complete_ticks=ticks)
            self.output.unlink()
        elif outcome.finished:
            problems.append("the cut ends without an error, and its file is missing")
        self.work()
        problems += run_file_problems([self.output], ticks, complete_ticks=ticks)
        unexpected = {path.name for path in self.folder.iterdir()} - {self.recording.name, self.output.name}
        return [*problems, *(f"{name} is unexpected" for name in unexpected)]


PART_TICKS = 5_000


@cache
def _original_runs() -> Path:
    """Return a folder with three runs of several files; the second run tripped at the first tick of its second file."""
    folder = Path(mkdtemp(prefix="rtloop-syscalls-"))
    for run, count in ((1, 2), (2, 3), (3, 2)):
        for number in range(1, count + 1):
            _write_part(folder / f"test-2026010{run}T00000{run}-{number:04d}.mcap", run, number)
    return folder


def _write_part(path: Path, run: int, number: int) -> None:
    """Write file `number` of a run, with 200 of its ticks."""
    first = (number - 1) * PART_TICKS
    around = {"before_s": 0.1, "after_s": 0.2, "every_s": 1.0, "on": ["trip"]}
    facts: dict[str, Any] = {"sequence": number, "first_tick": first, "format": 2, "around": around}
    writer = Writer(path, make_header(**facts, created_unix_ns=START_UNIX_NS + run * 10**9), START_UNIX_NS)
    if (run, number) == (2, 2):
        record = message(Kind.TRIPPED, tick=first + 1, axis=0, values=[Flag.TRIP_POSITION])[0]
        writer.write_messages(
            [Message(EVENTS, START_UNIX_NS, json.dumps(event_from_message(record, AXES, 0)).encode())]
        )
    writer.write_ticks(make_rows(200, first=first))
    writer.finish(lambda logged: final_message(first + PART_TICKS, logged))


class KeepingQuota(Case):
    """A quota of one file: the oldest recordings are removed, except those around a trip and the newest."""

    REMOVABLE = frozenset(
        ("test-20260101T000001-0001.mcap", "test-20260101T000001-0002.mcap", "test-20260102T000002-0003.mcap",
         "test-20260103T000003-0001.mcap")
    )  # fmt: skip

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        for path in _original_runs().iterdir():
            shutil.copy(path, folder)
        self.quota = Quota(folder, "test", 1, 0)

    def work(self) -> None:
        for _ in range(2):  # the second call is that of the next second
            self.quota.enforce(budget_s=60.0)

    def judge(self, outcome: Outcome) -> list[str]:
        """Require that only removable recordings are removed, and that the next process removes all of them."""
        problems = self._wrongly_removed()
        Quota(self.folder, "test", 1, 0).enforce(budget_s=60.0)
        problems += self._wrongly_removed()
        not_removed = {path.name for path in self.folder.iterdir()} & self.REMOVABLE
        return [*problems, *(f"{name} is not removed by the next process" for name in not_removed)]

    def _wrongly_removed(self) -> list[str]:
        """Return the problems of files that had to stay: removed or changed ones."""
        originals = _original_runs()
        removed = {file.name for file in originals.iterdir()} - {file.name for file in self.folder.iterdir()}
        changed = [
            file.name for file in self.folder.iterdir() if file.read_bytes() != (originals / file.name).read_bytes()
        ]
        return [f"{name} was removed or changed" for name in (*(removed - self.REMOVABLE), *changed)]
