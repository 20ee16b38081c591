"""A child process of the supervisor: one value on its stdin, JSON lines on its stdout."""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import threading
from pathlib import Path
from typing import Any

from rtloop.foundation.children import child_environment, python_command
from rtloop.foundation.processors import processor_time_s

END_TIMEOUT_S = 5.0
STATE_FIELD, READY_TO_RUN = 0, "R"
"""Index of the state in `stat_fields`; state of a process that runs or waits for a processor."""


class Child:
    """The process `python -m MODULE --fd N --NAME M …`, with one option for each open file that it inherits.

    The process has a separate process group, so that a terminal's Ctrl-C reaches the parent alone.
    """

    def __init__(self, module: str, fd: int, **other_files: int) -> None:
        """Start `python -m MODULE --fd N --NAME M …` and a thread that reads its stdout.

        `fd` and `other_files`, by option name, are descriptors of open files that the child inherits. Raises OSError if
        the process cannot be started.
        """
        files = {"fd": fd, **other_files}
        options = [word for name, file in files.items() for word in (f"--{name}", str(file))]
        self.process = subprocess.Popen(
            python_command(module, *options),
            env=child_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=[*files.values()],
            process_group=0,
        )
        self._reports: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def send(self, data: bytes) -> None:
        """Write `data` to the child's stdin in a separate thread, so that a slow child does not delay the caller.

        Raises no error if the child has ended: `exit_code` shows the end.
        """
        threading.Thread(target=self._write, args=(data,), daemon=True).start()

    def _write(self, data: bytes) -> None:
        """Write `data` to the child's stdin and flush it; no effect once the child or its stdin has ended."""
        stdin = self.process.stdin
        with contextlib.suppress(BrokenPipeError, ValueError):  # The child has ended, or its stdin was closed.
            if stdin is not None:
                stdin.write(data)
                stdin.flush()

    def reports(self) -> list[dict[str, Any]]:
        """Return the JSON objects that the child has written since the last call, oldest first; [] for none."""
        reports = []
        while not self._reports.empty():
            reports.append(self._reports.get())
        return reports

    @property
    def exit_code(self) -> int | None:
        """Exit code of the child: None while it runs, negative (the signal's number) if a signal ended it."""
        return self.process.poll()

    @property
    def processor_s(self) -> float:
        """Processor time that the child has used, in s; 0 once it has ended."""
        return processor_time_s(self.process.pid)

    @property
    def is_ready_to_run(self) -> bool:
        """Whether the child's main thread runs or waits for a processor; False if /proc cannot be read."""
        try:
            return stat_fields(self.process.pid)[STATE_FIELD] == READY_TO_RUN
        except OSError:
            return False

    def wait(self, timeout_s: float) -> int | None:
        """Wait for the child's end and last reports. Returns its exit code; None if it still runs after `timeout_s`."""
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None
        self._reader.join(timeout_s)
        return code

    def kill(self) -> None:
        """Send SIGKILL to a running child, without waiting for its end: a process may hang in the kernel."""
        if self.process.poll() is None:
            self.process.kill()

    def end(self) -> bool:
        """Kill the child, wait for its end, close its pipes. Returns True.

        Returns False, with the pipes open, if it has not died within END_TIMEOUT_S.
        """
        self.kill()
        if self.wait(END_TIMEOUT_S) is None:
            return False
        self.close_stdin()
        if self.process.stdout is not None:
            with contextlib.suppress(OSError):
                self.process.stdout.close()
        return True

    def close_stdin(self) -> None:
        """Close the child's stdin; a child that still waits for its orders then ends."""
        if self.process.stdin is not None:
            with contextlib.suppress(OSError):
                self.process.stdin.close()

    def _read(self) -> None:
        """Queue the JSON objects, one a line, that the child prints, until its stdout ends; other lines are dropped."""
        for line in self.process.stdout or ():
            try:
                report = json.loads(line)
            except ValueError:
                continue
            if isinstance(report, dict):
                self._reports.put(report)


def stat_fields(pid: int) -> list[str]:
    """Return the fields of /proc/PID/stat after the process's name. Raises OSError if it cannot be read."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
