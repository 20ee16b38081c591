"""Run another law on a recording: on the recorded inputs, or in closed loop with a simulated rig.

Both start from rest, as a run does, with the recorded references and commands. On the recorded inputs, the outputs of
the law have no effect on the inputs; with the rig, the loop is closed. Law and rig ignore missing ticks: they continue
with the next recorded tick.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from typing import NamedTuple

from rtloop import signals
from rtloop.drivers.base import Driver
from rtloop.kernel.layout import Records
from rtloop.kernel.memory import LawMemory
from rtloop.kernel.step import set_mode
from rtloop.laws.binding import bind_functions
from rtloop.laws.registry import LawReference, law_layout
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.run_readers import ReportTicks
from rtloop.recording.file.topics.validation import header_extra_channels, header_extras
from rtloop.recording.load import Recording
from rtloop.recording.replay.differences import SignalDifferences, TrackingPerformance
from rtloop.recording.replay.laws import NO_TRUST, TrustedLaws, recorded_laws
from rtloop.recording.replay.replay import LAW_COMMANDS, recorded_commands, snapshot_law, split_at_gaps
from rtloop.recording.replay.rerun import InputSource, RecordedInputs, Rerun, Rows, SimulatedInputs
from rtloop.signals import Mode


class LawWithCoefficients(NamedTuple):
    """Laws that a loop knows, and the coefficients of its axes.

    `enters` is False for the law of a recording that began in closed loop without an entry, as those of version 0.2.0.
    """

    laws: tuple[LawReference, ...]
    coefficients: Records
    enters: bool = True


def recorded_law(recording: Recording, trust: TrustedLaws = NO_TRUST) -> LawWithCoefficients:
    """Return the laws of a recording, as far as `trust` allows, with the coefficients of its first snapshot.

    Raises RecordingError for imported signals, without a snapshot or for one with values that are not allowed, and for
    a law that is missing or differs from the recorded one; ConfigError if a law's code ends or blocks its process.
    """
    laws = recorded_laws(recording, trust)
    with closing(recording.snapshots()) as snapshots:
        first = next(snapshots, None)
    if first is None:
        raise RecordingError(
            f"{recording.paths[0]}: no snapshot of the law in this recording, so the law's coefficients are unknown; "
            "use another recording"
        )
    memory = snapshot_law(first, recording, laws)
    return LawWithCoefficients(laws, memory.coefficients, bool(memory.axes["entering"].any()))


def compare_law(
    recording: Recording, law: LawWithCoefficients, progress: ReportTicks | None = None
) -> dict[str, object]:
    """Compare the outputs of another law with the recorded ones, on the recorded inputs.

    Returns {ticks, problems, signals: {name: {max, at_tick, rms}}, trip: {tick, causes} of the other law or None}:
    `ticks` counts the compared ticks; `max` and `rms` are of the absolute difference, in the signal's unit. Raises
    RecordingError if the recording has no tick or cannot be read.
    """
    differences = SignalDifferences(recording.header["axes"])
    ticks = 0
    with closing(_execute_recording(recording, law, RecordedInputs(recording.header), progress)) as pairs:
        for recorded, replayed in pairs:
            differences.add(recorded, replayed)
            ticks += len(replayed)
    return {"ticks": ticks, "problems": recording.problems, **differences.report()}


def resimulate(
    recording: Recording, law: LawWithCoefficients, driver: Driver, progress: ReportTicks | None = None
) -> dict[str, object]:
    """Run a law with the recorded references on a simulated rig, and compare its tracking with the recorded tracking.

    Returns {ticks, problems, trips: {recorded, resimulated}, axes: [{name, recorded, resimulated}]} with the figures of
    `TrackingPerformance`; `ticks` counts the compared ticks, a trip is {tick, causes} or None. Opens and closes the
    driver. Raises RecordingError if the recording has no tick or cannot be read, DriverError if the driver cannot be
    opened.
    """
    axes, rate_hz = recording.header["axes"], recording.header["rate_hz"]
    before, after = (TrackingPerformance(axes, rate_hz) for _ in range(2))
    ticks = 0
    try:
        source = SimulatedInputs(driver, header_extra_channels(recording.header))
        with closing(_execute_recording(recording, law, source, progress)) as pairs:
            for recorded, replayed in pairs:
                before.add(recorded)
                after.add(replayed)
                ticks += len(replayed)
    finally:
        driver.close()
    axis_reports = zip(axes, before.report(), after.report(), strict=True)
    return {
        "ticks": ticks,
        "problems": recording.problems,
        "trips": {"recorded": before.trip, "resimulated": after.trip},
        "axes": [{"name": name, "recorded": old, "resimulated": new} for name, old, new in axis_reports],
    }


def _execute_recording(
    recording: Recording, law: LawWithCoefficients, source: InputSource, progress: ReportTicks | None
) -> Generator[tuple[Rows, Rows]]:
    """Yield recorded and executed rows (n, columns) of the same ticks, until the recording or the loop ends.

    The law begins at rest, in the mode of the first recorded tick. The executed rows are a view, valid until the next
    pair. Raises RecordingError without ticks.
    """
    commands, rerun, ticks = recorded_commands(recording, LAW_COMMANDS), None, 0
    with closing(recording.blocks()) as blocks:
        for rows in (rows for block in blocks for rows in split_at_gaps(block)):
            while len(rows):
                tick = int(rows[0, signals.TICK])
                if rerun is None:
                    memory = _law_at_rest(recording, law, Mode(int(rows[0, signals.MODE])))
                    rerun = Rerun(recording.header, source, law.laws, memory, commands[commands["tick"] >= tick], tick)
                count = min(len(rows), rerun.max_ticks(tick))
                replayed = rerun.execute(rows[:count])
                yield rows[: len(replayed)], replayed
                ticks += len(replayed)
                if progress:
                    progress(ticks)
                if len(replayed) < count:
                    return
                rows = rows[count:]
    if rerun is None:
        raise RecordingError(f"{recording.paths[0]}: holds no tick")


def _law_at_rest(recording: Recording, law: LawWithCoefficients, mode: Mode) -> LawMemory:
    """Memory of the laws `law` at rest, in `mode`, with the extra inputs and outputs of the recording."""
    extras = header_extras(recording.header)
    memory = LawMemory.create_at_rest(law_layout(law.laws), bind_functions(law.laws), law.coefficients, extras)
    set_mode(memory.law, int(mode), not law.enters or mode != Mode.CLOSED_LOOP)
    return memory
