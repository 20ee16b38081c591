"""The thread that starts the recorder's process, watches it, replaces it when it dies, and repairs its files.

All of that may wait for a disk, so it runs in a separate thread: the loop is watched and parked without waiting for a
file.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rtloop.configuration.recording import RecordingOptions
from rtloop.engine.memory import ProcessState, SharedBlock, Word
from rtloop.errors import OutputError, RtloopError
from rtloop.foundation import timing
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
"""Period of the quota's checks; time for reading files in the last check."""


class RecorderKeeper:
    """Keeper of one running recorder on `block`, which writes the file or files of `path`.

    A dead or stalled recorder is replaced; the next one continues where the last file ends, so no tick is lost while
    the ring still has it. Call `start`, then `finish`, and wait until `totals` is not None.
    """

    def __init__(
        self, child: Child, block: SharedBlock, names: RequesterNames, path: Path, options: RecordingOptions
    ) -> None:
        """Take over the recorder's process `child`, which waits for its orders; nothing is started.

        `names` is the table of the names of clients that send commands, which a new recorder inherits.
        """
        self._child, self._block, self._names, self._path, self._options = child, block, names, path, options
        self._header: dict[str, object] = {}
        self._watch = StallWatch(STALL_S, LONGEST_STEP_S)
        self._has_orders = False
        self._finishing = timing.event()
        self.recording = False
        """Whether the first recorder has opened its file."""
        self.failure: RtloopError | None = None
        """Why recording could not start; None otherwise."""
        self.totals: dict[str, Any] | None = None
        """The recorder's report: path, paths (of all files), complete, error (a text or None) and its counts, as texts
        and JSON values; None before the end."""
        self.replacements = 0
        self.notes: list[str] = []
        self.quota: Quota | None = None
        self.removals: list[str] = []
        """Messages about files that the quota removed, and about its failures."""
        self._unsent_removals: list[Removal] = []
        self._quota_time_s = 0.0

    @property
    def state(self) -> int:
        """ProcessState of the current recorder."""
        return self._block.load(Word.RECORDER_STATE)

    @property
    def written_state(self) -> dict[str, str | int]:
        """{file: path of the run's recording, written_ticks: number of the run's ticks, lost ones included, up to the
        last tick that the recorder has written}.
        """
        return {"file": str(self._path.resolve()), "written_ticks": self._block.load(Word.FLUSHED_TICKS)}

    @property
    def exit_code(self) -> int | None:
        """Exit code of the current recorder's process, −N after signal N; None while it runs."""
        return self._child.exit_code

    def start(self, header: dict[str, Any]) -> None:
        """Start recording with `header`, in a separate thread; returns at once. Later `recording` becomes True, or
        `failure` is set.
        """
        self._header = header
        if self._options.keep_gib is not None:
            min_free_bytes = round(self._options.min_free_mib * 2**20)
            self.quota = Quota(self._path.parent, header["name"], round(self._options.keep_gib * 2**30), min_free_bytes)
        timing.start_thread(self._run)

    def finish(self) -> None:
        """Tell the thread to let the recorder finish and to repair its files; returns at once, and `totals` follows."""
        self._finishing.set()

    def close(self) -> None:
        """Kill the recorder's process and tell the thread to finish, without waiting for either."""
        self._finishing.set()
        self._child.kill()

    def _run(self) -> None:
        """Run the recorder from start to finish, in the keeper's thread.

        Sets `recording` once the file is open, `failure` to an RtloopError that ends the thread, and `totals` at the
        end in any case: after a failure a report that is not complete, with the reason. Other exceptions pass through.
        """
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
                reason = str(
                    self.failure
                    or "a fault of rtloop ended the thread that watches the recorder; the recording is incomplete"
                )
                self.totals = {"path": str(self._path), "paths": [], "complete": False, "error": reason}

    def _enforce_quota_when_due(self) -> None:
        """Enforce the quota, if there is one, every QUOTA_S, and send its removals to the recorder."""
        if self.quota is not None and timing.monotonic_s() - self._quota_time_s >= QUOTA_S:
            self._unsent_removals += self._enforce_quota(self.quota)
            self._quota_time_s = timing.monotonic_s()
            self._send_removals()

    def _enforce_quota(self, quota: Quota, *budget_s: float) -> list[Removal]:
        """Enforce the quota, and return the removed files, which are not sent to the recorder here.

        Appends a message for each file, and for a new failure, to the attribute `removals`. `budget_s` as in
        `Quota.enforce`.
        """
        previous_failure = quota.failure
        new_removals = quota.enforce(*budget_s)
        self.removals += [
            *map(str, new_removals),
            *([quota.failure] if quota.failure not in (None, previous_failure) else []),
        ]
        return new_removals

    def _send_removals(self) -> None:
        """Tell the recorder which files were removed; it records each removal as an event.

        Removals stay pending until the recorder has received its orders, and while its state is not RUNNING or FAILED.
        """
        if self._unsent_removals and self._has_orders and self.state in (ProcessState.RUNNING, ProcessState.FAILED):
            lines = [json.dumps({"removed": removal.event_details}) + "\n" for removal in self._unsent_removals]
            self._child.send("".join(lines).encode())
            self._unsent_removals.clear()

    def _start_recording(self) -> None:
        """Send the recorder its orders and wait, without a time limit, until the file is open.

        Raises OutputError, with the recorder's reason, if the recorder fails or ends before the file is open.
        """
        self._send_orders()
        while self.state == ProcessState.READY and self.exit_code is None:
            timing.sleep(0.002)
        if self.state not in (ProcessState.RUNNING, ProcessState.FINISHED):
            self._child.wait(END_TIMEOUT_S)
            raise OutputError(
                f"{self._path}: cannot record: {self._newest_report().get('error') or 'the recorder ended'}"
            )

    def _replace_if_dead(self) -> None:
        """Replace a dead or stalled recorder, up to MAX_REPLACEMENTS times; send a new one its orders once it is ready.

        No recorder is replaced after that, or while its killed process does not end. A recorder whose process exits
        without a signal after the loop's end has finished, and is not replaced.
        """
        if not self._has_orders:
            if self.state == ProcessState.READY:
                self._send_orders()
            return
        cursor = self._block.load(Word.RECORDER_CURSOR)
        is_behind = int(self._block["ticks_head"][0]) != cursor
        is_stuck = self._watch.has_stalled(cursor, timing.monotonic_s()) and is_behind
        loop_ended = ProcessState.has_ended(self._block.load(Word.LOOP_STATE))
        has_died = self.exit_code is not None and not (loop_ended and self.exit_code >= 0)
        if (has_died or is_stuck) and self.replacements < MAX_REPLACEMENTS:
            reason = "stood still" if is_stuck else f"died (exit code {self.exit_code})"
            if not self._child.end():
                return  # The process hangs in the kernel on its file, and may continue later.
            self.notes.append(f"the recorder {reason} and was replaced")
            self.replacements += 1
            self._block.store(Word.RECORDER_STATE, ProcessState.STARTING)
            self._child, self._has_orders = Child(MODULE, self._block.fd, names=self._names.fd), False
            self._watch = StallWatch(STALL_S, LONGEST_STEP_S)

    def _finish(self) -> dict[str, object]:
        """Wait for the recorder's end, repair unfinished files, enforce the quota, and return the value for `totals`.

        A recorder that does not end within END_TIMEOUT_S is killed. Repairs and removals are added to `notes`.
        """
        deadline = timing.monotonic_s() + END_TIMEOUT_S
        while not self._has_orders and timing.monotonic_s() < deadline and self.exit_code is None:
            self._replace_if_dead()
            timing.sleep(POLL_S)
        if self._child.wait(END_TIMEOUT_S) is None:
            self.notes.append(
                f"the recorder did not end within {END_TIMEOUT_S:g} s and was killed; the recording may lack its end"
            )
        self._child.end()
        totals = {"path": str(self._path), "complete": False, "error": "the recorder died"} | self._newest_report()
        for part in run_files(self._path, ".mcap.part"):
            self._repair(part)
        if self.quota is not None:
            self._enforce_quota(self.quota, FINAL_QUOTA_BUDGET_S)
            if self.quota.removed_files:
                files, mib = count_text(self.quota.removed_files, "file"), self.quota.removed_bytes / 2**20
                self.notes.append(
                    f"{files} of recordings ({mib:.1f} MiB) removed because of recording.keep_gib or "
                    "recording.min_free_mib"
                )
        totals["paths"] = [str(path) for path in run_files(self._path, ".mcap")]
        return totals

    def _repair(self, part: Path) -> None:
        """Recover the unfinished file `part` and remove it. Adds the result or the failure to `notes`; raises neither.

        A file that cannot be recovered stays.
        """
        try:
            report = recover(part, opener=open_without_link)
        except RtloopError as error:
            self.notes.append(str(error))
            return
        self.notes.append(f"{report['output']}: recovered, {count_text(report['ticks'], 'tick')}")
        try:
            part.unlink()
        except OSError as error:
            self.notes.append(f"{part}: the recording is recovered, but this file cannot be removed: {error.strerror}")

    def _newest_report(self) -> dict[str, object]:
        """Return the recorder's newest report since the last call, {} if there is none; drop older reports."""
        reports = self._child.reports()
        return reports[-1] if reports else {}

    def _send_orders(self) -> None:
        """Send the recorder the path, the header, its options and the number of its first file."""
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
        """Return the next file's number: 1 for the first recorder, else one more than the run's highest, from 2 on."""
        if self.replacements == 0:
            return 1
        prefix = f"{self._path.stem}-"
        paths = (*run_files(self._path, ".mcap"), *run_files(self._path, ".mcap.part"))
        numbers = [path.name.removeprefix(prefix).split(".")[0] for path in paths if path.name.startswith(prefix)]
        return max(map(int, numbers), default=1) + 1
