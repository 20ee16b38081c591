"""The recorder as the supervisor keeps it: started, watched, replaced when it dies, its files put in order.

All of that may wait for a disk, and so it happens in a thread of its own: nobody who watches the loop, or parks it,
waits for a file.
"""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

from rtloop.configuration.recording import RecordingOptions
from rtloop.engine.memory import ProcessState, SharedBlock, Word
from rtloop.errors import OutputError, RtloopError
from rtloop.foundation.trusted import open_without_link
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.file.recover import recover
from rtloop.recording.file.run_readers import run_files
from rtloop.supervision.child import Child
from rtloop.supervision.quota import Quota, Removal
from rtloop.supervision.stall import StallWatch
from rtloop.values import count_text

MODULE = "rtloop.recording.capture.recorder"
STALL_S = 3.0
LONGEST_STEP_S = 0.1
END_TIMEOUT_S = 30.0
MAX_REPLACEMENTS = 10
POLL_S = 0.01
QUOTA_S, FINAL_QUOTA_BUDGET_S = 1.0, 10.0
"""Between two looks at what the recordings take; for the one at the end."""


class RecorderKeeper:
    """Keeps one recorder running on `block`, writing the file or files of `path`.

    A recorder that died or stands still is replaced; the next one goes on where the last one's file ends, so nothing
    is lost while the ring still holds it. `start`, then `finish`, and `totals` once that has come to its end.
    """

    def __init__(
        self, child: Child, block: SharedBlock, names: RequesterNames, path: Path, options: RecordingOptions
    ) -> None:
        self._child, self._block, self._names, self._path, self._options = child, block, names, path, options
        self._header: dict[str, Any] = {}
        self._watch = StallWatch(STALL_S, LONGEST_STEP_S)
        self._has_orders = False
        self._finishing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.recording = False
        """Whether the file is open."""
        self.failure: RtloopError | None = None
        """Why nothing can be recorded at all."""
        self.totals: dict[str, Any] | None = None
        """What was recorded, with all `paths`, once that is known."""
        self.replacements = 0
        self.notes: list[str] = []
        self.quota: Quota | None = None
        self.removals: list[str] = []
        """What the quota removed, or could not, in words."""
        self._unsent_removals: list[Removal] = []
        self._quota_time_s = 0.0

    @property
    def state(self) -> int:
        """Of the present recorder, a ProcessState."""
        return self._block.load(Word.RECORDER_STATE)

    @property
    def written_state(self) -> dict[str, Any]:
        """{file: the run's recording, written_ticks: the tick behind those that are in its files, or lost}."""
        return {"file": str(self._path.resolve()), "written_ticks": self._block.load(Word.FLUSHED_TICKS)}

    @property
    def exit_code(self) -> int | None:
        """Of the present recorder's process."""
        return self._child.exit_code

    def start(self, header: dict[str, Any]) -> None:
        """Hand over the header; `recording` once the file is open, or `failure`."""
        self._header = header
        if self._options.keep_gib is not None:
            min_free_bytes = round(self._options.min_free_mib * 2**20)
            self.quota = Quota(self._path.parent, header["name"], round(self._options.keep_gib * 2**30), min_free_bytes)
        self._thread.start()

    def finish(self) -> None:
        """Have the recorder come to its end, and its files put in order."""
        self._finishing.set()

    def close(self) -> None:
        """End it, whatever it is doing."""
        self._finishing.set()
        self._child.kill()

    def _run(self) -> None:
        try:
            self._start_recording()
            self.recording = True
            while not self._finishing.wait(POLL_S):
                self._replace_if_dead()
                self._enforce_quota_when_due()
            self.totals = self._finish()
        except RtloopError as error:
            self.failure = error
        finally:
            if self.totals is None:
                reason = str(self.failure or "keeping the recorder failed")
                self.totals = {"path": str(self._path), "paths": [], "complete": False, "error": reason}

    def _enforce_quota_when_due(self) -> None:
        if self.quota is not None and time.monotonic() - self._quota_time_s >= QUOTA_S:
            self._unsent_removals += self._enforce_quota(self.quota)
            self._quota_time_s = time.monotonic()
            self._send_removals()

    def _enforce_quota(self, quota: Quota, *budget_s: float) -> list[Removal]:
        """What the quota removed; a failure is said once."""
        previous_failure = quota.failure
        new_removals = quota.enforce(*budget_s)
        self.removals += [
            *map(str, new_removals),
            *([quota.failure] if quota.failure not in (None, previous_failure) else []),
        ]
        return new_removals

    def _send_removals(self) -> None:
        """What was removed becomes events of the recording, once there is a recorder that has its orders."""
        if self._unsent_removals and self._has_orders and self.state in (ProcessState.RUNNING, ProcessState.FAILED):
            lines = [json.dumps({"removed": removal.event_details}) + "\n" for removal in self._unsent_removals]
            self._child.send("".join(lines).encode())
            self._unsent_removals.clear()

    def _start_recording(self) -> None:
        """Give the recorder its orders and wait until the file is open. Raises OutputError."""
        self._send_orders()
        while self.state == ProcessState.READY and self.exit_code is None:
            time.sleep(0.002)
        if self.state != ProcessState.RUNNING:
            self._child.wait(END_TIMEOUT_S)
            raise OutputError(
                f"{self._path}: cannot record: {self._newest_report().get('error') or 'the recorder ended'}"
            )

    def _replace_if_dead(self) -> None:
        """Replace a recorder that died or stands still; give a new one its orders.

        A recorder whose process ends by itself after the loop has come to its end is done.
        """
        if not self._has_orders:
            if self.state == ProcessState.READY:
                self._send_orders()
            return
        cursor = self._block.load(Word.RECORDER_CURSOR)
        is_behind = int(self._block["ticks_head"][0]) != cursor
        is_stuck = self._watch.has_stalled(cursor, time.monotonic()) and is_behind
        loop_ended = ProcessState.has_ended(self._block.load(Word.LOOP_STATE))
        has_died = self.exit_code is not None and not (loop_ended and self.exit_code >= 0)
        if (has_died or is_stuck) and self.replacements < MAX_REPLACEMENTS:
            reason = "stood still" if is_stuck else f"died (exit code {self.exit_code})"
            if not self._child.end():
                return  # it hangs in the kernel, where its file is: it may yet go on
            self.notes.append(f"the recorder {reason} and was replaced")
            self.replacements += 1
            self._block.store(Word.RECORDER_STATE, ProcessState.STARTING)
            self._child, self._has_orders = Child(MODULE, self._block.fd, names=self._names.fd), False
            self._watch = StallWatch(STALL_S, LONGEST_STEP_S)

    def _finish(self) -> dict[str, Any]:
        """Wait for the end, repair what dead recorders left; the totals, with all `paths`."""
        deadline = time.monotonic() + END_TIMEOUT_S
        while not self._has_orders and time.monotonic() < deadline and self.exit_code is None:
            self._replace_if_dead()
            time.sleep(POLL_S)
        if self._child.wait(END_TIMEOUT_S) is None:
            self.notes.append("the recorder did not end and was killed")
        self._child.end()
        totals = {"path": str(self._path), "complete": False, "error": "the recorder died"} | self._newest_report()
        for part in self._run_files(".mcap.part"):
            self._repair(part)
        if self.quota is not None:
            self._enforce_quota(self.quota, FINAL_QUOTA_BUDGET_S)
            if self.quota.removed_files:
                files, mib = count_text(self.quota.removed_files, "file"), self.quota.removed_bytes / 2**20
                self.notes.append(f"{files} of recordings, {mib:.1f} MiB, removed by recording.keep_gib")
        totals["paths"] = [str(path) for path in self._run_files(".mcap")]
        return totals

    def _run_files(self, suffix: str) -> list[Path]:
        """This run's files, in their order."""
        return run_files(self._path, suffix)

    def _repair(self, part: Path) -> None:
        try:
            report = recover(part, opener=open_without_link)
        except RtloopError as error:
            self.notes.append(str(error))
            return
        self.notes.append(f"{report['output']}: recovered, {count_text(report['ticks'], 'tick')}")
        try:
            part.unlink()
        except OSError as error:
            self.notes.append(f"{part}: is recovered, and cannot be removed: {error.strerror}")

    def _newest_report(self) -> dict[str, Any]:
        reports = self._child.reports()
        return reports[-1] if reports else {}

    def _send_orders(self) -> None:
        options = {
            "rotate_bytes": self._options.rotate_mib and round(self._options.rotate_mib * 2**20),
            "rotate_s": self._options.rotate_s,
            "min_free_bytes": round(self._options.min_free_mib * 2**20),
            "message_index": self._options.message_index,
            "sequence": self._next_sequence(),
        }
        order = {"path": str(self._path), "header": self._header, "options": options}
        self._child.send(json.dumps(order).encode() + b"\n")
        self._has_orders = True

    def _next_sequence(self) -> int:
        """1 for the first recorder, then the number after all files of this run."""
        if self.replacements == 0:
            return 1
        prefix = f"{self._path.stem}-"
        numbered_paths = [
            path for path in (*self._run_files(".mcap"), *self._run_files(".mcap.part")) if path.name.startswith(prefix)
        ]
        return max((int(path.name.removeprefix(prefix).split(".")[0]) for path in numbered_paths), default=1) + 1
