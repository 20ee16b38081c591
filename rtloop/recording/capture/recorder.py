"""The recorder: a process beside the loop that copies the rings into files and does not compute.

    python -m rtloop.recording.capture.recorder --fd N [--names M]

N is the descriptor of the shared block, M the descriptor of the requesters' names. One JSON line on stdin starts a
recording: {"path": ".../NAME.mcap", "header": {...}} and optionally "options": the fields of `session.Options`. Further
lines report removed files: {"removed": {"file": NAME, "size_bytes": N, "reason": ...}}. Once the rings are empty, the
recorder ends with the loop; if stdin is closed, also when no living process drives the block or ABANDONED_S passed
without a new slot. It then prints one JSON line: {path, paths, ticks_logged, ticks_lost, events_lost, bytes, complete,
error, cpu_s}, or {complete, error, cpu_s} if an RtloopError ended the recording. It ignores SIGINT and SIGTERM, so that
the loop's last ticks are recorded too.

RECORDER_STATE is FAILED while no file can be written, and RUNNING again afterwards.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import signal
import sys
import time
from pathlib import Path
from typing import Any

from rtloop.engine.memory import ProcessState, SharedBlock, Word
from rtloop.errors import RtloopError
from rtloop.foundation import timing
from rtloop.foundation.heap import keep_freed_memory
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.capture.rings import RingReader
from rtloop.recording.capture.selective import SelectiveSession
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.errors import RecordingError

POLL_S = 0.4
"""Pause between two looks at the rings: the cost of a look is mostly cold memory, so half as many cost half as much."""
UNPACED_POLL_S = 0.0002
ABANDONED_S = 5.0
"""Time without a new slot in a ring after which the loop counts as dead, if stdin is closed."""


class SupervisorOrders:
    """Reader of JSON lines on stdin, unbuffered, so that `is_closed` shows the end of stdin."""

    def __init__(self) -> None:
        """Begin without reading stdin, which counts as open."""
        self._unread, self.is_closed = b"", False

    def next(self, wait_s: float | None = 0.0) -> dict[str, Any] | None:
        """Return the object of the next line; None if none comes within `wait_s` (None: no limit) or stdin is closed.

        Sets `is_closed` at the end of stdin. Raises ValueError for a line that is not JSON.
        """
        while b"\n" not in self._unread:
            if self.is_closed or not select.select([0], [], [], wait_s)[0]:
                return None
            data = os.read(0, 1 << 16)
            self.is_closed = not data
            self._unread += data
        line, _, self._unread = self._unread.partition(b"\n")
        return json.loads(line)


class Recorder:
    """Recorder that polls the rings of `block` into a Session until the loop has ended; stores its PID in the block."""

    def __init__(self, block: SharedBlock) -> None:
        """Store the number of this process in the block, and compile the functions that read its rings."""
        self.block = block
        block.store(Word.RECORDER_PID, os.getpid())
        for name in ("ticks", "snapshots", "events"):
            RingReader(block, name).take_into(block.ring(name).slots[:0])  # Compiles; takes no slot.

    def record(self, session: Session, orders: SupervisorOrders, pause_s: float) -> str:
        """Poll the rings every `pause_s` until the loop ends. Returns how: "finished", "failed" or "abandoned".

        Writes due data, records removed files, and stores cursor and state in the block. "abandoned": stdin is closed
        (the supervisor closed it or died), the rings are empty, and either no living process drives the block or
        ABANDONED_S passed without a new slot.
        """
        last_tick_s = timing.monotonic_s()
        while True:
            state = self.block.load(Word.LOOP_STATE)
            is_orphaned = orders.is_closed and self.block.driver_pid() is None
            drained_count = session.drain()
            while (order := orders.next()) is not None:
                session.record_removal(order["removed"])
            self.block.store(Word.RECORDER_CURSOR, session.cursor)
            session.write_due()
            self.block.store(Word.RECORDER_STATE, ProcessState.FAILED if session.failure else ProcessState.RUNNING)
            if drained_count:
                last_tick_s = timing.monotonic_s()
            elif ProcessState.has_ended(state):
                return ProcessState(state).name.lower()
            elif is_orphaned or (orders.is_closed and timing.monotonic_s() - last_tick_s > ABANDONED_S):
                return "abandoned"
            if drained_count < session.free_rows:
                self._pause(pause_s)

    def _pause(self, pause_s: float) -> None:
        """Sleep for `pause_s`; if the control loop has ended after the first half, leave out the second half."""
        timing.sleep(pause_s / 2)
        if not ProcessState.has_ended(self.block.load(Word.LOOP_STATE)):
            timing.sleep(pause_s / 2)


def _is_supervisor_gone() -> bool:
    """Whether stdin has no writer any more; does not read from stdin."""
    poll = select.poll()
    poll.register(0, 0)
    return bool(poll.poll(0))


def record_run(fd: int, names: RequesterNames | None = None) -> int:
    """Record one run from the shared block at descriptor `fd`, as a line on stdin orders; print the totals as JSON.

    Waits for the block and the order, and stores RECORDER_STATE in the block. Returns the exit code: 0, also if the
    supervisor ended before the block existed (without a print), or 1 if the totals name an error: an RtloopError, or a
    failed write, even if recording resumed. Other errors, such as those of a damaged block or a malformed order, are
    raised without a print.
    """
    try:
        block = SharedBlock.attach(fd, _is_supervisor_gone)
    except EOFError:
        return 0  # The supervisor ended before there was a block.
    recorder = Recorder(block)
    block.store(Word.RECORDER_STATE, ProcessState.READY)
    totals: dict[str, object]
    try:
        orders = SupervisorOrders()
        if (command := orders.next(None)) is None:
            raise RecordingError(
                "the recorder received no instructions from the supervisor; allowed: one line of JSON with `path` and "
                "`header` on stdin. `rtloop run` and `rtloop serve` start a recorder and give them"
            )
        header = command["header"]
        session_class = SelectiveSession if header.get("around") else Session
        session = session_class(block, Path(command["path"]), header, Options(**command.get("options", {})), names)
        block.store(Word.RECORDER_STATE, ProcessState.RUNNING)
        result = recorder.record(session, orders, POLL_S if header["paced"] else UNPACED_POLL_S)
        totals = session.finish(result)
    except RtloopError as error:
        totals = {"complete": False, "error": str(error)}
    totals["cpu_s"] = round(time.process_time(), 3)
    succeeded = totals["error"] is None
    block.store(Word.RECORDER_STATE, ProcessState.FINISHED if succeeded else ProcessState.FAILED)
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(totals), flush=True)
    return 0 if succeeded else 1


def main() -> int:
    """Run the recorder from the command line, ignoring SIGINT and SIGTERM. Returns the exit code."""
    parser = argparse.ArgumentParser(prog="rtloop.recording.capture.recorder", description="record the loop's rings")
    parser.add_argument("--fd", type=int, required=True, help="file descriptor of the shared block")
    parser.add_argument("--names", type=int, help="file descriptor of the requesters' names")
    arguments = parser.parse_args()
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return record_run(arguments.fd, None if arguments.names is None else RequesterNames(arguments.names))


if __name__ == "__main__":
    sys.exit(main())
