"""A child process of the supervisor: one value on its stdin, JSON lines on its stdout."""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import sys
import threading
from typing import Any

END_TIMEOUT_S = 5.0


class Child:
    """`python -m MODULE --fd N`, and `--NAME M` of further files.

    In a process group of its own, so that a terminal's Ctrl-C reaches the parent alone.
    """

    def __init__(self, module: str, fd: int, **other_files: int) -> None:
        files = {"fd": fd, **other_files}
        options = [word for name, file in files.items() for word in (f"--{name}", str(file))]
        self.process = subprocess.Popen(
            [sys.executable, "-m", module, *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=[*files.values()],
            process_group=0,
        )
        self._reports: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def send(self, data: bytes) -> None:
        """Write to the child's stdin, as fast as it reads; a child that has gone is noticed by its exit code."""
        threading.Thread(target=self._write, args=(data,), daemon=True).start()

    def _write(self, data: bytes) -> None:
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError, ValueError):  # it has gone, or its stdin was closed meanwhile
            self.process.stdin.write(data)
            self.process.stdin.flush()

    def reports(self) -> list[dict[str, Any]]:
        """The JSON lines that came since the last call."""
        reports = []
        while not self._reports.empty():
            reports.append(self._reports.get())
        return reports

    @property
    def exit_code(self) -> int | None:
        """None while it runs; negative where a signal ended it."""
        return self.process.poll()

    def wait(self, timeout_s: float) -> int | None:
        """Its exit code, or None after `timeout_s`."""
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None
        self._reader.join(timeout_s)
        return code

    def kill(self) -> None:
        """Kill it if it still runs, and wait for nothing: a process may hang in the kernel."""
        if self.process.poll() is None:
            self.process.kill()

    def end(self) -> bool:
        """Kill it if it still runs, and close its pipes; False where it does not die."""
        self.kill()
        if self.wait(END_TIMEOUT_S) is None:
            return False
        self.close_stdin()
        if self.process.stdout is not None:
            with contextlib.suppress(OSError):
                self.process.stdout.close()
        return True

    def close_stdin(self) -> None:
        """Say that nothing more will come; a child that waits for its orders ends."""
        if self.process.stdin is not None:
            with contextlib.suppress(OSError):
                self.process.stdin.close()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            try:
                report = json.loads(line)
            except ValueError:
                continue
            if isinstance(report, dict):
                self._reports.put(report)
