"""The daemon: runs one loop after another, watches it, notifies systemd, and executes commands of the control API.

    stopped ──arm──► armed ──start──► running ──stop──► ramping ──► armed (or stopped, where arming is required)
                                         │ trip, or the loop's process died (parked in its place, started again)
                                         ▼
                                      tripped ──reset──► armed (or stopped)

The state is not stored: it follows from the newest record, the latched faults and `armed`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from functools import partial
from pathlib import Path

import numpy as np

from rtloop import signals
from rtloop.configuration.axis import LimitsOptions
from rtloop.configuration.file import Configuration, load
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.drivers.errors import DriverError
from rtloop.engine.memory import Word
from rtloop.engine.messages import MESSAGE, Kind
from rtloop.errors import ConfigError, LoopFault, RtloopError, UnavailableError
from rtloop.foundation import timing
from rtloop.foundation.arrays import Real
from rtloop.foundation.trusted import open_own
from rtloop.recording.file.recover import find_leftovers, recover
from rtloop.service.changing.building import prepare_builder, prepare_limited
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Desk, Refusal, RefusedByLoop, Requester, UnconfirmedCommand, use_requester
from rtloop.service.lock import Lock
from rtloop.service.measuring.current_measurement import CurrentMeasurement
from rtloop.service.measuring.measurement import MeasurementHistory
from rtloop.service.measuring.quality import Quality
from rtloop.service.notify import Notifier
from rtloop.service.preparation import prepare_actuator
from rtloop.service.recovering.comeback import RunningLoop, restore_references
from rtloop.service.recovering.former_state import record_former_state
from rtloop.service.recovering.recovery import Recovery
from rtloop.service.second_opinion import SecondOpinion
from rtloop.signals import Flag, Mode
from rtloop.supervision.hardware import Hardware, write_note
from rtloop.supervision.paths import block_path, hardware_path
from rtloop.supervision.recording_path import new_recording_path, recordings_folder
from rtloop.supervision.recording_state import GapReporter
from rtloop.supervision.supervisor import START_TIMEOUT_S, Processes, RunResult, Supervisor

POLL_S = 0.005
STATUS_PERIOD_S = 1.0
READY_TICKS = 10
RESTART_PAUSE_S = 0.2
SPARE_SAMPLES = 1 << 20
BUILDER_PAUSE_S = 5.0
"""Time from READY to the start of the limited process, so that it takes no processor from the loop's first seconds."""
STOP_IN_FORCE = "the stop stays in force: the next loop begins with its outputs off, and keeps them off until a start"
RECOVERY_TIMEOUT_S = 10.0
"""Time for recovering unfinished recordings after the last loop; the next start continues."""
log = logging.getLogger("rtloop")


class State(StrEnum):
    """State of the service."""

    STARTING = "starting"
    STOPPED = "stopped"
    ARMED = "armed"
    RUNNING = "running"
    RAMPING = "ramping"
    TRIPPED = "tripped"


class Service:
    """Service of one configuration, until `end` or until a loop has run for `duration_s`.

    `name` replaces the stem of the file's name, `config`. Raises ConfigError for an invalid file, InputFileError for
    one that cannot be read. `faults` are the latched faults, a text each; `results` are the results of ended loops,
    `measurements` the figures by axis; `supervisor` and `live` are None without a loop. Methods named like API requests
    may be called from any thread.
    """

    def __init__(self, config: Path, duration_s: float | None = None, name: str | None = None) -> None:
        """Load the configuration file `config`; no loop runs before `run`. The outputs are armed unless service.arm is
        set.

        `duration_s` None: the service runs until `end`. `name` None: the stem of the file's name. Raises ConfigError
        for an invalid file and for a schedule with options that exclude one, InputFileError for a file that cannot be
        read.
        """
        self.config, self._name = config, name
        self.configuration: Configuration = load(config, name)
        faults = self.configuration.service.faults_with_schedule() if self.configuration.schedule else []
        if faults:
            raise ConfigError(str(config), faults)
        self._duration_s = duration_s
        self.notifier = Notifier()
        self.lock = Lock()
        self.faults: list[str] = []
        self._has_ended_by_itself = False
        self.armed = not self.configuration.service.arm
        self.results: list[RunResult] = []
        self.supervisor: Supervisor | None = None
        self.live: LiveLaw | None = None
        self.measurements: dict[str, MeasurementHistory] = {}
        self.current_measurement = CurrentMeasurement()
        self.quality = Quality()
        self.second_opinion = SecondOpinion()
        self.recovery = Recovery(self)
        self._is_preparing = False
        self._requested_mode: Mode | None = None
        """Mode that a client requested last, of this loop or before it; the preparation sends nothing after that."""
        self._desk: Desk | None = None
        self._end_requested, self._reload_requested = timing.event(), timing.event()
        self._reload_lock = timing.lock()
        self._deaths_s: list[float] = []
        self._is_stopping = False
        self._offsets_v: dict[int, float] = {}
        self._is_ready = False

    # Commands of signals and of the control API

    def end(self) -> None:
        """Request the end: the loop ramps down, the recording is finished, `run` returns."""
        self._end_requested.set()

    @property
    def is_ending(self) -> bool:
        """Whether the end was requested; the loop may still ramp down."""
        return self._end_requested.is_set()

    def request_reload(self) -> None:
        """Request that `run` reads the configuration file again and applies it, in a separate thread."""
        self._reload_requested.set()

    @property
    def state(self) -> State:
        """The present state, derived from the newest record, faults, the death of the loop's process and `armed`.

        Without a loop, and before its first tick, it is TRIPPED if there are faults, or the last loop ended by itself
        and its fault is not latched yet, else STARTING.
        """
        row = self._latest_row()
        if row is None:
            return State.TRIPPED if self.faults or self._has_ended_by_itself else State.STARTING
        if self.faults or self._has_died or int(row[signals.FLAGS]) & signals.TRIP_MASK:
            return State.TRIPPED
        if row[signals.MODE] != Mode.OFF:
            return State.RUNNING
        if int(row[signals.FLAGS]) & Flag.RAMPING:
            return State.RAMPING
        return State.ARMED if self.armed else State.STOPPED

    @property
    def _has_died(self) -> bool:
        """Whether the present loop's process has died; its outputs are parked, if this was possible, and its files may
        be unfinished.
        """
        supervisor = self.supervisor  # the loop may end in another thread meanwhile
        return supervisor is not None and supervisor.error is not None

    def _latest_row(self) -> Real | None:
        """Return the newest record of the present loop (columns,); None without a loop, and before its first tick."""
        supervisor = self.supervisor  # the loop may end in another thread meanwhile
        return None if supervisor is None else supervisor.latest()

    @property
    def is_moved(self) -> bool:
        """Whether a measurement, or the preparation of the actuator, moves the loop."""
        return self._is_preparing or self.current_measurement.for_json() is not None

    @property
    def limits(self) -> list[LimitsOptions]:
        """The present limits of each axis, in the order of axes; [] without a loop."""
        live = self.live
        return [] if live is None else [axis.limits for axis in live.prepared.configuration.axes]

    @property
    def desk(self) -> Desk:
        """The desk of the running loop. Raises Refusal without a loop, or before its first tick."""
        desk = self._desk
        if desk is None or self._latest_row() is None:
            raise Refusal(f"no loop is running: the state of the service is {self.state}; try again when a loop runs")
        return desk

    def require_live(self) -> LiveLaw:
        """Return the law of the loop, for its live changes. Raises Refusal without a loop."""
        live = self.live
        if live is None:
            raise Refusal(f"no loop is running: the state of the service is {self.state}; try again when a loop runs")
        return live

    def ctl(self, command: str) -> str:
        """Return, in backticks, the command line of `rtloop ctl` with `command`, such as "start", for this service.

        The line has --name if the service was started with a name.
        """
        return f"`rtloop ctl {command}`" if self._name is None else f"`rtloop ctl --name {self._name} {command}`"

    def arm(self) -> None:
        """Set `armed`, so that `start` and `set_mode` may drive the outputs; no output moves yet.

        The first call may wait for the second opinion. Raises Refusal while tripped, and as `SecondOpinion.require`.
        """
        if self.state is State.TRIPPED:
            raise Refusal(f"arm: the service is tripped; use reset first ({self.ctl('reset')})")
        self.second_opinion.require("arm")
        self.armed = True

    def start(self) -> int:
        """Set the configured mode, loop.mode. Returns the tick at which it took effect; raises as `set_mode`."""
        return self.set_mode(self.configuration.loop.mode)

    def set_mode(self, mode: str) -> int:
        """Change the mode bumplessly, and return the tick at which it took effect.

        `mode` is the name of a Mode, such as "closed_loop"; else KeyError. A reference in µm is meaningless in volts:
        on entry to and exit from mode raw, the present output is held. In a loop that is tripped or stops, mode off
        changes no output: all are safe, or ramp to safe. Raises Refusal for any mode but off while tripped, while not
        armed, while the actuator is prepared and during the return of a recovery; after mode off in the preparation,
        the configured mode is not set. Raises Refusal also without a loop, where mode off holds for the next loop, and
        for mode off if the driver refuses every write, and as `Desk.submit`. Mode off ends a recovery.
        """
        target_mode = Mode[mode.upper()]
        if target_mode is Mode.OFF:
            self.recovery.end()
            self._requested_mode = target_mode
            return self._enter(target_mode)
        self._require_permission(target_mode)
        if self._is_preparing and self.configuration.service.prepares:
            raise Refusal(f"mode {mode}: the actuator is being depolarised or tared; send the request again afterwards")
        if self.recovery.is_returning:
            raise Refusal(
                f"mode {mode}: the service is returning to its mode before the trip; send the request again "
                f"afterwards, or end the return by a stop first ({self.ctl('stop')})"
            )
        return self._drive(target_mode)

    def _drive(self, mode: Mode) -> int:
        """Enter a mode other than off, with the references that a return or a preparation has replaced.

        Returns the tick at which it took effect; raises as `_enter`. A mode that is refused has no later effect.
        """
        supervisor, live, desk, unrestored = self.supervisor, self.live, self.desk, self.recovery.unrestored
        earlier_mode, self._requested_mode = self._requested_mode, mode
        restore: Callable[[], None] = lambda: None
        if unrestored is not None and supervisor is not None and unrestored.live is live:
            loop = RunningLoop(supervisor, unrestored.live, desk)
            restore = partial(restore_references, unrestored, mode, loop)
        try:
            if mode is not Mode.RAW:
                restore()
            tick = self._enter(mode)
            if mode is Mode.RAW:
                restore()
        except RtloopError as error:
            if not isinstance(error, UnconfirmedCommand):  # The loop still enters this mode if it goes on.
                self._requested_mode = earlier_mode
            raise
        self.recovery.unrestored = None
        return tick

    def _require_permission(self, mode: Mode) -> None:
        """Raise Refusal for a mode other than off while the service is tripped or not armed."""
        if self.state is State.TRIPPED:
            raise Refusal(f"mode {mode.name.lower()}: the service is tripped; use reset first ({self.ctl('reset')})")
        if not self.armed:
            raise Refusal(f"mode {mode.name.lower()}: the outputs are not armed; use arm first ({self.ctl('arm')})")

    def _enter(self, mode: Mode) -> int:
        """Change the mode bumplessly, without the checks of `set_mode`. Returns the tick at which it took effect.

        Mode off in a loop that is tripped or stops has no effect, and returns the tick at which the loop refused it.
        Raises Refusal without a loop, and for mode off in such a loop if the driver refuses every write, or once the
        loop has died without an answer; else as `Desk.submit`.
        """
        supervisor = self.supervisor
        if mode is Mode.OFF and (self._desk is None or self._latest_row() is None):
            raise self._refused_stop_without_loop()
        try:
            return self.desk.submit(Kind.SET_MODE, values=[float(mode), 0.0, 1.0])
        except UnconfirmedCommand:
            if mode is not Mode.OFF or supervisor is None or supervisor.error is None:
                raise
            raise Refusal(f"mode off: {supervisor.error}; {STOP_IN_FORCE}") from None
        except RefusedByLoop as refusal:
            if mode is not Mode.OFF:
                raise
            row = self._latest_row()
            if row is not None and int(row[signals.FLAGS]) & Flag.WRITE_FAILED:
                reason = "the driver refuses every write: the outputs do not move; use the emergency stop"
                raise Refusal(f"mode off: {reason}") from None
            return refusal.tick

    def _refused_stop_without_loop(self) -> Refusal:
        """Return the error for mode off without a loop, or before its first tick: it says what holds for the next loop.

        A schedule begins with the first loop, and takes no notice of an earlier stop.
        """
        holds = "try again when a loop runs, because the schedule begins with the loop"
        if not self.configuration.schedule or self.state is State.TRIPPED:
            holds = STOP_IN_FORCE
        return Refusal(f"mode off: no loop is running: the state of the service is {self.state}; {holds}")

    def stop(self) -> int:
        """Ramp the outputs to safe and keep them there; disarm if service.arm is set, also after an error.

        Returns the tick at which the ramp begins, or a later one if the outputs ramp already, as after a trip. Raises
        Refusal without a loop and if the driver refuses every write, and as `Desk.submit`.
        """
        try:
            return self.set_mode("off")
        finally:
            self.armed = not self.configuration.service.arm

    def reset(self) -> int:
        """Clear latched trips and faults; the outputs stay off, and the service is disarmed if service.arm is set.

        Returns the tick at which the trip was cleared. Raises Refusal unless tripped, or without a loop, and as
        `Desk.submit`; after an error of the loop the faults stay, but a recovery under way has ended.
        """
        if self.state is not State.TRIPPED:
            raise Refusal(f"reset: there is no trip; the state of the service is {self.state}")
        desk = self.desk
        ends_recovery = self.recovery.end()
        try:
            tick = desk.submit(Kind.RESET_TRIP)
        except RtloopError as error:
            if ends_recovery:
                error.args = (f"{error}; the recovery that was under way has ended",)
            raise
        self.faults.clear()
        self.recovery.clear()
        self.armed = not self.configuration.service.arm
        return tick

    # The daemon

    def run(self) -> int:
        """Serve until `end` is called. Returns the exit code of the last loop, 0 if the end came before a loop.

        Unfinished recordings are recovered in the background, and once more at the end. Raises LoopFault if more than
        service.restarts loops ended by themselves within service.restart_window_s, and the error of the last loop that
        could not start: RtloopError, DriverError.
        """
        log.info("starting %s, which records into %s", self.configuration.name, recordings_folder(self.configuration))
        if self.configuration.service.arm and self.configuration.service.prepares:
            log.warning("the actuator is neither depolarised nor tared, because service.arm is true")
        recovery = timing.start_thread(self._recover_leftovers)
        try:
            return self._serve()
        finally:  # A file that grew at the start may be unfinished by now; two recoveries must not run at once.
            self.notifier.limit_watchdog(START_TIMEOUT_S)  # The outputs are safe; RECOVERY_TIMEOUT_S limits the time.
            recovery.join(RECOVERY_TIMEOUT_S)
            if not recovery.is_alive():
                timing.start_thread(self._recover_leftovers).join(RECOVERY_TIMEOUT_S)

    def _serve(self) -> int:
        """Run loop after loop until `end` is called; a loop after a failure begins with its outputs off.

        Adds each loop's result to `results`. Returns the exit code, and raises, as `run`.
        """
        outputs_off = self.configuration.service.arm
        while not self._end_requested.is_set():
            try:
                result = self._run_loop(outputs_off)
            except (RtloopError, DriverError) as error:
                if self._end_requested.is_set():
                    return 0  # The end was requested before the loop began.
                # A schedule and a depolarisation would drive the outputs, while the service is tripped.
                if not outputs_off and self.configuration.service.prepares:
                    log.warning("the actuator is neither depolarised nor tared, because the service is tripped")
                outputs_off = True
                if _is_driver_error(error) and self.recovery.accept_failed_start(str(error)):
                    self._latch_and_wait(str(error))
                    continue
                if not self._latch_and_allow_restart(str(error)):
                    raise
                continue
            self.results.append(result)
            if self._end_requested.is_set():
                if result.error:
                    log.error("%s", result.error)
                log.info("stopped")
                return result.exit_code
            fault, outputs_off = result.error or f"the loop ended: {result.outcome}", True
            if self.recovery.accept_end(result.outcome, fault):
                self._latch_and_wait(fault)
            elif not self._latch_and_allow_restart(fault):
                raise LoopFault(
                    "the loop ended too often (service.restarts within service.restart_window_s) and is not started "
                    f"again: {'; '.join(self.faults)}"
                )
        return 0

    def _run_loop(self, outputs_off: bool) -> RunResult:
        """Run one loop from start to end and return its result. With `outputs_off` it has no schedule, begins in mode
        off, and keeps this mode until a client or a recovery sets another one.

        Else a loop without a schedule depolarises and tares its axes as configured, then sets the configured mode.
        Stores the note of the hardware for `rtloop park`. Raises RtloopError, DriverError if the loop cannot start.
        """
        with Processes(block_path(self.configuration.name)) as processes:
            prepared = prepare(self.configuration)
            write_note(hardware_path(self.configuration.name), Hardware.from_configuration(prepared.configuration))
            options = self.configuration.service
            # The actuator's rest position is unknown: the outputs start off, and the mode is entered bumplessly. A
            # schedule needs its first tick, and so excludes this.
            needs_preparation = not outputs_off and not self.configuration.schedule
            if outputs_off or needs_preparation:
                plan = replace(prepared.plan, mode=Mode.OFF, schedule=np.zeros(0, MESSAGE))
                prepared = replace(prepared, plan=plan)
            coefficients = prepared.plan.coefficients.copy()
            for (
                number,
                offset_v,
            ) in self._offsets_v.items():  # The actuator is not at rest, so no second tare.
                coefficients["offset_v"][number] = offset_v
            plan = replace(prepared.plan, coefficients=coefficients, spare_samples=SPARE_SAMPLES)
            prepared = replace(prepared, plan=plan)
            supervisor = Supervisor(processes, prepared, new_recording_path(prepared, None), options.stall_ms / 1000)
            self._is_preparing = needs_preparation
            try:
                supervisor.start()
                self._desk = Desk(supervisor.block, prepared.plan.pacing.rate_hz, supervisor.names)
                self.live = LiveLaw(prepared, supervisor.block, self._desk, self._offsets_v)
                self.supervisor = supervisor
                if needs_preparation:
                    timing.start_thread(self._prepare_and_start)
                return self._watch(supervisor)
            finally:
                self._has_ended_by_itself = not self._end_requested.is_set()
                self.supervisor = self._desk = self.live = self._requested_mode = None
                self._is_preparing = False
                supervisor.close()

    def _watch(self, supervisor: Supervisor) -> RunResult:
        """Poll the supervisor until the loop has ended, and return the result of the run.

        Executes requests for end and reload, requests the end after the service's duration, follows the loop's events,
        notifies systemd, logs changes of the state, gaps of the recording and removed recordings.
        """
        logged_state: State | None = None
        gaps, logged_removals = GapReporter(supervisor.block), 0
        while (result := supervisor.poll()) is None:
            self._follow_events()
            if self._duration_s is not None and supervisor.ticks >= self._duration_s * self.configuration.loop.rate_hz:
                self.end()
            if self._end_requested.is_set() and not self._is_stopping:
                self._is_stopping = True
                log.info("stopping: the outputs ramp to safe")
                supervisor.stop()
                self.notifier.send(STOPPING=1, STATUS="ramping down")
            # Requests during a reload become one further reload.
            if self._reload_requested.is_set() and not self._reload_lock.locked():
                self._reload_requested.clear()
                timing.start_thread(self._apply_reload)
            self._notify_systemd(supervisor)
            if gap_message := gaps.next_message():
                log.error("%s", gap_message)
            for removal in (removals := supervisor.recorder.removals[logged_removals:]):
                log.info("%s", removal)
            logged_removals += len(removals)
            state = self.state
            # The line "stopping" covers the states that follow it, and the fault of a dead loop is logged by `_serve`.
            is_covered = self._has_died or (self._is_stopping and state is not State.TRIPPED)
            if state is not logged_state and not is_covered:
                row = supervisor.latest()
                causes = [] if row is None else signals.trip_causes(row[signals.FLAGS])
                if state is State.TRIPPED:
                    # Faults are in the log already; a lost heartbeat ends the loop, and its fault is logged then.
                    reason = supervisor.trip_reason if causes not in ([], ["heartbeat"]) else None
                    reasons = ", ".join([*causes, *([reason] if reason else [])])
                    log.error("%s", f"{state}: {reasons}" if reasons else state)
                else:
                    log.info("%s", state)
                logged_state = state
            timing.sleep(POLL_S)
        self._follow_events()
        for note in result.notes:
            log.warning("%s", note)
        return result

    def _follow_events(self) -> None:
        """Read the loop's new events, for its references and for the recovery; no effect without a loop."""
        if self.live is not None:
            self.live.references.follow()
            self.recovery.observe()

    def _notify_systemd(self, supervisor: Supervisor) -> None:
        """Send systemd the messages that are due; called at every poll.

        READY is sent once, after READY_TICKS; then one thread judges the loop, and another one starts the limited
        process after BUILDER_PAUSE_S. WATCHDOG and STATUS are sent periodically, WATCHDOG not while the ticks stand
        still, unless the loop has ended or was ordered to end. The first ticks of a loop restore the watchdog's time,
        which is START_TIMEOUT_S while a loop is restarted.
        """
        if not self._is_ready and supervisor.ticks >= READY_TICKS:
            self._is_ready = True
            self.notifier.send(READY=1)
            timing.start_thread(self._start_builder_later)
            timing.start_thread(lambda: self._judge_loop(supervisor.prepared))
        if self._reported_ticks == 0 and supervisor.ticks:
            self.notifier.limit_watchdog()
        if not self.notifier.is_due(min(STATUS_PERIOD_S, (self.notifier.watchdog_s or 10.0) / 4), timing.monotonic_s()):
            return
        if supervisor.ticks > self._reported_ticks or supervisor.ended or supervisor.block.load(Word.STOP):
            self.notifier.send(WATCHDOG=1)
        self._reported_ticks = supervisor.ticks
        rows = supervisor.newest(int(min(supervisor.prepared.plan.pacing.rate_hz, 20000)))
        if len(rows) > 1:
            span_s = (rows[-1, signals.DEADLINE] - rows[0, signals.DEADLINE]) / 1e9
            worst_us = float(np.max(rows[:, signals.LATENESS]))
            self.notifier.send(
                STATUS=f"{self.state}, {(len(rows) - 1) / span_s:.0f} Hz, worst lateness {worst_us:.0f} µs"
            )

    _reported_ticks = 0

    def _latch_and_allow_restart(self, reason: str) -> bool:
        """Latch a loop's failure as a fault, log it, and pause RESTART_PAUSE_S, with the watchdog at START_TIMEOUT_S.

        Returns True if the loop may be started again; False, without the pause, after more than service.restarts
        failures in service.restart_window_s.
        """
        self._latch(reason)
        log.error("%s", reason)
        options, now_s = self.configuration.service, timing.monotonic_s()
        self._deaths_s = [moment for moment in self._deaths_s if now_s - moment < options.restart_window_s] + [now_s]
        if len(self._deaths_s) > options.restarts:
            return False
        self._reported_ticks = 0
        self.notifier.limit_watchdog(START_TIMEOUT_S)  # The outputs are parked; the start has its own time limit.
        timing.sleep(RESTART_PAUSE_S)
        return True

    def _latch(self, reason: str) -> bool:
        """Latch a loop's failure as a fault; return whether it is a new one."""
        is_new = reason not in self.faults
        if is_new:
            self.faults.append(reason)
        self._has_ended_by_itself = False
        return is_new

    def _latch_and_wait(self, reason: str) -> None:
        """Latch a failure that a recovery covers as a fault, and wait for the recovery's pause or for `end`.

        Such failures do not count for service.restarts: a service that systemd starts anew would drive the outputs
        without the recovery's confirmations.
        """
        if self._latch(reason):
            log.error("%s", reason)
        self._reported_ticks = 0
        self.notifier.limit_watchdog(START_TIMEOUT_S)
        self._end_requested.wait(self.recovery.pause_s)

    def _recover_leftovers(self) -> None:
        """Recover the unfinished recordings in the folder of recordings, which services that were killed have left.

        Successes and failures are logged; a file that cannot be recovered stays.
        """
        for part_file in find_leftovers(Path(self.configuration.recording.folder)):
            try:
                report = recover(part_file, opener=open_own)
            except RtloopError as error:
                log.warning("%s", error)
                continue
            log.info("%s: %d ticks recovered from %s", report["output"], report["ticks"], part_file.name)

    def _prepare_and_start(self) -> None:
        """Depolarise and tare the actuator, then set the configured references and mode; runs in its own thread.

        Nothing of that is sent after a client has requested a mode, such as off; the references are then restored with
        the next start. An RtloopError is added to `faults` and logged, unless a client requested a mode or the service
        ends. No effect without a loop.
        """
        supervisor, live, desk = self.supervisor, self.live, self._desk
        if supervisor is None or live is None or desk is None:
            return
        mode = Mode[self.configuration.loop.mode.upper()]
        self.recovery.unrestored = record_former_state(mode, live)
        try:
            with use_requester(Requester(require_permission=self._require_no_request)):
                self._require_no_request()
                prepare_actuator(self.configuration.service, supervisor, live, desk)
                if mode is not Mode.OFF:
                    self._require_permission(mode)
                if mode is Mode.RAW:
                    self._enter(mode)  # The references that follow are in V then.
                for number in range(len(live.prepared.plan.axes)):
                    live.references.restore_configured(number)
                self._enter(mode)
            self.recovery.unrestored = None
        except RtloopError as error:
            if self._requested_mode is None and not self._end_requested.is_set():
                self.faults.append(str(error))
                log.error("%s", error)
        finally:
            self._is_preparing = False
            if self._requested_mode is not None:
                log.info(
                    "the configured mode does not apply: mode %s was requested during the start",
                    self._requested_mode.name.lower(),
                )

    def _require_no_request(self) -> None:
        """Raise Refusal once a client has requested a mode of this loop."""
        if self._requested_mode is not None:
            raise Refusal("the start has ended, because a mode was requested")

    def _start_builder_later(self) -> None:
        """Wait BUILDER_PAUSE_S, then start the process that builds changes, unless the service ends meanwhile."""
        if not self._end_requested.wait(BUILDER_PAUSE_S):
            prepare_builder()

    def _judge_loop(self, prepared: Prepared) -> None:
        """Compute the second opinion on the loop of `prepared`, by python-control. A disagreement ramps the outputs to
        safe, as `stop` does, is logged, and is latched in `faults`.
        """
        self.second_opinion.compute(prepared)
        if not self.second_opinion.faults:
            return
        try:
            self.stop()
        except RtloopError as error:  # no loop runs any more
            log.warning("%s", error)
        for fault in self.second_opinion.faults:
            log.error("python-control disagrees with rtloop's computation of the loop: %s", fault)
        self.faults += self.second_opinion.faults

    def _apply_reload(self) -> None:
        """Do the work of `reload_now` and notify systemd before and after it.

        An RtloopError or DriverError is logged, not raised; its text names the axes that were changed already.
        """
        self.notifier.send(RELOADING=1, MONOTONIC_USEC=round(1e6 * timing.monotonic_s()))
        try:
            self.reload_now()
        except (RtloopError, DriverError) as error:
            log.error("reload refused: %s", error)
        if self._is_ready:
            self.notifier.send(READY=1)

    def _reuse_loaded_laws(self, configuration: Configuration) -> Configuration:
        """Return `configuration` with the laws loaded at the start: compiled code cannot change in a running service.

        Raises Refusal if the configuration needs a law that was not loaded, or whose text has changed since.
        """
        loaded = self.configuration.laws
        if missing_kinds := [law.kind for law in configuration.laws if law not in loaded]:
            raise Refusal(
                f"law {', '.join(missing_kinds)}: not loaded when the service started, or changed in its file since; "
                "restart the service"
            )
        return replace(configuration, laws=loaded)

    def reload_now(self) -> dict[str, list[str]]:
        """Read the configuration file again and apply it to the loop, after any reload in progress.

        Returns {changed: ["axis.NAME", …]}, the axes that changed, [] if none or without a loop. Raises ConfigError,
        InputFileError, DriverError, UnavailableError if the build takes too long, Refusal if a change needs a restart
        or the loop refuses; see `LiveLaw.replace_all` for a refusal after some axes were changed.
        """
        with self._reload_lock:  # One at a time: the file that was read last is the one that the loop has.
            configuration = self._reuse_loaded_laws(load(self.config, self._name))
            prepared: Prepared = prepare_limited(configuration)
            live = self.live
            changed = [] if live is None else live.replace_all(prepared)
            self.configuration = configuration
        log.info("reloaded: %s", ", ".join(changed) or "nothing changed")
        return {"changed": changed}


def _is_driver_error(error: Exception) -> bool:
    """Return whether `error`, with which a loop did not start, counts as a driver that could not be opened.

    True for a DriverError, and for any error with the exit code of UnavailableError, with which the loop's process
    reports the errors of its driver.
    """
    return isinstance(error, DriverError) or getattr(error, "exit_code", None) == UnavailableError.exit_code
