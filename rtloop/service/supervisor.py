"""One run: loop and recorder as processes of their own, a heartbeat for the loop, and parking if it dies.

The supervisor may stall or die without touching a tick: the loop then ramps down by itself once the heartbeat is
older than its limit.
"""

from __future__ import annotations

import json
import os
import pickle
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DriverError
from rtloop.engine.memory import ProcessState, SharedBlock, Word
from rtloop.engine.ring import drain
from rtloop.errors import LoopFault, OutputError, RtloopError, UnavailableError
from rtloop.prepare import Prepared
from rtloop.service.child import Child
from rtloop.service.header import recording_header
from rtloop.service.parking import park

HEARTBEAT_PERIOD_S = 0.02
POLL_S = 0.02
END_TIMEOUT_S = 30.0
START_TIMEOUT_S = 120.0
START_TIME_FIELD = 19
"""Of /proc/PID/stat, counted after the process's name."""


@dataclass
class RunResult:
    """How a run ended. `outcome`: done, stopped, driver_failed, heartbeat_lost, failed or killed."""

    recording: Path
    outcome: str
    recorder: dict[str, Any]
    realtime: dict[str, Any] = field(default_factory=dict)
    error: str | None = None
    exit_code: int = 0


class Processes:
    """Loop and recorder, started before there is anything for them to do: they import while a plan is prepared."""

    def __init__(self) -> None:
        self.fd = SharedBlock.reserve()
        self.loop = Child("rtloop.engine.process", self.fd)
        self.recorder = Child("rtloop.recording.recorder", self.fd)

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        for child in (self.loop, self.recorder):
            child.close_stdin()
        for child in (self.loop, self.recorder):
            child.wait(END_TIMEOUT_S)
            child.end()


class Supervisor:
    """Runs a plan once in `processes`, recording to `recording` (without its `.part`)."""

    def __init__(self, processes: Processes, prepared: Prepared, recording: Path) -> None:
        self.prepared = prepared
        self.recording = recording
        self.block = SharedBlock.create(prepared.plan.sizes, processes.fd)
        self._loop, self._recorder = processes.loop, processes.recorder
        self.realtime: dict[str, Any] = {}
        self.startup_s: float | None = None
        self._done = threading.Event()
        self._reports: dict[str, dict[str, Any]] = {}

    def stop(self) -> None:
        """Ask the loop to ramp down and end."""
        self.block.words[Word.STOP] = 1

    def latest(self) -> np.ndarray[Any, Any] | None:
        """The newest record (columns,), or None before the first."""
        ring = self.block.ring("ticks")
        head = int(ring.head[0])
        row = np.empty((1, ring.slots.shape[1]))
        copied, _, _ = drain(ring, np.uint64(max(head - 1, 0)), row)
        return row[0] if copied else None

    def run(self, on_progress: Any = None) -> RunResult:
        """Start, watch and end everything. Raises RtloopError for what prevented the run."""
        beat = threading.Thread(target=self._beat, daemon=True)
        beat.start()
        loop, recorder = self._loop, self._recorder
        try:
            loop.send(pickle.dumps(self.prepared.plan))
            self._await_ready(loop, recorder)
            self._start_recorder(recorder)
            self.block.words[Word.GO] = 1
            self.startup_s = seconds_since_start()
            while loop.exit_code is None:
                self._collect("loop", loop)
                if on_progress is not None:
                    on_progress(self)
                time.sleep(POLL_S)
            return self._finish(loop, recorder)
        finally:
            self.stop()
            if loop.wait(END_TIMEOUT_S) is None:
                loop.end()
            self._done.set()
            beat.join()

    def _beat(self) -> None:
        while not self._done.is_set():
            self.block.words[Word.HEARTBEAT_NS] = time.monotonic_ns()
            self._done.wait(HEARTBEAT_PERIOD_S)

    def _collect(self, name: str, child: Child) -> None:
        for report in child.reports():
            self._reports[f"{name} {report.get('report', 'totals')}"] = report

    def _await_ready(self, loop: Child, recorder: Child) -> None:
        """Wait until both processes are ready. Raises what the loop's process reports instead."""
        deadline = time.monotonic() + START_TIMEOUT_S
        while True:
            self._collect("loop", loop)
            words = self.block.words
            if "loop ready" in self._reports and words[Word.RECORDER_STATE] >= ProcessState.READY:
                self.realtime = self._reports["loop ready"]["realtime"]
                return
            for name, child in (("loop", loop), ("recorder", recorder)):
                if child.exit_code is not None:
                    child.wait(1.0)
                    self._collect(name, child)
                    self._raise_failure(name, child.exit_code)
            if time.monotonic() > deadline:
                raise UnavailableError(f"loop and recorder were not ready within {START_TIMEOUT_S:g} s")
            time.sleep(0.002)

    def _raise_failure(self, name: str, exit_code: int) -> None:
        failed = self._reports.get(f"{name} failed")
        if failed is None:
            raise LoopFault(f"the {name}'s process ended with {exit_code} before the run began")
        error = RtloopError(failed["message"])
        error.exit_code = failed["exit_code"]
        raise error

    def _start_recorder(self, recorder: Child) -> None:
        """Hand over path and header, and wait until the file is open. Raises OutputError."""
        options = self.prepared.configuration.recording
        order = {
            "path": str(self.recording),
            "header": recording_header(self.prepared, self.realtime),
            "options": {
                "rotate_bytes": options.rotate_mib and round(options.rotate_mib * 2**20),
                "rotate_s": options.rotate_s,
                "min_free_bytes": round(options.min_free_mib * 2**20),
            },
        }
        recorder.send(json.dumps(order).encode() + b"\n")
        while self.block.words[Word.RECORDER_STATE] == ProcessState.READY:
            if recorder.exit_code is not None:
                break
            time.sleep(0.002)
        if self.block.words[Word.RECORDER_STATE] != ProcessState.RUNNING:
            recorder.wait(END_TIMEOUT_S)
            self._collect("recorder", recorder)
            reason = self._reports.get("recorder totals", {}).get("error", "it ended")
            raise OutputError(f"{self.recording}: cannot record: {reason}")

    def _finish(self, loop: Child, recorder: Child) -> RunResult:
        """Park if the loop died, let the recorder finish, and say how it went."""
        words = self.block.words
        error = None
        if words[Word.LOOP_STATE] not in (ProcessState.FINISHED, ProcessState.FAILED):
            error = f"the loop's process died ({_ending(loop.exit_code)}); {self._park()}"
            words[Word.LOOP_STATE] = ProcessState.FAILED
        recorder.wait(END_TIMEOUT_S)
        self._collect("loop", loop)
        self._collect("recorder", recorder)
        totals = self._reports.get("recorder totals", {"complete": False, "error": "the recorder died"})
        finished = self._reports.get("loop finished", {})
        failed = self._reports.get("loop failed", {})
        outcome = finished.get("outcome", "failed" if failed else "killed")
        error = error or finished.get("driver_error") or failed.get("message")
        if error is None and outcome == "heartbeat_lost":
            error = "the loop lost its heartbeat and parked by itself"
        error = error or totals.get("error")
        code = loop.exit_code if loop.exit_code and loop.exit_code > 0 else 0
        if code == 0 and (outcome not in ("done", "stopped") or not totals.get("complete")):
            code = LoopFault.exit_code
        path = Path(totals.get("path") or self.recording)
        return RunResult(path, outcome, totals, self.realtime, error, code)

    def _park(self) -> str:
        """Ramp the outputs down in the loop's place; what came of it in words."""
        plan = self.prepared.plan
        slew = float(np.min(plan.coefficients["trip_slew_v_per_tick"])) * plan.pacing.rate_hz
        try:
            park(plan.driver(), plan.wiring, plan.axes, self.block["last_drive_v"].tolist(), slew)
        except DriverError as error:
            return f"its outputs could not be parked: {error}"
        return "its outputs were parked in its place"


def seconds_since_start() -> float:
    """Age of this process in s, interpreter start and imports included."""
    after_name = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    started_s = int(after_name[START_TIME_FIELD]) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - started_s


def _ending(code: int | None) -> str:
    return f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"
