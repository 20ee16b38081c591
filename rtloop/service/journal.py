"""Log lines to stderr that never wait for whoever reads them: a full pipe costs lines, which are counted, not time."""

from __future__ import annotations

import logging
import os
import queue
import threading
import time

LINES = 1000
"""Kept while nobody reads."""
FLUSH_S = 1.0
STDERR = 2


class Journal(logging.Handler):
    """A handler whose `emit` never blocks; a thread of its own writes, straight to the descriptor."""

    def __init__(self, fd: int = STDERR, lines: int = LINES) -> None:
        super().__init__()
        self._fd, self._lost = fd, 0
        self._lines: queue.Queue[str] = queue.Queue(lines)
        threading.Thread(target=self._write, daemon=True).start()

    def emit(self, record: logging.LogRecord) -> None:
        """Hand a line over."""
        try:
            self._lines.put_nowait(self.format(record))
        except queue.Full:
            self._lost += 1
        except Exception:
            self.handleError(record)

    def flush(self) -> None:
        """Give what was said last some time to be written."""
        deadline_s = time.monotonic() + FLUSH_S
        while self._lines.unfinished_tasks and time.monotonic() < deadline_s:
            time.sleep(0.001)

    def _write(self) -> None:
        while True:
            line = self._lines.get()
            self.acquire()  # the lock that `handle` holds around `emit`
            lost_count, self._lost = self._lost, 0
            self.release()
            if lost_count:
                line = f"{line}\n({lost_count} lines were lost here: nobody read them)"
            data = line.encode(errors="replace") + b"\n"
            try:
                while data:
                    data = data[os.write(self._fd, data) :]
            except OSError:
                pass  # whoever read has gone
            self._lines.task_done()
