"""Facts that hold in every world, computed from records, outputs, events, answers and the configuration's text."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.engine.messages import Kind, Origin
from rtloop.recording.file.topics.recovery_steps import Note, RecoveryStep
from rtloop.signals import COMMON_COUNT, DRIVE, FLAGS, MODE, PER_AXIS_COUNT, REFERENCE, TICK, TRIP_MASK, Flag, Mode
from tests.worlds.law_changes import LawChanges
from tests.worlds.world import Request, Run, World

PERIOD_S, ROUNDING_V, BATCH_TICKS, STATE_TICKS = 1e-3, 1e-9, 200, 25
ANSWER_S = {
    "/status": 0.0, "/arm": 0.0, "/lock": 0.0, "/stop": 2.1, "/reset": 2.1, "/start": 5.0, "/mode": 5.0,
    "/response": 60.0, "/learn": 60.0,
}  # fmt: skip
"""Longest time to an answer, s, of a host that delays no thread; other requests wait for others: OTHER_S."""
OTHER_S = 20.0
UNHURRIED_S = 1.0
"""Time that delays of threads may add to it."""
TICK_KINDS = {
    "/start": Kind.SET_MODE, "/mode": Kind.SET_MODE, "/stop": Kind.SET_MODE, "/reset": Kind.RESET_TRIP,
    "/setpoint": Kind.SET_REFERENCE, "/reference": Kind.SET_REFERENCE, "/waveform": Kind.SET_REFERENCE,
    "/tune": Kind.LOAD_LAW, "/controller": Kind.LOAD_LAW, "/undo": Kind.LOAD_LAW,
}  # fmt: skip
"""Requests that are answered by a tick, and the event of their effect at it."""
MAY_HALF_SUCCEED = ("/response", "/learn", "/reload", "/start", "/mode")
"""Requests that send several commands, of which some may take effect before a refusal."""
TRANSITIONS = {
    "starting": ("stopped", "armed", "running", "tripped"),
    "stopped": ("armed", "tripped", "starting", "running", "ramping"),
    "armed": ("stopped", "running", "ramping", "tripped", "starting"),
    "running": ("ramping", "armed", "stopped", "tripped", "starting"),
    "ramping": ("armed", "stopped", "running", "tripped", "starting"),
    "tripped": ("stopped", "armed", "ramping"),
}
"""States that may follow each state, from one stretch to the next; with a recovery, `running` may follow `tripped`."""


class Violation(AssertionError):
    """An invariant does not hold."""


def require(condition: object, text: str) -> None:
    """Raise Violation with a text unless a condition holds."""
    if not condition:
        raise Violation(text)


class Invariants:
    """The invariants of one world; `on_stretch` is called at each stretch of ticks, `on_answer` at each answer."""

    def __init__(self, world: World, text: str, lock_timeout_s: float) -> None:
        self._world, self._lock_timeout_s = world, lock_timeout_s
        configuration = tomllib.loads(text)
        limits = [axis["limits"] for axis in configuration["axis"]]
        self._highest_v = np.array([limit["drive_v"] for limit in limits])
        self._step_v = PERIOD_S * np.array([limit["slew_v_per_s"] for limit in limits])
        self._ramp_v = PERIOD_S * np.array([limit["trip_slew_v_per_s"] for limit in limits])
        self._arm = configuration["service"]["arm"]
        self._stall_s = configuration["service"]["stall_ms"] / 1000.0
        self.recovers = "recover" in configuration["service"]
        self._drives = COMMON_COUNT + DRIVE + PER_AXIS_COUNT * np.arange(len(limits))
        self._run: Run | None = None
        self._mode, self._is_tripped = Mode.OFF, False
        self._last_v = np.zeros(len(limits))
        self._state = "starting"
        self.ticks = self.answers = 0
        self._stop: int | None = None
        """Number of the stop that is in force until a client's next start."""
        self._trips = self._recoveries = 0
        self._law_changes = LawChanges(world)
        self._rows: list[np.ndarray[Any, Any]] = []
        self._row_count = 0

    # At each stretch

    def on_stretch(self, run: Run, rows: np.ndarray[Any, Any], events: np.ndarray[Any, Any]) -> None:
        """Check the new ticks of a loop: at once if there are events, else together with later ones."""
        if run is not self._run:
            self._run, self._mode, self._is_tripped = run, Mode.OFF, False
        self._rows.append(rows)
        self._row_count += len(rows)
        if len(events) or self._row_count >= BATCH_TICKS:
            self._check_ticks(events)
        if len(events) or self.ticks // STATE_TICKS != (self.ticks + len(rows)) // STATE_TICKS:
            self._check_state()
        self.ticks += len(rows)

    def flush(self) -> None:
        """Check the ticks and outputs since the last check."""
        self._check_ticks(())

    def _check_ticks(self, events: Sequence[Any]) -> None:
        """Check mode, limits, steps and ramps of the outputs that the board received."""
        rows = np.concatenate([*self._rows, np.zeros((0, self._rows[0].shape[1]))]) if self._rows else None
        written, self._rows, self._row_count = self._world.board.written[:], [], 0
        self._world.board.written.clear()
        if rows is not None:
            drives_v = rows[:, self._drives]
            has_failed = (rows[:, FLAGS].astype(int) & Flag.WRITE_FAILED) > 0
            count = len(rows) - np.count_nonzero(has_failed)
            received_v = np.array(written[:count]).reshape(-1, len(self._drives))
            require(np.array_equal(received_v, drives_v[~has_failed]), "the record has other drives than the board")
            drives_v[has_failed] = np.nan
            written = written[count:]
            self._check_segments(rows, drives_v, has_failed, events)
        if written:
            self._check_steps(np.array(written), "outside ticks")

    def _check_segments(
        self, rows: np.ndarray[Any, Any], drives_v: np.ndarray[Any, Any], failed: np.ndarray[Any, Any], events: Any
    ) -> None:
        """Check ticks between events, whose drives are NaN where the board refused them."""
        first = int(rows[0, TICK])
        events_at: dict[int, list[Any]] = {}
        for event in events:
            events_at.setdefault(int(event["tick"]) - first, []).append(event)
        require(all(0 <= place < len(rows) for place in events_at), f"an event of another tick: {[*events_at]}")
        places = sorted({0, *events_at})
        for begin, end in zip(places, [*places[1:], len(rows)], strict=True):
            is_new_trip = any([self._follow(event) for event in events_at.get(begin, ())])
            segment, place = slice(begin, end), f"tick {first + begin} and later of loop {len(self._world.runs)}"
            require(np.all(rows[segment, MODE] == self._mode), f"{place}: the mode is not {self._mode.name}")
            is_tripped = (rows[segment, FLAGS].astype(int) & TRIP_MASK) > 0
            require(np.all(is_tripped == self._is_tripped), f"{place}: tripped is not {self._is_tripped}")
            before_v = self._check_steps(drives_v[segment], place)
            if self._mode == Mode.OFF:
                most_v = np.maximum(np.abs(before_v) - self._ramp_v, 0.0) + ROUNDING_V
                is_slow = ~failed[segment] & np.any(np.abs(drives_v[segment]) > most_v, axis=1)
                is_slow[0] &= not is_new_trip
                require(not np.any(is_slow), f"{place}: mode off, and the outputs are not on the way to safe")

    def _check_steps(self, drives_v: np.ndarray[Any, Any], place: str) -> np.ndarray[Any, Any]:
        """Check limits and steps of successive drives, NaN where none was written; return the drive before each."""
        levels_v = np.vstack([self._last_v, drives_v])
        for k in np.flatnonzero(np.isnan(levels_v[:, 0])):
            levels_v[k] = levels_v[k - 1]
        self._last_v = levels_v[-1]
        most_v = np.maximum(self._step_v, self._ramp_v) + ROUNDING_V
        require(np.all(np.abs(levels_v) <= self._highest_v + ROUNDING_V), f"{place}: a drive beyond the limits")
        require(
            np.all(np.abs(np.diff(levels_v, axis=0)) <= most_v),
            f"{place}: a drive faster than allowed: {levels_v[:6].tolist()}",
        )
        return levels_v[:-1]

    def _follow(self, event: Any) -> bool:
        """Apply an event to mode and trip; return whether it is a trip."""
        kind = int(event["kind"])
        if (kind == Kind.SET_MODE and event["values"][0] == Mode.OFF) or kind == Kind.REFUSED:
            requester = self.request_of(event)
            self._stop = requester.number if requester is not None and is_stop(requester) else self._stop
        if kind == Note.RECOVERY and event["values"][0] == RecoveryStep.BEGUN:
            self._recoveries += 1
            require(self._recoveries <= self._trips + len(self._world.loops), "more recoveries than trips")
        if kind == Kind.SET_MODE:
            require(not self._is_tripped, "a mode was set in a tripped loop")
            self._mode = Mode(int(event["values"][0]))
            if self._mode != Mode.OFF:
                self._check_cause(event)
        elif kind == Kind.TRIPPED:
            self._trips += not self._is_tripped
            is_new, self._is_tripped, self._mode = not self._is_tripped, True, Mode.OFF
            return is_new
        elif kind == Kind.RESET_TRIP:
            self._is_tripped, self._mode = False, Mode.OFF
        elif kind == Kind.STOP:
            self._mode = Mode.OFF
        return False

    def _check_cause(self, event: Any) -> None:
        """Require that a driving mode was requested by a client that may, or comes from recovery or preparation."""
        requests, now_s = self._world.requests, self._world.turns.now_s
        requester = self.request_of(event)
        if requester is None:
            require(self._stop is None, f"the service drove by itself after the stop of request {self._stop}")
            if event["origin"] == Origin.SUPERVISOR:
                require(self.recovers, "the service returned without a policy")
            else:
                require(not self._arm, "a loop that needs arming started by itself")
                require(len(self._world.runs) == 1, "a later loop started by itself")
            return
        self._stop = None
        require(is_drive(requester), f"{requester.path} set mode {event['values'][0]:g}")
        if self._arm:
            stops = [other for other in requests if other.path in ("/stop", "/reset") and other.code == 200]
            arms = [other for other in requests if other.path == "/arm" and other.code in (None, 200)]
            is_armed = any(
                not any(arm.answered_s < stop.sent_s and stop.answered_s < requester.sent_s for stop in stops)
                for arm in arms if arm.sent_s <= now_s
            )  # fmt: skip
            require(is_armed, f"request {requester.number} drove outputs that were not armed")

    def request_of(self, event: Any) -> Request | None:
        """Return the request for which the command of an event was sent, None for none."""
        run, identity = self._world.runs[-1], int(event["identity"])
        for request in reversed(self._world.requests):
            if request.run is run and any(command.identity == identity for command in request.commands):
                return request
        return None

    def _check_state(self) -> None:
        state = self._world.service.state.value
        if state != self._state:
            allowed = TRANSITIONS[self._state] + (("running",) if self.recovers and self._state == "tripped" else ())
            require(state in allowed, f"state {self._state} -> {state}")
            self._state = state

    # At each answer

    def on_answer(self, request: Request) -> None:
        """Check an answer."""
        self.answers += 1
        self._check_state()
        require((request.code is not None and request.code < 500) or request.code in (503, 504),
                f"request {request.number} {request.path}: {request.code} {request.answer}")  # fmt: skip
        wait_s = request.answered_s - request.sent_s
        limit_s = ANSWER_S.get(request.path, OTHER_S) + UNHURRIED_S
        require(wait_s <= limit_s, f"request {request.number} {request.path}: answered after {wait_s:.3f} s")
        self._check_effect(request)
        self._check_lock(request)
        lost = self._law_changes.on_answer(request)
        require(not lost, lost)

    def _check_effect(self, request: Request) -> None:
        """Require that an answer tells what the loop did."""
        if request.code == 200 and request.path in TICK_KINDS:
            tick, kind, run = request.answer["tick"], TICK_KINDS[request.path], request.run
            kinds = [int(event["kind"]) for event in self._effects(request) if event["tick"] == tick]
            is_refused_stop = is_stop(request) and int(Kind.REFUSED) in kinds
            require(int(kind) in kinds or is_refused_stop, f"{request}: at this tick {kinds}")
            require(run is not None and run.ticks > tick, f"{request}: answered before the record of its tick")
            if request.path == "/reset" and run is self._world.runs[-1] and not self._has_tripped_since(run, tick):
                state = self._world.service.state.value
                require(state != "tripped" or run.ended_s is not None, f"{request}: the service is tripped")
        elif request.code == 422:
            require(not request.commands or request.path in MAY_HALF_SUCCEED, f"{request}: sent {request.commands}")
        elif request.commands and "did not answer" in str(request.answer) and request.run is not None:
            since_s = request.commands[-1].sent_s
            count = request.run.ticks - request.commands[-1].tick
            require(count < 0.9 * (request.answered_s - since_s) / PERIOD_S, f"{request}: and {count} ticks since")

    def _has_tripped_since(self, run: Run, tick: int) -> bool:
        return any(event["kind"] in (Kind.TRIPPED, Kind.DRIVER_FAILED) and event["tick"] >= tick
                   for part in run.events for event in part)  # fmt: skip

    def _effects(self, request: Request) -> list[Any]:
        """Return the events of the commands that were sent for a request."""
        identities = {command.identity for command in request.commands}
        if not identities or request.run is None:
            return []
        events = (event for part in request.run.events for event in part)
        return [event for event in events if int(event["identity"]) in identities and event["kind"] != Kind.TRIPPED]

    def _check_lock(self, request: Request) -> None:
        """Require that no command was accepted while another client's lock was in force."""
        if request.path == "/status" or is_stop(request):
            return
        times_s = [command.sent_s for command in request.commands if not command.is_urgent]
        if request.code == 200 and request.path == "/arm":
            times_s.append(request.answered_s)
        for time_s in times_s:
            for held in self._world.requests:
                begin_s = held.commands[0].sent_s if held.commands and held.path != "/lock" else held.answered_s
                if (
                    held.client != request.client and held.code == 200 and takes_lock(held)
                    and begin_s < time_s < held.answered_s + self._lock_timeout_s
                    and not self._may_have_left(held, begin_s, time_s)
                ):  # fmt: skip
                    raise Violation(f"{request}: sent at {time_s:.4f} s, while the lock was held by {held}")

    def _may_have_left(self, held: Request, begin_s: float, time_s: float) -> bool:
        """Return whether the lock may have changed its holder since `held` had it: by its release, or a key."""
        return any(
            other is not held and other.path == "/lock" and other.answered_s >= begin_s and other.sent_s <= time_s
            and (other.method == "DELETE" or other.body)
            for other in self._world.requests
        )  # fmt: skip

    # At the end

    def at_end(self, is_disturbed: bool) -> None:
        """Check the recordings of all loops, and that the outputs are safe; `is_disturbed`: by a fault of the disk, or
        the death of a process.
        """
        self.flush()
        world = self._world
        require(not np.any(world.board.volts), f"the outputs end at {world.board.volts} V")
        for request in world.requests:
            if request.code in (409, 503) and request.path not in MAY_HALF_SUCCEED:
                kinds = [int(event["kind"]) for event in self._effects(request) if event["kind"] != Kind.REFUSED]
                require(not kinds, f"{request}: took effect by {kinds}")
            if request.code == 200 and request.path in ("/setpoint", "/waveform"):
                self._check_reference(request)
        results = [result for result in world.service.results if result.recordings or result.recorder]
        require(len(results) == len(world.runs), f"{len(world.runs)} loops and {len(results)} results")
        for run, result in zip(world.runs, results, strict=True):
            check_recording(run, result)
            is_whole = is_disturbed or run.outcome == "killed" or result.recorder["complete"]
            require(is_whole, f"a recording that nothing disturbed is incomplete: {result.recorder}")

    def _check_reference(self, request: Request) -> None:
        """Require that the axis had the reference of an answered request until the next event of a reference."""
        run, tick, body = request.run, request.answer["tick"], request.body
        assert run is not None
        axis = "xy".index(body["axis"])
        events = [event for part in run.events for event in part if event["tick"] >= tick]
        own = next(k for k, event in enumerate(events) if self._is_of(event, request))
        later = [int(event["tick"]) for event in events[own + 1 :]
                 if event["kind"] in (Kind.SET_MODE, Kind.SET_REFERENCE) and event["axis"] in (-1, axis)]  # fmt: skip
        values = body.get("samples") or [body["value"]] * 20
        count = len(values) * (4 if body.get("repeat") else 1)
        end = min([tick + count, run.ticks, *later])
        played = np.concatenate(run.rows)[tick:end, COMMON_COUNT + PER_AXIS_COUNT * axis + REFERENCE]
        require(np.array_equal(played, np.resize(values, len(played))), f"{request}: another reference was played")

    def _is_of(self, event: Any, request: Request) -> bool:
        return event["kind"] == Kind.SET_REFERENCE and any(
            command.identity == int(event["identity"]) for command in request.commands
        )


def check_recording(run: Run, result: Any) -> None:
    """Require that each tick of a loop is in its files in equal bytes, or was counted as lost."""
    from rtloop.recording.load import load

    rows = np.concatenate([*run.rows, np.zeros((0, 1))]) if not run.rows else np.concatenate(run.rows)
    recorded = [block for block in load(files_of_run(result)).blocks()] if result.recordings else []
    ticks = np.concatenate([block[:, TICK] for block in recorded]).astype(int) if recorded else np.zeros(0, int)
    require(np.all(np.diff(ticks) > 0), "a tick is twice in the recording")
    if len(ticks):
        require(ticks[-1] < len(rows), "the recording has a tick that was not executed")
        require(np.concatenate(recorded).tobytes() == rows[ticks].tobytes(), "the recording has other rows")
    totals = result.recorder
    if "ticks_lost" in totals:
        lost = len(rows) - len(ticks)
        require(totals["ticks_lost"] == lost, f"{lost} ticks are missing, and {totals['ticks_lost']} count as lost")
        require(totals["complete"] <= (lost == 0), "the recording counts as complete, and lacks ticks")
    else:
        require(not totals["complete"], "a recording without counts is complete")


def files_of_run(result: Any) -> list[Path]:
    """Return the files of a run: those of its result, and one that a failing disk left unfinished, which says so."""
    paths = list(result.recordings)
    unfinished = {
        part for path in paths for part in path.parent.glob("*.mcap.part") if part.name in str(result.recorder)
    }
    return [*paths, *sorted(unfinished)]


def is_stop(request: Request) -> bool:
    """Return whether a request is a stop: it needs no lock."""
    return request.path == "/stop" or (request.path == "/mode" and request.body == {"mode": "off"})


def is_drive(request: Request) -> bool:
    """Return whether a request may let the outputs move."""
    return request.path in ("/start", "/mode") and not is_stop(request)


def takes_lock(request: Request) -> bool:
    """Return whether an accepted request takes or renews the lock of its client."""
    return not is_stop(request) and request.path != "/status" and request.method == "POST"
