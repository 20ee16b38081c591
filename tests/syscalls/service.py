"""The service's start and stop: its supervising thread is traced, loop and recorder are its real children.

A board in a process of its own says what the output did. The folders stay from try to try: each start is the next
hand of the try before it. The last loop's files are judged and removed.
"""

from __future__ import annotations

import atexit
import logging
import os
import time
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

from rtloop.drivers.errors import DriverError
from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import RtloopError
from rtloop.hil.board import LSB_V
from rtloop.recording.file.parts import files_of_run
from rtloop.recording.file.recover import leftovers, recover
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from rtloop.service.daemon import serve
from rtloop.supervision.parking import park_configuration
from rtloop.supervision.paths import block_path, open_block
from tests.faults.bench import Bench
from tests.faults.configuration import BOARD_RATE_HZ
from tests.faults.evidence import step_bound_v, wait_for
from tests.syscalls.component import Case
from tests.syscalls.recordings import MAGIC
from tests.syscalls.traced import Outcome

DURATION_S = 0.3
CHANGES = (("[loop]\n", "[loop]\nheartbeat_timeout_s = 0.3\n"), ("[recording]", "[service]\nrestarts = 0\n[recording]"))


@cache
def _bench() -> Bench:
    """A board that runs until this process ends, and the configuration of a service on it."""
    bench = Bench(Path(mkdtemp(prefix="rtloop-syscalls-")), *CHANGES)
    os.environ["RUNTIME_DIRECTORY"] = str(bench.folder / "run")
    atexit.register(bench.__exit__)
    bench.start_board()
    return bench


class Serving(Case):
    """A service that starts its loop and recorder, runs for a moment, and ends."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.bench = _bench()
        self.recordings = self.bench.folder / "recordings"

    def prepare_child(self) -> None:
        """What it logs goes to a file."""
        logging.getLogger().handlers.clear()
        for number in (1, 2):
            os.dup2(os.open(self.bench.folder / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)

    def work(self) -> None:
        serve(self.bench.config, DURATION_S)

    def judge(self, outcome: Outcome) -> list[str]:
        problems = []
        if outcome.finished and self.bench.seen().last_v != 0.0:
            problems.append("the service has ended, and its output is up")
        try:
            park_configuration(self.bench.config)
        except (RtloopError, DriverError) as error:
            problems.append(f"the next hand cannot park: {error}")
        wait_for(lambda: self.bench.seen().last_v == 0.0, "a safe output")
        seen, bound_v = self.bench.seen(), step_bound_v(BOARD_RATE_HZ)
        if seen.largest_step_v > bound_v + LSB_V:
            problems.append(f"a step of {seen.largest_step_v:.3f} V, allowed {bound_v:.3f} V")
            self.bench.memory.seen[0].largest_write_step_v = 0.0
        return problems + self._problems_of_files()

    def _problems_of_files(self) -> list[str]:
        """As the next start does, what was left is recovered; then it is judged by the shared block, and removed."""
        (written, executed), problems = self._ended_recorder(), []
        for part in leftovers(self.recordings):
            recover(part)
        paths = sorted(self.recordings.glob("*.mcap"))
        runs = [path for path in paths if path.stem.count("-") == 1]
        ticks = 0
        for run in runs:
            files = files_of_run(run, ".mcap")
            problems += [f"{path.name}: has no end" for path in files if not path.read_bytes().endswith(MAGIC)]
            verdict, summary = replay(load(files)), summarise(files)
            ticks = len(load(files))
            if not verdict.identical or verdict.ticks != ticks:
                problems.append(f"replay says {verdict}")
            if summary.complete and ticks != executed:
                problems.append(f"info says complete: {ticks} of {executed} ticks")
        if ticks < written:
            problems.append(f"{written} ticks were written, {ticks} are in a file")
        for path in self.recordings.glob("*"):
            path.unlink()
        return problems

    def _ended_recorder(self) -> tuple[int, int]:
        """Ticks that the last recorder wrote, and ticks executed; it is ended first, as the unit's end does."""
        fd = open_block(block_path(self.bench.config.stem))
        if fd is None or not os.fstat(fd).st_size:
            return 0, 0
        block = SharedBlock(fd)
        if pid := block.load(Word.RECORDER_PID):
            self.bench._end_child(pid)
            wait_for(lambda: not Path(f"/proc/{pid}/fd").exists() or not _is_alive(pid), "the recorder's end")
        os.close(fd)
        return block.load(Word.FLUSHED_TICKS) - block.load(Word.LOST_TICKS), int(block["ticks_head"][0])


def _is_alive(pid: int) -> bool:
    try:
        time.sleep(0.001)
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
