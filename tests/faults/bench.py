"""A service on a board, both real processes in a folder of their own, and the evidence that the board keeps."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from rtloop.client import Client
from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import RtloopError
from rtloop.hil import board
from tests.faults import plain_card
from tests.faults.configuration import ROOT, Bounds, on_a_board, on_a_card, patient
from tests.faults.evidence import TIMEOUT_S, Evidence, wait_for
from tests.faults.host import HostWitness

START_POLL_S = 0.05
"""While processes start, who looks often takes the processor from them."""


class Bench(Evidence):
    """`with Bench(folder) as bench`: a service that runs in closed loop on a board, or on a plain card.

    Where `strict`, a process that stands still for 50 ms is killed, as in a laboratory. For tests of other things it is
    patient: a host that holds up the loop does not end it.
    """

    def __init__(
        self,
        folder: Path,
        *changes: tuple[str, str],
        card: bool = False,
        board: bool = True,
        text: str | None = None,
        name: str = "lab",
        environment: dict[str, str] | None = None,
        strict: bool = False,
    ) -> None:
        super().__init__(folder, card)
        self.config = folder / f"{name}.toml"
        self._with_board = board and not card
        text = text or (on_a_card if card else on_a_board)(folder, *changes)
        self.config.write_text(text if strict else patient(text))
        self.environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), str(folder), os.environ.get("PYTHONPATH")])),
            "RUNTIME_DIRECTORY": str(folder / "run"),
            **(environment or {}),
        }
        self.client = Client(folder / "run" / f"{name}.sock")
        self.board: subprocess.Popen[str] | None = None
        self.service: subprocess.Popen[str] | None = None
        self.blocks: list[SharedBlock] = []
        self.stderr: int | None = None
        """Where processes that are started from now on complain, if not to the log."""
        self._started: list[subprocess.Popen[str]] = []
        if card:
            plain_card.install(folder)

    def __enter__(self) -> Bench:
        self._host = HostWitness(self.folder)
        try:
            if self._with_board:
                self.start_board()
            self.start_service()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        if self._host is not None:
            self._host.end()
        for block in self.blocks:
            for word in (Word.LOOP_PID, Word.RECORDER_PID):
                if pid := block.load(word):
                    self._end_child(pid)
        for process in self._started:
            if process.poll() is None:
                process.kill()
            process.wait()

    # processes

    def rtloop(self, *arguments: str | Path) -> subprocess.Popen[str]:
        """Start a command; what it says goes to a log that `log` shows."""
        command = [sys.executable, "-m", "rtloop", *map(str, arguments)]
        with open(self.folder / "log", "a") as log:
            stderr = log if self.stderr is None else self.stderr
            process = subprocess.Popen(command, env=self.environment, stdout=log, stderr=stderr, text=True)
        self._started.append(process)
        return process

    def start_board(self) -> None:
        """Start the board and wait until it takes samples."""
        self.board = self.rtloop("hil", "serve", self.config)
        path = self.folder / "board"
        there = lambda: path.exists() and path.stat().st_size >= board.file_bytes()
        wait_for(there, "a board", poll_s=START_POLL_S)
        before = int(self.memory.words[board.SEQUENCE])  # of a board that was killed
        running = lambda: self.memory.facts["magic"][0] == board.MAGIC and self.memory.words[board.SEQUENCE] != before
        wait_for(running, "a board that runs", poll_s=START_POLL_S)

    def start_service(self) -> None:
        """Start the service and wait until its loop runs."""
        self.service = self.rtloop("serve", self.config)
        wait_for(lambda: self.status().get("ticks"), "a loop that runs", poll_s=START_POLL_S)
        self.follow()

    def follow(self) -> SharedBlock:
        """The shared block of the present loop, which stays readable after the loop's end."""
        path = self.folder / "run" / f"{self.config.stem}.block"
        wait_for(lambda: path.stat().st_size, "a shared block")
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        self.blocks.append(SharedBlock(fd))
        return self.blocks[-1]

    def _follows_the_present_loop(self) -> bool:
        path = self.folder / "run" / f"{self.config.stem}.block"
        return path.exists() and os.path.samestat(os.fstat(self.blocks[-1].fd), path.stat())

    def pid(self, role: str) -> int:
        """Process of the service, of its present loop ("rt") or of its present recorder."""
        assert self.service is not None
        if role == "service":
            return self.service.pid
        return self.blocks[-1].load(Word.LOOP_PID if role == "rt" else Word.RECORDER_PID)

    def safe_pids(self) -> list[int]:
        """The service and the present loop."""
        loops = [pid for block in self.blocks[-1:] if (pid := block.load(Word.LOOP_PID))]
        return [*([self.service.pid] if self.service else []), *loops]

    @property
    def bounds(self) -> Bounds:
        """What the configuration, as it is now, allows the output."""
        return Bounds.of(self.config.read_text(), self.resolution_v)

    def _end_child(self, pid: int) -> None:
        """End a loop or recorder of ours that still lives; its number may belong to somebody else by now."""
        with suppress(OSError):
            if (
                str(ROOT) in Path(f"/proc/{pid}/environ").read_text()
                and str(self.folder) in Path(f"/proc/{pid}/environ").read_text()
            ):
                os.kill(pid, signal.SIGKILL)

    # what the service says

    def status(self) -> dict[str, Any]:
        """Of the service; empty while it does not answer."""
        try:
            return self.client.get("/status")
        except RtloopError:
            return {}

    def await_state(self, state: str, *causes: str, timeout_s: float = TIMEOUT_S) -> dict[str, Any]:
        """Wait for a state, and for trips of these causes among others."""
        report: dict[str, Any] = {}

        def there() -> bool:
            nonlocal report
            report = self.status()
            return report.get("state") == state and set(causes) <= set(report.get("trip", ()))

        try:
            wait_for(there, f"{state} {' '.join(causes)}", timeout_s)
        except AssertionError as error:
            there_is = {key: report.get(key) for key in ("state", "trip", "faults")}
            raise AssertionError(f"{error}; there is {there_is}; {self.log()[-600:]}") from None
        return report

    def await_restart(self, count: int = 1) -> None:
        """Wait for a new loop in place of one that ended."""
        wait_for(lambda: self.status().get("restarts", 0) >= count and self.status().get("ticks"), "a restart")
        self.follow()

    def await_drive(self) -> None:
        """Wait until the loop is closed and drives."""
        self.await_state("running")
        wait_for(lambda: abs(self.seen().last_v) > 1.0, "a drive")
        ticks = self.ticks

        def executed() -> bool:
            assert self._follows_the_present_loop(), f"the loop was replaced; {self.log()[-600:]}"
            return self.ticks > ticks + 1000

        wait_for(executed, "a thousand ticks")

    def recover(self) -> None:
        """Reset what is tripped, start, and see that it drives again."""
        before = wait_for(self.status, "an answer")
        if before["state"] == "tripped":
            self.client.post("/reset")
        try:
            self.client.post("/start")
        except RtloopError as error:
            raise AssertionError(f"{error}; before {before}; now {self.status()}; {self.log()[-600:]}") from None
        self.await_drive()

    @property
    def ticks(self) -> int:
        """Executed by the newest loop that is followed."""
        return int(self.blocks[-1]["ticks_head"][0])

    def log(self) -> str:
        """What all processes said."""
        return (self.folder / "log").read_text()

    def stop(self) -> int:
        """SIGTERM to the service; its exit code."""
        assert self.service is not None
        if self.service.poll() is None:
            self.service.send_signal(signal.SIGTERM)
        return self.service.wait(TIMEOUT_S)
