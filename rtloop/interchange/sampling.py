"""Sample times of a table: its column of times in ns, the rate, and notes on irregularities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.interchange.columns import STATED, ColumnSelection
from rtloop.interchange.formats.groups import row_count
from rtloop.interchange.formats.table import Reading, Table, UnreadableData, ask
from rtloop.interchange.mapping import MappedColumn, find_column, map_column
from rtloop.interchange.names import (
    TIME_NAMES,
    bare_name,
    is_counter_name,
    is_time_name,
    is_time_unit,
    name_without_unit,
)
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


CLOCK_TOLERANCE = 1e-3
"""Fraction by which two clocks of the same rows may differ."""
USUAL_RATE_HZ = 20.0
"""From this rate on, times with fractions and without a unit count as s: in ms the rate were above 20 kHz."""
EPOCH_UNITS = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9}
EPOCH_S = (1e9, 4.2e9)
"""Times since 1970 of the years 2001 to 2103; LabVIEW counts from 1904."""
LEAST_EPOCH_RATE_HZ = 0.1
"""Slower stamps since 1970 are rather the ticks of a device that has run for long."""
BISECTIONS = 60
MOST_DIGITS = 7
"""Digits of times that a program has rounded, such as six by %g."""
DAY_NUMBERS = ((2e4, 8e4), (6e5, 8e5))
"""Days that spreadsheets count from 1900, and MATLAB from the year 0, of our time."""
FEWEST_ROUNDED = 8
"""Rows from which on a rounded clock shows its period."""

RECORDING_TIME_COLUMNS = (COMMON_SIGNALS[TICK].name, COMMON_SIGNALS[DEADLINE].name)
"""A file with both columns came from a recording, and keeps its columns."""


class TimeBase(NamedTuple):
    """Growing deadlines (rows,) in whole ns, the rate, the source of the times, and notes on irregularities.

    `column` is the column of times; None where a rate alone gives them.
    """

    deadline_ns: Real
    rate_hz: float
    description: str
    notes: list[str]
    column: str | None


def find_time_base(
    table: Table, path: Path, selection: ColumnSelection, units: Mapping[str, str | None], clock: str | None
) -> TimeBase:
    """Return the times by the rate or the column of `selection`, or else by the evidence of the file.

    The evidence: the column `clock`, as `clock_column` finds it, and rates that the file states. `units` are the units
    of all columns. Raises AmbiguousData where two readings remain; UnreadableData without a
    column of times, for fewer than two samples, for a time that does not grow, is not finite, spans too long or has an
    unknown unit, and for times that give a rate outside LOWEST_RATE_HZ to HIGHEST_RATE_HZ.
    """
    if selection.rate_hz is not None:
        return _counted(table, selection.rate_hz, f"by the given rate of {selection.rate_hz:g} Hz", [])
    if is_from_recording(table) and selection.time is None:
        return _from_column(table, path, map_column(table, path, "time", RECORDING_TIME_COLUMNS[1]), "ns", [])
    if selection.time is not None:
        column = map_column(table, path, "time", selection.time)
        unit = column.unit or selection.time_unit
        notes = [] if unit else [f"the time {column.name!r} has no known unit; s is assumed"]
        return _from_column(table, path, column, unit or "s", notes)
    if selection.clock == STATED:
        return _by_stated_rate(table, path)
    name, notes = clock, []
    if name is None:
        if table.rates:
            return _by_stated_rate(table, path)
        raise _no_clock(table, path)
    if units.get(name) and not is_time_unit(units[name]) and selection.time_unit is None:
        raise UnreadableData(
            f"{path}: time {name!r}: {units[name]} cannot be converted to s; use --time-unit UNIT, --time COLUMN for "
            "another column, or --rate HZ"
        )
    if _counts_rows(table, name, units) and table.rates and selection.time_unit is None and selection.clock is None:
        return _by_stated_rate(table, path)
    factor = Fraction(1)
    if table.tick_hz and not units.get(name) and selection.time_unit is None:
        unit, factor = "s", 1 / Fraction(table.tick_hz)
        notes.append(f"the time {name!r} counts ticks of {table.tick_hz:.12g} Hz, as the file states")
    else:
        unit = find_time_unit(table, path, name, selection.time_unit, units, notes)
    column = MappedColumn(name, factor, 0.0, unit, f"{name_without_unit(name)} [{unit}]", None)
    time_base = _from_column(table, path, column, unit, notes)
    if table.rates and selection.clock is None and selection.time_unit is None:
        _require_agreement(table, path, name, time_base)
    return time_base


def is_from_recording(table: Table) -> bool:
    """Whether a table has a recording's ticks and deadlines: then no mapping is needed."""
    return set(RECORDING_TIME_COLUMNS) <= table.columns.keys()


def _counted(table: Table, rate_hz: float, description: str, notes: list[str]) -> TimeBase:
    deadlines = np.rint(np.arange(row_count(table)) * (1e9 / rate_hz))
    return TimeBase(deadlines, rate_hz, description, notes, None)


def _by_stated_rate(table: Table, path: Path) -> TimeBase:
    """Return even times at the rate that the file states. Raises AmbiguousData for several rates."""
    if len(table.rates) > 1:
        readings = [Reading(f"--rate {hz:g}", f"the file states {words!r}") for hz, words in table.rates]
        raise ask(path, "the file states several sample rates", *readings)
    if not table.rates:
        raise UnreadableData(f"{path}: the file states no sample rate; give it with --rate HZ")
    hz, words = table.rates[0]
    if not LOWEST_RATE_HZ <= hz <= HIGHEST_RATE_HZ:
        raise UnreadableData(
            f"{path}: the file states {words!r}, a rate of {hz:g} Hz; allowed: {LOWEST_RATE_HZ:g} to "
            f"{HIGHEST_RATE_HZ:g} Hz. Give another one with --rate HZ"
        )
    return _counted(table, hz, f"the rate that the file states, {words!r}", [])


def _no_clock(table: Table, path: Path) -> UnreadableData:
    """Return the error of a file without a clock; a question where an unnamed first column may be one."""
    name = next(iter(table.columns))
    values = table.columns[name]
    if name in table.unnamed and len(table.columns) > 1 and grows_evenly(values) and not _is_counter(values):
        return ask(
            path,
            f"the first column has no name and grows evenly, from {values[0]:g} by {values[1] - values[0]:.6g}: a "
            "clock, or a signal",
            Reading(f"--clock {name} --time-unit s", f"a clock in s: {1 / np.median(np.diff(values)):.9g} Hz"),
            Reading("--rate HZ", f"{name} is a signal, sampled at HZ"),
        )
    return UnreadableData(
        f"{path}: no column of times found; select one with --time COLUMN, or give the rate with --rate HZ"
    )


def clock_column(table: Table, path: Path, selection: ColumnSelection, units: Mapping[str, str | None]) -> str | None:
    """Return the name of the column of times; None without one.

    It is that of `selection`, a recording's deadlines, or the only column that is declared or named as times, or grows
    in a unit of time; of several, the first, if all agree. Raises AmbiguousData for clocks that disagree.
    """
    if is_from_recording(table):
        return RECORDING_TIME_COLUMNS[1]
    if selection.clock not in (None, STATED):
        if table.time is not None and selection.clock == table.about.get("group"):
            return table.time
        return find_column(table, path, selection.clock)
    clocks = _clocks(table, units)
    growing = [name for name in clocks if _grows(table.columns[name])]
    is_asked = selection.rate_hz is None and selection.time is None
    for name in growing[1:] if is_asked else ():
        if not _agree(table, growing[0], name, units):
            readings = [Reading(f"--clock {clock!r}", _span_text(table, clock, units)) for clock in growing]
            raise ask(path, "several columns hold times, which disagree", *readings)
    return next(iter(growing or clocks), None)


def _clocks(table: Table, units: Mapping[str, str | None]) -> list[str]:
    """Return the columns that may be the clock: the declared one, those named as times, and growing ones in a unit of
    time.
    """
    names = sorted(filter(is_time_name, table.columns), key=lambda name: TIME_NAMES.index(bare_name(name)))
    measured = [
        name
        for name, values in table.columns.items()
        if is_time_unit(units.get(name)) and _grows(values) and len(table.columns) > 1 and not is_counter_name(name)
    ]
    measured += [name for name in table.columns if units.get(name) is None and _is_epoch(table, name)]
    declared = [] if table.time is None else [table.time]
    return [
        *dict.fromkeys([*declared, *(n for n in names if units.get(n) is None or is_time_unit(units[n])), *measured])
    ]


def _is_epoch(table: Table, name: str) -> bool:
    """Whether a column grows, by whole numbers or fractions of s, and begins as a time since 1970 does."""
    values = table.columns[name]
    begin = abs(table.origins.get(name, 0) + float(values[0])) if values.size else 0.0
    return _grows(values) and any(EPOCH_S[0] <= begin * factor <= EPOCH_S[1] for factor in EPOCH_UNITS.values())


def _grows(times: Real) -> bool:
    with np.errstate(invalid="ignore"):
        return (
            times.size > 1
            and bool(np.all(np.diff(times[np.isfinite(times)]) > 0))
            and bool(np.isfinite(times).sum() > 1)
        )


def _agree(table: Table, first: str, second: str, units: Mapping[str, str | None]) -> bool:
    """Whether two clocks span the same time; a clock without a unit may be in s, ms, µs or ns."""
    spans = [_seconds(units.get(name)) * float(np.ptp(_finite(table.columns[name]))) for name in (first, second)]
    factors = [1.0] if units.get(first) and units.get(second) else [1e-9, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e9]
    return any(abs(spans[0] * factor - spans[1]) <= CLOCK_TOLERANCE * spans[1] for factor in factors)


def _seconds(unit: str | None) -> float:
    return float(factor_between(unit, "s")) if unit and is_time_unit(unit) else 1.0


def _finite(values: Real) -> Real:
    return values[np.isfinite(values)]


def _span_text(table: Table, clock: str, units: Mapping[str, str | None]) -> str:
    times = _finite(table.columns[clock])
    unit = units.get(clock) or ""
    return (
        f"{table.origins.get(clock, 0) + times[0]:.12g} … {table.origins.get(clock, 0) + times[-1]:.12g} {unit}".strip()
    )


def _is_counter(values: Real) -> bool:
    return values.size > 1 and bool(np.all(np.diff(values) == 1))


def _counts_rows(table: Table, name: str, units: Mapping[str, str | None]) -> bool:
    return units.get(name) is None and _is_counter(table.columns[name])


def find_time_unit(
    table: Table, path: Path, name: str, given: str | None, units: Mapping[str, str | None], notes: list[str]
) -> str:
    """Return the unit of a column of times; an assumption is added to `notes`.

    It is the given one, the file's, or by the size of times since 1970; fractions of a second are assumed from
    USUAL_RATE_HZ on. Raises AmbiguousData where several units are possible.
    """
    unit, times = units.get(name), table.columns[name]
    if given is not None:
        if unit and unit != given:
            notes.append(f"the time {name!r} has the unit {unit} in the file; {given} is used")
        return given
    if unit:
        return unit
    known = _finite(times)
    if known.size < 2:
        return "s"
    begin = table.origins.get(name, 0) + known[0]
    step = float(np.ptp(known)) / (known.size - 1)
    sizes = [unit for unit, factor in EPOCH_UNITS.items() if EPOCH_S[0] <= begin * factor <= EPOCH_S[1]]
    if sizes and step * _seconds(sizes[0]) * LEAST_EPOCH_RATE_HZ <= 1:
        notes.append(f"the time {name!r} has no unit; by their size, the values count {sizes[0]} since 1970")
        return sizes[0]
    rates = {unit: 1 / (step * _seconds(unit)) for unit in ("s", "ms", "µs", "ns", "d") if step > 0}
    rates = {unit: hz for unit, hz in rates.items() if LOWEST_RATE_HZ <= hz <= HIGHEST_RATE_HZ * 1.001}
    stated = [unit for unit, hz in rates.items() if any(abs(hz - rate) <= 0.01 * rate for rate, _ in table.rates)]
    if len(stated) == 1:
        notes.append(f"the time {name!r} has no unit; {stated[0]} agrees with {table.rates[0][1]!r}")
        return stated[0]
    is_day = "d" in rates and any(low <= begin <= high for low, high in DAY_NUMBERS)
    if "s" in rates and rates["s"] >= USUAL_RATE_HZ and not is_day:
        notes.append(f"the time {name!r} has no known unit; s is assumed")
        return "s"
    readings = [
        Reading(f"--time-unit {unit}", f"{hz:.9g} Hz") for unit, hz in rates.items() if unit != "d" or begin > 1e4
    ]
    if "s" not in rates:
        in_s = 1 / step if step > 0 else np.inf
        question = (
            f"the times {name!r} in s give a rate of {in_s:g} Hz; allowed: {LOWEST_RATE_HZ:g} to {HIGHEST_RATE_HZ:g} "
            "Hz; they have no unit"
        )
    else:
        question = f"the times {name!r}, {begin:.12g} to {begin + np.ptp(known):.12g}, have no unit"
    raise ask(path, question, *readings, Reading("--rate HZ", f"{name} is no clock, and the rows are sampled at HZ"))


def _require_agreement(table: Table, path: Path, name: str, time_base: TimeBase) -> None:
    """Raise AmbiguousData if the file states another rate than its times give."""
    others = [(hz, words) for hz, words in table.rates if abs(hz - time_base.rate_hz) > 0.01 * hz]
    if len(others) == len(table.rates):
        hz, words = others[0]
        raise ask(
            path,
            f"the times {name!r} give {time_base.rate_hz:g} Hz, and the file states {words!r}, which is {hz:g} Hz",
            Reading(f"--clock {name!r}", f"{time_base.rate_hz:g} Hz, by the times"),
            Reading(f"--clock {STATED}" if len(table.rates) == 1 else f"--rate {hz:g}", f"{hz:g} Hz, by the statement"),
        )


def _from_column(table: Table, path: Path, column: MappedColumn, unit: str, notes: list[str]) -> TimeBase:
    """Return the times of a mapped column in `unit`; `notes` are those on its unit."""
    if table.columns[column.name].size < 2:
        raise UnreadableData(f"{path}: fewer than two samples; give the rate with --rate HZ")
    description = column.description
    if not column.unit:
        description = f"{name_without_unit(column.name)} [{unit}]{description.removeprefix(column.name)}"
    times = column.values(table)
    if origin := table.origins.get(column.name):
        notes = [*notes, f"the file's time begins at {origin} {unit}; this becomes 0 in the recording"]
    deadlines, conversion_notes = _deadlines_ns(path, column.name, times, unit)
    period_ns, jitter, gaps = _regularity(deadlines)
    measured_rate_hz = _rate_hz(deadlines, period_ns)
    factor = _seconds(unit) * 1e9
    grid = even_times(times, [1 / (hz * _seconds(unit)) for hz, _ in table.rates]) if jitter else None
    if grid is not None and grid.resolution * factor > ROUNDED_NS and not is_from_recording(table):
        deadlines = np.rint(deadlines[0] + (grid.times - times[0]) * factor)
        deadlines -= min(deadlines[0], 0)
        measured_rate_hz = float(f"{1e9 / (grid.period * factor):.9g}")
        jitter = [
            f"the times are rounded to {grid.resolution:g} {unit}; even samples at {measured_rate_hz:g} Hz "
            f"(± {100 * grid.doubt:.2g} %) fit within it, and replace them"
        ]
    if not LOWEST_RATE_HZ <= measured_rate_hz <= HIGHEST_RATE_HZ:
        raise UnreadableData(
            f"{path}: the times {column.name!r} in {unit} give a rate of {measured_rate_hz:g} Hz; allowed: "
            f"{LOWEST_RATE_HZ:g} to {HIGHEST_RATE_HZ:g} Hz. Give another unit with --time "
            f"'{name_without_unit(column.name)} [ms]', or the rate with --rate HZ"
        )
    all_notes = [*notes, *conversion_notes, *jitter, *gaps]
    return TimeBase(deadlines, measured_rate_hz, description, all_notes, column.name)


class EvenTimes(NamedTuple):
    """Even times (rows,), gaps left out, whose rounding to `resolution` gives the file's times.

    `doubt` is the share by which the period may be wrong.
    """

    times: Real
    period: float
    resolution: float
    doubt: float


def even_times(times: Real, stated_periods: Sequence[float] = ()) -> EvenTimes | None:
    """Return even times that differ from `times` by no more than their rounding; None where none do.

    The times are rounded to a decimal, or to a number of digits. Of all periods that fit, it is a stated one, or the
    one whose rate or itself has the fewest digits.
    """
    steps = np.diff(times)
    median = float(np.median(steps))
    if median <= 0 or times.size < FEWEST_ROUNDED:
        return None
    mean = float(np.mean(steps[steps < GAP_PERIODS * median]))
    counts = np.append(0.0, np.cumsum(np.maximum(np.rint(steps / mean), 1)))
    resolution = _resolution(times)
    for widths in (None if resolution is None else np.full(times.size, resolution), _digit_widths(times)):
        if widths is None:
            continue
        half = widths / 2
        least, largest = _fitting_periods(times, counts, half)
        if largest < least:
            continue
        rounded = [(_roundest(1 / largest, 1 / least), 0), (_roundest(least, largest), 1)]
        (_, value), is_period = min(rounded, key=lambda entry: (entry[0][0], entry[1]))
        stated = [period for period in stated_periods if least <= period <= largest]
        period = stated[0] if stated else value if is_period else 1 / value
        rest = times - counts * period
        begin = min(max(float(times[0]), float((rest - half).max())), float((rest + half).min()))
        return EvenTimes(counts * period + begin, period, float(widths.max()), (largest - least) / 2 / period)
    return None


def _fitting_periods(times: Real, counts: Real, half: Real) -> tuple[float, float]:
    """Return the least and the largest period of even times within `half` of `times`; (1, 0) without one."""

    def excess(period: float) -> float:
        rest = times - counts * period
        return float((rest - half).max() - (rest + half).min())

    middle = float(times[-1] - times[0]) / float(counts[-1])
    reach = 4 * float(half.max()) / float(counts[-1])
    low, high = middle - reach, middle + reach
    for _ in range(BISECTIONS):  # the excess is convex in the period
        third = (high - low) / 3
        low, high = (low, high - third) if excess(low + third) < excess(high - third) else (low + third, high)
    best, limit = (low + high) / 2, 2e-6 * float(half.max())
    if excess(best) > limit:
        return 1.0, 0.0
    bounds = []
    for outer in (middle - 2 * reach, middle + 2 * reach):
        inner = best
        for _ in range(BISECTIONS):
            trial = (inner + outer) / 2
            inner, outer = (trial, outer) if excess(trial) <= limit else (inner, trial)
        bounds.append(inner)
    return bounds[0], bounds[1]


def _digit_widths(times: Real) -> Real | None:
    """Return the unit of the last digit of each time, if all have no more than MOST_DIGITS digits; else None."""
    size = np.abs(times)
    exponents = np.floor(np.log10(np.where(size > 0, size, size[size > 0].min(initial=1.0))))
    for digits in range(3, MOST_DIGITS + 1):
        units = 10.0 ** (exponents - digits + 1)
        if np.all(np.abs(times / units - np.rint(times / units)) <= 1e-4):
            return units
    return None


def _roundest(low: float, high: float) -> tuple[int, float]:
    """Return the number from `low` to `high` that has the fewest digits, behind their count."""
    for digits in range(1, 13):
        unit = 10.0 ** (np.floor(np.log10(high)) - digits + 1)
        value = float(f"{np.rint((low + high) / 2 / unit) * unit:.{digits + 2}g}")
        if low <= value <= high:
            return digits, value
    return 13, (low + high) / 2


def _resolution(times: Real) -> float | None:
    """Return the unit of the last decimal of rounded numbers; None for numbers that use all their digits."""
    largest = float(np.abs(times).max())
    for decimals in range(13):
        scaled = times * 10.0**decimals
        if largest * 10.0**decimals * np.finfo(float).eps > 1e-3:
            return None
        if np.all(np.abs(scaled - np.rint(scaled)) <= 1e-3):
            return 10.0**-decimals
    return None


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
        fault = (
            f"time {name!r} does not grow from row {row + 1} ({times[row]:g} {unit}) to row {row + 2} "
            f"({times[row + 1]:g} {unit})"
        )
        resolution, rate = (
            _resolution(times),
            (times.size - 1) / max(float(np.ptp(times)) * float(factor) * 1e-9, 1e-12),
        )
        rest = times - np.arange(times.size) * float(np.ptp(times)) / max(times.size - 1, 1)
        if resolution and np.diff(times).min() == 0 and resolution < np.ptp(times) and np.ptp(rest) <= 2 * resolution:
            even = Reading(
                f"--rate {rate:.6g}", f"even samples, with times rounded to {resolution:g} {unit}, if all are there"
            )
            raise ask(path, fault, even, Reading("--time COLUMN", "another column has the times"))
        raise UnreadableData(f"{path}: {fault}; use --time COLUMN for another column, or --rate HZ")
    if deadlines[-1] > LARGEST:
        raise UnreadableData(
            f"{path}: time {name!r} spans {np.ptp(times):g} {unit}; allowed: up to {LARGEST * 1e-9:.2g} s. Give "
            f"another unit with --time '{name_without_unit(name)} [ms]', or the rate with --rate HZ"
        )
    return deadlines, notes


def _rate_hz(deadlines: Real, period_ns: float) -> float:
    """Return the rate in Hz: by the mean period if all are near the median `period_ns`, else by it."""
    is_even = bool(np.all(np.abs(np.diff(deadlines) - period_ns) <= max(ROUNDED_NS, JITTER_TOLERANCE * period_ns)))
    period_ns = float(deadlines[-1] - deadlines[0]) / (deadlines.size - 1) if is_even else period_ns
    return float(f"{1e9 / period_ns:.9g}")


def _regularity(deadlines: Real) -> tuple[float, list[str], list[str]]:
    """Return the median period in ns, and notes on jitter and on missing samples, [] for even samples."""
    intervals = np.diff(deadlines)
    period, jitter, gaps = float(np.median(intervals)), list[str](), list[str]()
    regular_intervals = intervals[intervals < GAP_PERIODS * period]
    deviation = np.abs(regular_intervals - period)
    if deviation.size and deviation.max() > max(JITTER_TOLERANCE * period, ROUNDED_NS):
        rms = float(np.sqrt(np.mean(deviation**2)))
        jitter.append(
            f"sample times jitter: the periods deviate by {rms / 1e3:.3g} µs rms, {deviation.max() / 1e3:.3g} µs at "
            f"most, from the median of {period / 1e3:.6g} µs; the import keeps the times as recorded"
        )
    gap_indices = np.flatnonzero(intervals >= GAP_PERIODS * period)
    if gap_indices.size:
        samples = int(np.sum(np.rint(intervals[gap_indices] / period) - 1))
        first_gap_text = f"the first after {deadlines[gap_indices[0]] * 1e-9:.6g} s"
        gaps.append(
            f"about {count_text(samples, 'sample')} missing, in {count_text(gap_indices.size, 'gap')}, {first_gap_text}"
        )
    return period, jitter, gaps
