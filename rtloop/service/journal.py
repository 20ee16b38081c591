"""Log lines to stderr without waiting for its reader: a full pipe loses lines, which are counted, and no time."""

from __future__ import annotations

import logging
import os
import queue

from rtloop.foundation import timing

MAX_LINES = 1000
"""Most lines that wait for a slow reader."""
FLUSH_S = 1.0
STDERR = 2


class Journal(logging.Handler):
    """A logging handler whose `emit` never blocks; a separate thread writes to the file descriptor `fd`.

    At most `lines` lines wait for that thread.
    """

    def __init__(self, fd: int = STDERR, lines: int = MAX_LINES) -> None:
        """Start the thread that writes lines to the descriptor `fd`; at most `lines` wait for it."""
        super().__init__()
        self._fd, self._lost_count = fd, 0
        self._lines: queue.Queue[str] = queue.Queue(lines)
        timing.start_thread(self._write)

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a line for the writing thread, without waiting; count it as lost if the queue is full."""
        try:
            self._lines.put_nowait(self.format(record))
        except queue.Full:
            self._lost_count += 1
        except Exception:
            self.handleError(record)

    def flush(self) -> None:
        """Wait until the queued lines are written, at most FLUSH_S; the others stay queued."""
        deadline_s = timing.monotonic_s() + FLUSH_S
        while self._lines.unfinished_tasks and timing.monotonic_s() < deadline_s:
            timing.sleep(0.001)

    def _write(self) -> None:
        """Write queued lines for ever. A note after a line states how many lines were lost since the last note; lines
        for a closed pipe are dropped.
        """
        while True:
            line = self._lines.get()
            self.acquire()  # `handle` holds this lock around `emit`.
            lost_count, self._lost_count = self._lost_count, 0
            self.release()
            if lost_count:
                line = f"{line}\n({lost_count} lines of the log are lost here, because stderr was read too slowly)"
            data = line.encode(errors="replace") + b"\n"
            try:
                while data:
                    data = data[os.write(self._fd, data) :]
            except OSError:
                pass  # The reader has closed the pipe.
            self._lines.task_done()
