"""Bench of the fault suite: service and board as real processes in one folder, and the board's record of its output."""

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
"""Longer than POLL_S: frequent polling would take the processor from the processes that start."""


class Bench(Evidence):
    """`with Bench(folder) as bench`: a service that runs in closed loop on a board, or on a plain card.

    With `strict`, a process that stands still for 50 ms is killed, as in a laboratory. Without it, the service waits
    PATIENCE_S: a host that stalls the loop does not end the run.
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
        """Descriptor that processes started from now on get as stderr; None: the log."""
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
        """Start `rtloop ARGUMENTS` and return its process; its output goes to the file that `log` returns."""
        command = [sys.executable, "-m", "rtloop", *map(str, arguments)]
        with open(self.folder / "log", "a") as log:
            stderr = log if self.stderr is None else self.stderr
            process = subprocess.Popen(command, env=self.environment, stdout=log, stderr=stderr, text=True)
        self._started.append(process)
        return process

    def start_board(self) -> None:
        """Start the board and wait until it converts samples."""
        self.board = self.rtloop("hil", "serve", self.config)
        path = self.folder / "board"
        has_memory = lambda: path.exists() and path.stat().st_size >= board.file_bytes()
        wait_for(has_memory, "a board", poll_s=START_POLL_S)
        old = int(self.memory.words[board.SEQUENCE])  # a killed board has left its own
        is_running = lambda: self.memory.facts["magic"][0] == board.MAGIC and self.memory.words[board.SEQUENCE] != old
        wait_for(is_running, "a board that runs", poll_s=START_POLL_S)

    def start_service(self) -> None:
        """Start the service and wait until its loop runs."""
        self.service = self.rtloop("serve", self.config)
        wait_for(lambda: self.status().get("ticks"), "a loop that runs", poll_s=START_POLL_S)
        self.follow()

    def follow(self) -> SharedBlock:
        """Map the shared block of the present loop and return it; it stays readable after the loop's end."""
        path = self.folder / "run" / f"{self.config.stem}.block"
        wait_for(lambda: path.stat().st_size, "a shared block")
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        self.blocks.append(SharedBlock(fd))
        return self.blocks[-1]

    def _follows_the_present_loop(self) -> bool:
        """Return whether the newest block of `blocks` is that of the present loop."""
        path = self.folder / "run" / f"{self.config.stem}.block"
        return path.exists() and os.path.samestat(os.fstat(self.blocks[-1].fd), path.stat())

    def pid(self, role: str) -> int:
        """Return the process id of the service, of its present loop (role "rt") or of its present recorder."""
        assert self.service is not None
        if role == "service":
            return self.service.pid
        return self.blocks[-1].load(Word.LOOP_PID if role == "rt" else Word.RECORDER_PID)

    def safe_pids(self) -> list[int]:
        """Return the process ids of the service and of the present loop."""
        loops = [pid for block in self.blocks[-1:] if (pid := block.load(Word.LOOP_PID))]
        return [*([self.service.pid] if self.service else []), *loops]

    @property
    def bounds(self) -> Bounds:
        """Largest steps and changes of the output that the present text of the configuration allows."""
        return Bounds.from_text(self.config.read_text(), self.resolution_v)

    def _end_child(self, pid: int) -> None:
        """Kill a loop or recorder of this bench; a process of others that has got its number is not touched."""
        with suppress(OSError):
            if (
                str(ROOT) in Path(f"/proc/{pid}/environ").read_text()
                and str(self.folder) in Path(f"/proc/{pid}/environ").read_text()
            ):
                os.kill(pid, signal.SIGKILL)

    # status, states, log

    def status(self) -> dict[str, Any]:
        """Return the service's status; empty while the service does not answer."""
        try:
            return self.client.get("/status")
        except RtloopError:
            return {}

    def await_state(self, state: str, *causes: str, timeout_s: float = TIMEOUT_S) -> dict[str, Any]:
        """Wait until the service is in `state` with trips of at least these causes; return its status."""
        report: dict[str, Any] = {}

        def is_reached() -> bool:
            nonlocal report
            report = self.status()
            return report.get("state") == state and set(causes) <= set(report.get("trip", ()))

        try:
            wait_for(is_reached, f"{state} {' '.join(causes)}", timeout_s)
        except AssertionError as error:
            present = {key: report.get(key) for key in ("state", "trip", "faults")}
            raise AssertionError(f"{error}; the state is {present}; {self.log()[-600:]}") from None
        return report

    def await_restart(self, count: int = 1) -> None:
        """Wait until the service has replaced `count` loops, and follow the newest one."""
        wait_for(lambda: self.status().get("restarts", 0) >= count and self.status().get("ticks"), "a restart")
        self.follow()

    def await_drive(self) -> None:
        """Wait until the loop runs with more than 1 V at the output, and for 1,000 further ticks."""
        self.await_state("running")
        wait_for(lambda: abs(self.output_record().last_v) > 1.0, "a drive")
        ticks = self.ticks

        def executed() -> bool:
            assert self._follows_the_present_loop(), f"the loop was replaced; {self.log()[-600:]}"
            return self.ticks > ticks + 1000

        wait_for(executed, "a thousand ticks")

    def recover(self) -> None:
        """Reset a trip, start the loop, and wait until it drives."""
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
        """Number of ticks that the loop of the newest block has executed."""
        return int(self.blocks[-1]["ticks_head"][0])

    def log(self) -> str:
        """Return the output of all processes of the bench."""
        return (self.folder / "log").read_text()

    def stop(self) -> int:
        """Send SIGTERM to the service and return its exit code."""
        assert self.service is not None
        if self.service.poll() is None:
            self.service.send_signal(signal.SIGTERM)
        return self.service.wait(TIMEOUT_S)
