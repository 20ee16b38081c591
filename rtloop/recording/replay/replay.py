"""Re-execution of a recording: recorded inputs, references and commands through the same compiled loop.

Coefficients and state come from the recording's binary snapshots, never from its configuration text. Every output of
every tick is compared in bytes, and at each snapshot the law's whole state too. After a gap the replay continues from
the next snapshot.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtloop import signals
from rtloop.engine.messages import MESSAGE, Kind
from rtloop.kernel.memory import LawMemory
from rtloop.laws.binding import bind_functions
from rtloop.laws.registry import LawReference, law_layout
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Snapshot
from rtloop.recording.file.run_readers import ReportTicks
from rtloop.recording.file.topics.events import GAP, RECOVERED, ROTATED, Event, json_value, message_from_event
from rtloop.recording.file.topics.overview import uncovered_ranges
from rtloop.recording.file.topics.validation import header_extras
from rtloop.recording.load import Recording, load
from rtloop.recording.replay.kernels import first_unequal
from rtloop.recording.replay.laws import NO_TRUST, TrustedLaws, recorded_laws
from rtloop.recording.replay.rerun import RecordedInputs, Rerun, Rows
from rtloop.recording.replay.snapshots import first_difference
from rtloop.recording.replay.verdict import ReplayReport, unjudged_contents

MIN_RATE_PERIODS, RATE_TOLERANCE = 50, 0.05
"""Least number of periods for which the rate is compared, and its tolerance: the clock of a card may be inexact."""
LAW_COMMANDS = (Kind.SET_MODE, Kind.RESET_TRIP, Kind.STOP)
LAW_COMMAND_NAMES = {kind.name.lower() for kind in (*LAW_COMMANDS, Kind.LOAD_LAW)}


def replay(recording: Recording, progress: ReportTicks | None = None, trust: TrustedLaws = NO_TRUST) -> ReplayReport:
    """Replay a recording up to the first difference, and return the report.

    `progress` receives the number of compared ticks. `trust` allows laws that are neither shipped nor installed. Raises
    RecordingError for a recording without a law, without a tick after a snapshot, or with a malformed snapshot, for a
    law or layout that differs from the recorded one, and for a file that cannot be read; ConfigError if a law's code
    ends or blocks its process.
    """
    laws = recorded_laws(recording, trust)
    with closing(recording.snapshots()) as snapshots:
        return Replay(recording, laws, snapshots, progress).run()


def snapshot_law(snapshot: Snapshot, recording: Recording, laws: Sequence[LawReference]) -> LawMemory:
    """Return the law's memory with coefficients and state of a snapshot.

    Raises RecordingError for a wrong size or values that are not allowed.
    """
    layout = law_layout(laws)
    with _snapshot_faults(snapshot, recording):
        _, *law = layout.split_snapshot(snapshot.data, len(recording.header["axes"]))
        coefficients, axes, state = law
        return LawMemory(layout, bind_functions(laws), coefficients, axes, state, header_extras(recording.header))


@contextmanager
def _snapshot_faults(snapshot: Snapshot, recording: Recording) -> Iterator[None]:
    """Convert a ValueError inside the block to a RecordingError that names the snapshot."""
    try:
        yield
    except ValueError as error:
        raise RecordingError(
            f"{recording.paths[0]}: the snapshot of the law at tick {snapshot.tick} cannot be used: {error}"
        ) from None


def recorded_commands(recording: Recording, kinds: Sequence[Kind]) -> npt.NDArray[np.void]:
    """Return the recorded commands of `kinds` as a schedule (n,) of MESSAGE records, in recorded order.

    A change of mode does not set the references: these are replayed from their samples.
    """
    commands = [message_from_event(event, recording.header["axes"]) for event in recording.events]
    law_commands = [command for command in commands if command is not None and command["kind"][0] in kinds]
    schedule = np.concatenate([np.zeros(0, MESSAGE), *law_commands])
    schedule["values"][schedule["kind"] == Kind.SET_MODE, 2] = 0.0  # The references are replayed from their samples.
    return schedule


def misplaced_command(recording: Recording) -> int | None:
    """Tick of the first command to the law that is recorded twice, after one of a later tick, or after the run's end.

    None if none is. A command that a second file of the run holds too must be equal there. A file that another one
    follows, or that was repaired, may end before its last command.
    """
    last = recording.extents[-1].totals
    end_tick = last["ticks_executed"] if last and last["result"] not in (RECOVERED, ROTATED) else math.inf
    last_tick, executed_keys = 0, set()
    for event in recording.events:
        if event["kind"] not in LAW_COMMAND_NAMES:
            continue
        key = _command_key(event)
        if key in executed_keys or not last_tick <= event["tick"] <= end_tick:
            return int(event["tick"])
        executed_keys.add(key)
        last_tick = event["tick"]
    for event in recording.repeated_events:
        if event["kind"] in LAW_COMMAND_NAMES and _command_key(event) not in executed_keys:
            return int(event["tick"])
    return None


def _command_key(event: Event) -> tuple[object, ...]:
    """Return the fields by which two events are the same command; numbers as text, in which NaN equals NaN."""
    details = event["what"]
    values = (repr(float(value)) for value in details["values"])
    return event["tick"], event["kind"], event["axis"], details["identity"], *values


def split_at_gaps(rows: Rows) -> list[Rows]:
    """Split rows (n, columns), n > 0, into blocks of consecutive ticks."""
    ticks = rows[:, signals.TICK]
    if ticks[-1] - ticks[0] == len(rows) - 1:  # The usual case; the ticks themselves are compared later.
        return [rows]
    return np.split(rows, np.flatnonzero(np.diff(ticks) != 1) + 1)


class Replay:
    """Replay of one recording, or of some of its ticks; `report` is its result."""

    def __init__(
        self,
        recording: Recording,
        laws: Sequence[LawReference],
        snapshots: Iterator[Snapshot],
        progress: ReportTicks | None,
    ) -> None:
        """Prepare a replay from the first of `snapshots`, which ascend by tick; no tick is executed yet.

        Without any snapshot, `run` raises. `laws` are the laws of the recorded loop, in its order. `progress` receives
        the number of compared ticks. A command that is recorded twice or out of order is reported as unverified.
        """
        self._laws = laws
        self._recording, self._snapshots, self._progress = recording, snapshots, progress
        self._commands = recorded_commands(recording, (*LAW_COMMANDS, Kind.LOAD_LAW))
        self._next_snapshot: Snapshot | None = next(snapshots, None)
        self._rerun: Rerun | None = None
        self.report = ReplayReport(problems=recording.problems, not_judged=unjudged_contents(recording.header))
        self._tick_count = 0
        self._gaps = [event["what"] for event in recording.events if event["kind"] == GAP]
        if (tick := misplaced_command(recording)) is not None:
            self.report.add_unverified(
                tick, None, "a command is recorded twice, after a later command, or after the end of the run"
            )

    def run(self) -> ReplayReport:
        """Replay all ticks, up to the first difference; without one, check the totals too. Returns `report`.

        Raises RecordingError if there is no tick to compare, a snapshot is malformed, or a file cannot be read.
        """
        expected = self._recording.extents[0].first_tick
        with closing(self._recording.blocks(ahead=False)) as blocks:
            for block in blocks:
                for rows in split_at_gaps(block):
                    first = int(rows[0, signals.TICK])
                    self._account_gap(expected, first)
                    expected = first + len(rows)
                    self._replay_rows(rows)
                    self._tick_count += len(rows)
                if self.report.first_difference:
                    first_unverified = self.report.first_difference["tick"] + 1
                    self.report.add_unverified(first_unverified, None, "after the first difference")
                    self._report_unreadable()
                    return self.report
                if self._progress:
                    self._progress(self.report.ticks)
        if not self.report.ticks:
            path = self._recording.paths[0]
            raise RecordingError(
                f"{path}: the recording has no tick after a snapshot of the law (its whole state, once a second), "
                "where a replay starts; record at least a second more"
            )
        self._check_totals(expected)
        self._check_repetitions()
        return self.report

    def run_rows(self, blocks: Iterable[Rows], first_tick: int) -> int | None:
        """Replay `blocks`, arrays (n, columns) of the ticks from `first_tick` on. Returns the tick after the last one.

        Returns None as soon as a tick is missing, is not verified or differs. Raises RecordingError for a malformed
        snapshot.
        """
        expected = first_tick
        for rows in blocks:
            if int(rows[0, signals.TICK]) != expected or len(split_at_gaps(rows)) != 1:
                return None
            self._replay_rows(rows)
            if self.report.first_difference or self.report.not_verified:
                return None
            expected += len(rows)
            if self._progress:
                self._progress(self.report.ticks)
        return expected

    def _account_gap(self, expected: int, first: int) -> None:
        """Report the missing ticks from `expected` to before `first`, and end the rerun if there are any.

        Ticks omitted by intention count as skipped; all others are added to the `gaps` of the report, and those without
        a gap event also count as unverified.
        """
        if first == expected:
            return
        self._rerun = None
        missing = uncovered_ranges(expected, first, self._recording.skipped)
        self.report.skipped += first - expected - sum(count for _, count in missing)
        for begin, count in missing:
            self.report.gaps.append({"first_tick": begin, "count": count})
            if uncovered_ranges(begin, begin + count, sorted((gap["first_tick"], gap["count"]) for gap in self._gaps)):
                self.report.add_unverified(begin, count, "not in the recording")

    def _report_unreadable(self) -> None:
        """Add the problems that removed data from the recording to the report, as unverified ticks of unknown place."""
        for problem in self._recording.left_out:
            self.report.add_unverified(None, None, problem)

    def _check_totals(self, expected: int) -> None:
        """Compare the replayed ticks and snapshots with the totals of the files; `expected` follows the last tick.

        Missing ticks at the end are reported as a gap. Unverified are those of them that were recorded, snapshots after
        the end of the run, problems that removed data, and ticks from `expected` on if the last file has no totals.
        """
        extents = self._recording.extents
        last = extents[-1].totals
        for snapshot in [] if self._next_snapshot is None else [self._next_snapshot, *self._snapshots]:
            if last and last["result"] != RECOVERED and snapshot.tick > last["ticks_executed"]:
                self.report.add_unverified(
                    None, None, f"a snapshot of the law at tick {snapshot.tick} is after the end of the run"
                )
        self._report_unreadable()
        if last is None:
            self.report.add_unverified(
                expected, None, "the recording has no recorded end; `rtloop recover` completes the file"
            )
            return
        ticks_logged = sum(extent.totals["ticks_logged"] - extent.repeated for extent in extents if extent.totals)
        if self._tick_count == ticks_logged and last["result"] != RECOVERED:  # The rest was never recorded.
            self._gaps.append({"first_tick": expected, "count": last["ticks_executed"] - expected})
        self._account_gap(expected, last["ticks_executed"])

    def _check_repetitions(self) -> None:
        """Report the ticks that a file repeats, and that differ there from those of the earlier file.

        The file is replayed alone, from its first snapshot to the first one after the repetition.
        """
        for path, extent in zip(self._recording.paths, self._recording.extents, strict=True):
            if extent.repeated and not self._is_identical_alone(path, extent.first_tick):
                first_tick = extent.first_tick - extent.repeated
                reason = f"{path.name} repeats these ticks of an earlier file, and they are not identical there"
                self.report.add_unverified(first_tick, extent.repeated, reason)

    def _is_identical_alone(self, path: Path, end: int) -> bool:
        """Whether a file alone is identical, from its first tick to the first snapshot after `end`, or to its end."""
        part = load(path)
        tick, snapshots = part.extents[0].first_tick, -1
        with closing(part.snapshots()) as recorded, closing(part.blocks(ahead=False)) as blocks:
            part_replay = Replay(part, self._laws, recorded, None)
            for rows in blocks:
                if tick >= end and snapshots < 0:
                    snapshots = part_replay.report.snapshots
                if 0 <= snapshots < part_replay.report.snapshots:
                    break
                if (tick := part_replay.run_rows([rows], tick) or -1) < 0:
                    return False
        return part_replay.report.identical and not part.left_out

    def _replay_rows(self, rows: Rows) -> None:
        """Replay consecutive rows from snapshot to snapshot, up to the first difference.

        Rows without an earlier snapshot are reported as unverified.
        """
        while len(rows) and not self.report.first_difference:
            tick = int(rows[0, signals.TICK])
            snapshot = self._take_snapshot(tick)
            until = tick + len(rows) if self._next_snapshot is None else self._next_snapshot.tick
            count = min(len(rows), until - tick)
            if self._rerun is None:
                self.report.add_unverified(tick, count, "there is no earlier snapshot of the law to start from")
            else:
                count = min(count, self._rerun.max_ticks(tick))
                self._compare(self._rerun, rows[:count])
                if snapshot is not None:
                    self._compare_snapshot(self._rerun, snapshot)
            rows = rows[count:]

    def _take_snapshot(self, tick: int) -> Snapshot | None:
        """Take the recorded snapshot at `tick`: start a rerun from it if none runs, else return it to be compared.

        If a snapshot is returned, the rerun will take one of its state at `tick` too. None if there is no snapshot at
        `tick`, or the rerun started from it. Earlier snapshots are skipped. Raises RecordingError for a malformed one.
        """
        while self._next_snapshot is not None and self._next_snapshot.tick < tick:
            self._next_snapshot = next(self._snapshots, None)
        if self._next_snapshot is None or self._next_snapshot.tick != tick:
            return None
        snapshot, self._next_snapshot = self._next_snapshot, next(self._snapshots, None)
        if self._rerun is None:
            self._start_rerun(snapshot.tick, snapshot_law(snapshot, self._recording, self._laws))
            return None
        with _snapshot_faults(snapshot, self._recording):
            law_layout(self._laws).split_snapshot(snapshot.data, len(self._recording.header["axes"]))
        self._rerun.expect_snapshot(snapshot.data)
        return snapshot

    def _compare_snapshot(self, rerun: Rerun, snapshot: Snapshot) -> None:
        """Compare the newest snapshot of `rerun` with the recorded one of its tick, in bytes, and count it in `report`.

        A difference is stored in `report` unless there is an earlier one.
        """
        replayed, recorded = rerun.newest_snapshot()[8:], snapshot.data[8:]
        self.report.snapshots += 1
        if replayed != recorded and not self.report.first_difference:
            self._record_difference(
                snapshot.tick, *first_difference(recorded, replayed, self._recording.header["axes"], rerun.law)
            )

    def _start_rerun(self, tick: int, law: LawMemory) -> None:
        """Begin a rerun of `law`, the memory of the snapshot at `tick`, with the commands of later ticks.

        Counts one more of the report's `stretches`: ticks that are compared from one snapshot on.
        """
        header = self._recording.header
        later_commands = self._commands[self._commands["tick"] > tick]
        self.report.stretches += 1
        self._rerun = Rerun(header, RecordedInputs(header), self._laws, law, later_commands, tick)

    def _compare(self, rerun: Rerun, recorded: Rows) -> None:
        """Execute the ticks of `recorded`, count those compared, and store the first difference.

        A loop that ends early is a difference; so is a wrong rate.
        """
        self._compare_rate(recorded)
        replayed = rerun.execute(recorded)
        count = len(replayed)
        unequal = first_unequal(recorded[:count], replayed)
        if self.report.first_difference:
            return
        if unequal is None:
            self.report.ticks += count
            if count < len(recorded):
                self._record_difference(int(recorded[count, signals.TICK]), "end of the run", None, None)
            return
        row, column = unequal
        self.report.ticks += row + 1
        values = float(recorded[row, column]), float(replayed[row, column])
        self._record_difference(int(recorded[row, signals.TICK]), self._recording.columns[column], *values)

    def _compare_rate(self, recorded: Rows) -> None:
        """Store a difference if the deadlines of `recorded` are off the rate by the fraction RATE_TOLERANCE or more.

        Rows over less than MIN_RATE_PERIODS are not judged.
        """
        periods = len(recorded) - 1 + recorded[1:, signals.PERIODS_MISSED].sum()
        span_ns = recorded[-1, signals.DEADLINE] - recorded[0, signals.DEADLINE]
        rate_hz = self._recording.header["rate_hz"]
        if periods >= MIN_RATE_PERIODS and abs(span_ns * 1e-9 * rate_hz / periods - 1) >= RATE_TOLERANCE:
            self._record_difference(int(recorded[0, signals.TICK]), "rate_hz", rate_hz, 1e9 * periods / span_ns)

    def _record_difference(self, tick: int, signal: str, recorded: object, replayed: object) -> None:
        """Set `first_difference` of the report to {tick, signal, recorded, replayed}; NaN and infinities as text."""
        values = {"recorded": json_value(recorded), "replayed": json_value(replayed)}
        self.report.first_difference = {"tick": tick, "signal": signal, **values}
