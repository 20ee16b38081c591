"""Sample times of a table: its column of times in ns, the rate, and notes on irregularities."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.interchange.formats.groups import TIME_NAMES, row_count
from rtloop.interchange.formats.table import Table, UnreadableData
from rtloop.interchange.mapping import map_column, name_without_unit
from rtloop.interchange.units import UnknownUnit, factor_between, scale_values
from rtloop.recording.file.topics.ticks import LARGEST
from rtloop.recording.file.topics.validation import HIGHEST_RATE_HZ, LOWEST_RATE_HZ
from rtloop.signals import COMMON_SIGNALS, DEADLINE, TICK
from rtloop.values import count_text

JITTER_TOLERANCE = 1e-3
"""Fraction of a period by which samples may be early or late without a note."""
ROUNDED_NS = 1.5
"""Deviation that rounding to whole ns causes."""
GAP_PERIODS = 1.5
"""Interval in periods from which samples count as missing."""


RECORDING_TIME_COLUMNS = (COMMON_SIGNALS[TICK].name, COMMON_SIGNALS[DEADLINE].name)
"""A file with both columns came from a recording, and keeps its columns."""


class TimeBase(NamedTuple):
    """Growing deadlines (rows,) in whole ns, the rate, the source of the times, and notes on irregularities."""

    deadline_ns: Real
    rate_hz: float
    description: str
    notes: list[str]


def find_time_base(table: Table, path: Path, time: str | None, rate_hz: float | None) -> TimeBase:
    """Return the times by `rate_hz`, or else by the column of the mapping `time`, such as "Clock [ms]", or by the
    file's own column of times.

    With `rate_hz`, which is not checked, the samples are counted from 0, and no column of times is needed. Else a
    time without a unit counts as s, with a note. Raises UnreadableData without a column of times, for fewer than two
    samples, for a time that does not grow, is not finite, spans too long or has an unknown unit, and for times that
    give a rate outside LOWEST_RATE_HZ to HIGHEST_RATE_HZ.
    """
    if rate_hz is not None:
        deadlines = np.rint(np.arange(row_count(table)) * (1e9 / rate_hz))
        return TimeBase(deadlines, rate_hz, f"by the given rate of {rate_hz:g} Hz", [])
    if time is None and (time := time_column(table)) is None:
        raise UnreadableData(
            f"{path}: no column of times found; select one with --time COLUMN, or give the rate with --rate HZ"
        )
    column = map_column(table, path, "time", time)
    if table.columns[column.name].size < 2:
        raise UnreadableData(f"{path}: fewer than two samples; give the rate with --rate HZ")
    unit, notes, description = column.unit, [], column.description
    if not unit:
        unit, notes = "s", [f"the time {column.name!r} has no known unit; s is assumed"]
        description = f"{name_without_unit(column.name)} [s]{description.removeprefix(column.name)}"
    deadlines, conversion_notes = _deadlines_ns(path, column.name, column.values(table), unit)
    period_ns, irregularity_notes = _regularity(deadlines)
    measured_rate_hz = _rate_hz(deadlines, period_ns)
    if not LOWEST_RATE_HZ <= measured_rate_hz <= HIGHEST_RATE_HZ:
        raise UnreadableData(
            f"{path}: the times {column.name!r} in {unit} give a rate of {measured_rate_hz:g} Hz; allowed: "
            f"{LOWEST_RATE_HZ:g} to {HIGHEST_RATE_HZ:g} Hz. Give another unit with --time "
            f"'{name_without_unit(column.name)} [ms]', or the rate with --rate HZ"
        )
    return TimeBase(deadlines, measured_rate_hz, description, [*notes, *conversion_notes, *irregularity_notes])


def is_from_recording(table: Table) -> bool:
    """Whether a table has a recording's ticks and deadlines: then no mapping is needed."""
    return set(RECORDING_TIME_COLUMNS) <= table.columns.keys()


def time_column(table: Table) -> str | None:
    """Return the name of the column of times; None without one.

    The first of these that exists: a recording's deadlines, the file's own column, a column with one of TIME_NAMES, the
    first column if its name ends in `_1`, others follow, and it grows evenly.
    """
    if is_from_recording(table):
        return RECORDING_TIME_COLUMNS[1]
    named_columns = [
        name
        for name in table.columns
        if name_without_unit(name).rpartition("/")[2].strip(" \"'").casefold() in TIME_NAMES
    ]
    return table.time or next(iter(named_columns), None) or _first_column_as_time(table)


def _first_column_as_time(table: Table) -> str | None:
    """Return the name of the first column if it ends in `_1`, others follow, and it grows evenly; else None.

    Columns without names, and rows of Simulink's To File, get such names here.
    """
    name, times = next(iter(table.columns.items()))
    return name if name.endswith("_1") and len(table.columns) > 1 and grows_evenly(times) else None


def grows_evenly(values: Real) -> bool:
    """Whether each value exceeds the one before, by steps that differ by less than a factor of GAP_PERIODS.

    False for fewer than three values, and with NaN.
    """
    with np.errstate(invalid="ignore"):  # inf − inf, which does not grow
        steps = np.diff(values)
    return steps.size > 1 and bool(steps.min() > 0 and steps.max() < GAP_PERIODS * steps.min())


def _deadlines_ns(path: Path, name: str, times: Real, unit: str) -> tuple[Real, list[str]]:
    """Return deadlines (rows,) in whole ns since the file's own origin, and notes.

    They count from the first sample, with a note, if a time is negative or beyond LARGEST. Raises UnreadableData for
    times that do not grow, are not finite or span too long, and for an unknown unit.
    """
    if not np.all(np.isfinite(times)):
        raise UnreadableData(
            f"{path}: time {name!r}: row {int(np.argmin(np.isfinite(times))) + 1} has no finite number; "
            "use --time COLUMN for another column, or --rate HZ"
        )
    try:
        factor = factor_between(unit, "s") * 10**9
    except UnknownUnit as fault:
        raise UnreadableData(f"{path}: time {name!r}: {fault}") from None
    notes = []
    if times.min() < 0 or times.max() * float(factor) > LARGEST:
        notes = [f"the file's time begins at {times[0]:g} {unit}; this becomes 0 in the recording"]
        times = times - times[0]
    deadlines = np.rint(scale_values(times, factor))
    is_growing = np.diff(deadlines) > 0
    if not is_growing.all():
        row = int(np.argmin(is_growing))
        raise UnreadableData(
            f"{path}: time {name!r} does not grow from row {row + 1} ({times[row]:g} {unit}) to row {row + 2} "
            f"({times[row + 1]:g} {unit}); "
            "use --time COLUMN for another column, or --rate HZ"
        )
    if deadlines[-1] > LARGEST:
        raise UnreadableData(
            f"{path}: time {name!r} spans {np.ptp(times):g} {unit}; allowed: up to {LARGEST * 1e-9:.2g} s. Give "
            f"another unit with --time '{name_without_unit(name)} [ms]', or the rate with --rate HZ"
        )
    return deadlines, notes


def _rate_hz(deadlines: Real, period_ns: float) -> float:
    """Return the rate in Hz: by the mean period if all are within ROUNDED_NS of the median `period_ns`, else by it."""
    is_even = bool(np.all(np.abs(np.diff(deadlines) - period_ns) <= ROUNDED_NS))
    period_ns = float(deadlines[-1] - deadlines[0]) / (deadlines.size - 1) if is_even else period_ns
    return float(f"{1e9 / period_ns:.9g}")


def _regularity(deadlines: Real) -> tuple[float, list[str]]:
    """Return the median period in ns, and notes on jitter and missing samples, [] for even samples."""
    intervals = np.diff(deadlines)
    period, notes = float(np.median(intervals)), []
    regular_intervals = intervals[intervals < GAP_PERIODS * period]
    deviation = np.abs(regular_intervals - period)
    if deviation.size and deviation.max() > max(JITTER_TOLERANCE * period, ROUNDED_NS):
        rms = float(np.sqrt(np.mean(deviation**2)))
        notes.append(
            f"sample times jitter: the periods deviate by {rms / 1e3:.3g} µs rms, {deviation.max() / 1e3:.3g} µs at "
            f"most, from the median of {period / 1e3:.6g} µs; the import keeps the times as recorded"
        )
    gap_indices = np.flatnonzero(intervals >= GAP_PERIODS * period)
    if gap_indices.size:
        samples = int(np.sum(np.rint(intervals[gap_indices] / period) - 1))
        first_gap_text = f"the first after {deadlines[gap_indices[0]] * 1e-9:.6g} s"
        notes.append(
            f"about {count_text(samples, 'sample')} missing, in {count_text(gap_indices.size, 'gap')}, {first_gap_text}"
        )
    return period, notes
