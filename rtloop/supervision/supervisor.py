"""The supervisor of one run: processes of loop and recorder, heartbeat for the loop, parking after the loop's death.

A supervisor that stalls or dies delays no tick: the loop ramps its outputs down once the heartbeat is too old.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.configuration.prepare import Prepared, refuse_simulated_lateness
from rtloop.configuration.recording import ring_sizes
from rtloop.drivers.errors import DriverError
from rtloop.engine.memory import ProcessState, SharedBlock, Word
from rtloop.engine.messages import MESSAGE, Kind
from rtloop.engine.ring import drain
from rtloop.errors import LoopFault, RtloopError, UnavailableError
from rtloop.foundation import timing
from rtloop.foundation.arrays import Real
from rtloop.foundation.native.cache import stored_file_count
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.file.topics.events import law_label, trip_reason
from rtloop.supervision.child import Child, stat_fields
from rtloop.supervision.description import recording_header
from rtloop.supervision.heart import Heart
from rtloop.supervision.host_delay import require_margins
from rtloop.supervision.parking import park
from rtloop.supervision.paths import create_file
from rtloop.supervision.recorder_keeper import MODULE as RECORDER
from rtloop.supervision.recorder_keeper import RecorderKeeper
from rtloop.supervision.stall import StallWatch, stall_limit_s

POLL_S, START_POLL_S = 0.005, 0.002
PROGRESS_PERIOD_S = 0.1
LONGEST_STEP_S = 0.01
END_TIMEOUT_S = 30.0
START_TIMEOUT_S = 300.0
"""Longest time until loop and recorder are ready; it begins again with every newly compiled function."""
ATTENDED_STALL_S = 2.0
"""Longest time without a tick in a run that a user watches: a host that stalls for half a second must not end it."""
START_TIME_FIELD = 19
"""Index of the start time in `stat_fields`."""
OUTCOME_MESSAGES = {
    "heartbeat_lost": "the loop received no heartbeat from its supervisor and parked the outputs",
    "law_failed": "the memory of the law is invalid (a count or an index is beyond its array, or an axis has not "
    "exactly one controller); this is a fault of rtloop, or another program changed the memory; the outputs were "
    "brought to their safe values",
}
"""Messages for outcomes that the loop's process does not explain."""


@dataclass(frozen=True)
class RunResult:
    """Result of a run. `outcome`: done, stopped, driver_failed, heartbeat_lost, law_failed, failed or killed.

    `recorder` is the recorder's report (`RecorderKeeper.totals`), `notes` are sentences about the recorder and its
    files, `error` is None for a run without one.
    """

    recordings: list[Path]
    outcome: str
    recorder: dict[str, Any]
    notes: list[str]
    error: str | None
    exit_code: int


class Processes:
    """Processes of loop and recorder, started early: they import their modules while the plan is prepared."""

    def __init__(self, block: Path | None = None) -> None:
        """Start both processes. `block` is the path of the shared block; None for a block without a file.

        Raises OutputError and HostRefusal as `create_file` does, OSError if a process cannot be started.
        """
        self.fd = SharedBlock.reserve() if block is None else create_file(block)
        self.names = RequesterNames.create()
        self.loop = Child("rtloop.engine.process", self.fd)
        self.recorder = Child(RECORDER, self.fd, names=self.names.fd)

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        """End both processes: close their stdin, wait up to END_TIMEOUT_S for each, and kill it if it still runs."""
        for child in (self.loop, self.recorder):
            child.close_stdin()
        for child in (self.loop, self.recorder):
            child.wait(END_TIMEOUT_S)
            child.end()
        self.names.close()


class Supervisor:
    """Runner of one plan in `processes`, recorded to the path `recording` (without `.part`).

    Call `start`, then `poll` every few milliseconds until it returns a result, then `close`. Only `start` waits for a
    disk, until the recording is open; no method waits for a log or a terminal. Without calls of `poll` the heartbeat
    stops, and the loop parks its outputs.
    """

    def __init__(
        self, processes: Processes, prepared: Prepared, recording: Path, stall_s: float = ATTENDED_STALL_S
    ) -> None:
        """Create the shared block and start the heartbeat; the processes wait for `start`.

        A paced loop without a tick for `stall_s`, and at least STALL_PERIODS periods, is killed. Raises ConfigError,
        before anything is created, as `refuse_simulated_lateness` and `require_margins` do.
        """
        refuse_simulated_lateness(prepared)
        require_margins(prepared)
        self.prepared = prepared
        options = prepared.configuration.recording
        self.block = SharedBlock.create(ring_sizes(options.around, prepared.plan.sizes), processes.fd)
        self.realtime: dict[str, object] = {}
        self.startup_s: float | None = None
        self.ended = False
        """Whether the loop has ended and its outputs are parked, or could not be; its files may take longer."""
        self.error: str | None = None
        """Cause of the loop's death, and the result of parking its outputs; None for a loop that has not died."""
        self._loop = processes.loop
        self.names = processes.names
        self.recorder = RecorderKeeper(processes.recorder, self.block, self.names, recording, options)
        self._stall = StallWatch(stall_limit_s(stall_s, prepared.plan.pacing.rate_hz), LONGEST_STEP_S)
        self._tick_processor_s, self._stall_text = 0.0, ""
        self._reports: dict[str, dict[str, Any]] = {}
        self._heart = Heart(self.block)

    def stop(self) -> None:
        """Tell the loop to ramp down and end; does not wait for it."""
        self.block.store(Word.STOP, 1)

    @property
    def ticks(self) -> int:
        """Number of ticks that the loop has published; a ramp after the last planned tick adds none."""
        return int(self.block["ticks_head"][0])

    def latest(self) -> Real | None:
        """Return a copy of the newest record (columns,), None before the first tick."""
        rows = self.newest(1)
        return rows[-1] if len(rows) else None

    def newest(self, count: int) -> Real:
        """Return a copy of up to `count` newest records (n, columns), oldest first; n is 0 before the first tick."""
        ring = self.block.ring("ticks")
        rows = np.empty((count, ring.slots.shape[1]))
        copied, _, _ = drain(ring, max(self.ticks - count, 0), rows)
        return rows[:copied]

    @property
    def trip_reason(self) -> str | None:
        """Reason of the newest trip: axis, value and limit, or the lost heartbeat.

        None for a trip without a reason, and if there is no trip in the ring of newest events.
        """
        ring = self.block.ring("events")
        events: npt.NDArray[np.void] = np.zeros(ring.slots.size, MESSAGE)
        copied, _, _ = drain(ring, max(int(ring.head[0]) - events.size, 0), events)
        plan = self.prepared.plan
        trips = [event for event in events[:copied] if event["kind"] == Kind.TRIPPED]
        laws = [law_label(law.kind, law.file) for law in plan.laws]
        return trip_reason(trips[-1], plan.axes, laws) if trips else None

    def run(self, on_progress: Callable[[Supervisor], None] | None = None) -> RunResult:
        """Let both processes begin the run, watch them until its end, close, and return the result.

        `on_progress` is called every PROGRESS_PERIOD_S in a separate thread: a blocked terminal delays nothing. Raises
        RtloopError if the run could not start; a loop that dies later is in the result.
        """
        end_event = timing.event()
        progress_thread = None
        try:
            self.start()
            progress_thread = timing.start_thread(partial(self._report_progress, on_progress, end_event))
            while (result := self.poll()) is None:
                timing.sleep(POLL_S)
            return result
        finally:
            end_event.set()
            if progress_thread is not None:
                progress_thread.join(PROGRESS_PERIOD_S)
            self.close()

    def _report_progress(self, on_progress: Callable[[Supervisor], None] | None, end_event: Event) -> None:
        """Call `on_progress` every PROGRESS_PERIOD_S until `end_event` is set; with None, return at once."""
        while on_progress is not None and not end_event.wait(PROGRESS_PERIOD_S):
            on_progress(self)

    def start(self) -> None:
        """Send both processes their orders, wait until both are ready and the recording is open; let the loop begin.

        Sets `realtime`, and `startup_s`, the age of this process at the end of the start. If it raises an error, the
        loop has executed no tick: RtloopError with the failure that the loop's process reports, LoopFault if a process
        ends without report, UnavailableError after START_TIMEOUT_S in which no function was compiled or the recording
        was not open, OutputError if the recording cannot be opened.
        """
        self.newest(0)  # Compile or load the function before it is needed in time.
        self._loop.send(pickle.dumps(self.prepared.plan))
        self._await_ready()
        self.recorder.start(recording_header(self.prepared, self.realtime))
        deadline = timing.monotonic_s() + START_TIMEOUT_S
        while not self.recorder.recording:
            self._heart.watch()
            if self.recorder.failure is not None:
                raise self.recorder.failure
            if timing.monotonic_s() > deadline:
                raise UnavailableError(
                    f"the recording was not open within {START_TIMEOUT_S:g} s; its file system may not answer; check "
                    "the disk of recording.folder"
                )
            timing.sleep(START_POLL_S)
        self.block.store(Word.GO, 1)
        with contextlib.suppress(OSError):  # The figure is for information only.
            self.startup_s = process_age_s()

    def poll(self) -> RunResult | None:
        """Let the heartbeat go on for WATCH_TIMEOUT_S; kill the loop if it stands still, park its outputs if it died.

        Returns the result once loop and recorder have ended, None before. May take seconds when it kills the loop or
        parks its outputs, which ramp.
        """
        self._heart.watch()
        self._collect_reports()
        if not self.ended and (self._loop.exit_code is not None or self._kill_stalled_loop()):
            self._end_run()
        if not self.ended or self.recorder.totals is None:
            return None
        return self._result(self.recorder.totals)

    def close(self) -> None:
        """Tell the loop to ramp down and wait for its end up to END_TIMEOUT_S; then kill both processes.

        The heartbeat ends. Outputs of a loop that is killed here are not parked.
        """
        self.stop()
        deadline = timing.monotonic_s() + END_TIMEOUT_S
        while self._loop.exit_code is None and timing.monotonic_s() < deadline:
            self._heart.watch()
            timing.sleep(START_POLL_S)
        self._heart.end()
        self._loop.end()
        self.recorder.close()

    def _collect_reports(self) -> None:
        """Store the newest report of each kind from the loop's process."""
        for report in self._loop.reports():
            self._reports[report["report"]] = report

    def _kill_stalled_loop(self) -> bool:
        """Kill a paced loop whose ticks stand still between its first and its last. Returns whether it was killed."""
        is_running = self.block.load(Word.LOOP_STATE) == ProcessState.RUNNING
        if not (
            is_running and self.prepared.plan.pacing.paced and self.ticks and not self.block.load(Word.FINISHED_TICKS)
        ):
            return False
        has_stalled = self._stall.has_stalled(self.ticks, timing.monotonic_s())
        if self._stall.stalled_s == 0.0:
            self._tick_processor_s = self._loop.processor_s
        if not has_stalled:
            return False
        self._stall_text = "stood still and was killed"
        if self._loop.is_ready_to_run and self._loop.processor_s - self._tick_processor_s < self._stall.stalled_s / 2:
            self._stall_text = (
                f"got too little of a processor on a busy host, had no tick for {self._stall.stalled_s:.2g} s, and was "
                "killed"
            )
        self._loop.end()
        return True

    def _await_ready(self) -> None:
        """Wait until both processes are ready, and store the real-time settings in `realtime`.

        Raises RtloopError with the failure that the loop's process reports, LoopFault if a process ended without
        report, UnavailableError after START_TIMEOUT_S in which no function was compiled.
        """
        deadline, compiled = timing.monotonic_s() + START_TIMEOUT_S, stored_file_count()
        while True:
            self._heart.watch()
            self._collect_reports()
            if "ready" in self._reports and self.recorder.state >= ProcessState.READY:
                self.realtime = self._reports["ready"]["realtime"]
                return
            if self._loop.exit_code is not None and "ready" not in self._reports:
                self._loop.wait(1.0)
                self._collect_reports()
                if "ready" not in self._reports:
                    self._raise_failure(self._loop.exit_code)
                continue  # The loop was ready, and was stopped before this check.
            if self.recorder.exit_code is not None:
                raise LoopFault(
                    f"the recorder's process ended with exit code {self.recorder.exit_code} before the run began; its "
                    "error output, if any, says why"
                )
            if timing.monotonic_s() > deadline:
                before, compiled = compiled, stored_file_count()
                if compiled == before:
                    raise UnavailableError(
                        f"loop and recorder were not ready within {START_TIMEOUT_S:g} s; the host may be overloaded; "
                        "start again"
                    )
                deadline = timing.monotonic_s() + START_TIMEOUT_S
            timing.sleep(START_POLL_S)

    def _raise_failure(self, exit_code: int) -> None:
        """Raise RtloopError with the message and exit code in the report "failed" of the loop's process.

        Without such a report, raise LoopFault with `exit_code`, the exit code of the loop's process, in its message.
        """
        failure = self._reports.get("failed")
        if failure is None:
            raise LoopFault(
                f"the loop's process ended ({_ending_text(exit_code)}) before the run began; its error output, if any, "
                "says why"
            )
        error = RtloopError(failure["message"])
        error.exit_code = failure["exit_code"]
        raise error

    def _end_run(self) -> None:
        """Set `ended` and let the recorder finish; park the outputs and set `error` if the loop's process died."""
        if not ProcessState.has_ended(self.block.load(Word.LOOP_STATE)):
            death_text = self._stall_text or f"died ({_ending_text(self._loop.exit_code)})"
            self.error = f"the loop's process {death_text}; {self._park()}"
            self.block.store(Word.LOOP_STATE, ProcessState.FAILED)
        self.ended = True
        self.recorder.finish()

    def _result(self, totals: dict[str, Any]) -> RunResult:
        """Return the result of the run from the loop's reports and the recorder's `totals`.

        The exit code is that of the loop's process if it is above 0. Else it is LoopFault's for an incomplete recording
        and for any other outcome than done and stopped, and 0 for the rest.
        """
        self._loop.wait(1.0)
        self._collect_reports()
        finished, failed = self._reports.get("finished", {}), self._reports.get("failed", {})
        outcome = finished.get("outcome", "failed" if failed else "killed")
        error = self.error or finished.get("driver_error") or failed.get("message") or OUTCOME_MESSAGES.get(outcome)
        if outcome == "heartbeat_lost" and (reason := self.trip_reason) is not None:
            error = f"{reason}; the loop parked the outputs"
        error = error or totals.get("error")
        code = self._loop.exit_code or 0
        if code <= 0 and (outcome not in ("done", "stopped") or not totals.get("complete")):
            code = LoopFault.exit_code
        paths = [Path(path) for path in totals["paths"]]
        return RunResult(paths, outcome, totals, self.recorder.notes, error, max(code, 0))

    def _park(self) -> str:
        """Park the outputs in place of the loop. Returns success or failure in words; raises no DriverError."""
        plan = self.prepared.plan
        try:
            park(plan.driver(), plan.trip_slew_v_per_s, self.block["last_drive_v"])
        except DriverError as error:
            return f"rtloop could not park the outputs: {error}"
        return "rtloop parked the outputs"


def process_age_s() -> float:
    """Return the age of this process in s, interpreter start and imports included.

    Raises OSError if /proc cannot be read.
    """
    started_s = int(stat_fields(os.getpid())[START_TIME_FIELD]) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - started_s


def _ending_text(code: int | None) -> str:
    """Return the end of a process in words: "signal 9" for the exit code −9, else "exit code N"."""
    return f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"
