"""Summary of a recording in figures: one pass over its chunks, with memory independent of its length."""

from __future__ import annotations

import math
import tomllib
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.run_readers import RecordingPaths, ReportTicks, find_files, missing_parts, open_run
from rtloop.recording.file.topics.events import COMMANDS, RECOVERED
from rtloop.recording.file.topics.format import AroundEvents, CutOrigin, Header, ImportOrigin
from rtloop.recording.file.topics.overview import MAXIMUM, MINIMUM, uncovered_ranges
from rtloop.recording.views.histogram import TimeHistogram
from rtloop.recording.views.motion import Motion
from rtloop.signals import DEADLINE, Flag, Mode

MEASURED_TIMES = ("lateness_us", "exec_us", "read_us", "law_us", "write_us")
COMMON = ("tick", "deadline_ns", "periods_missed", "flags", "mode", *MEASURED_TIMES)
LIMIT_FLAGS = {"command": Flag.COMMAND_LIMITED, "drive": Flag.DRIVE_LIMITED, "slew": Flag.SLEW_LIMITED}
PROGRESS_TICKS = 1 << 18
"""Number of ticks after which the progress is reported."""


@dataclass(frozen=True)
class AxisSummary:
    """Figures of one axis; the RMS error counts closed-loop ticks, None if the loop was never closed.

    `max_abs_drive_v` counts all ticks; None if the recording has no drive of the axis.
    """

    name: str
    rms_error_um: float | None
    max_abs_drive_v: float | None
    settled_within_um: float | None = None
    """Tolerance band (µm) from the configuration; None if it states none."""
    settled_percent: float | None = None
    """Percentage of closed-loop ticks with |error| ≤ `settled_within_um`; None without band or closed-loop tick."""
    opposed: bool = False
    """Whether the position fell as the drive rose, in a loop that tripped: the sign of a wire or scale may be wrong."""


@dataclass(frozen=True)
class ValueRange:
    """Least and largest value of a signal; None where it has no number."""

    name: str
    unit: str
    least: float | None
    largest: float | None


@dataclass(frozen=True)
class TripSummary:
    """Trip of the loop: its tick, its causes and the reason as text, None without one."""

    tick: int
    causes: list[str]
    reason: str | None


@dataclass(frozen=True)
class Summary:
    """Contents of `rtloop info --json`. Times and figures derived from them are None for a run without timing."""

    recording: str
    parts: list[str]
    name: str | None
    ticks_expected: int | None
    cut: CutOrigin | None
    """Origin of a cut recording: range (`first`, `end`) of the original `files`; None for an uncut one."""
    ticks_logged: int
    ticks_lost: int
    around: AroundEvents | None
    """Settings of a recording around events: `before_s`, `after_s`, `on`, `every_s`; None if it has every tick."""
    stretches: int
    """Number of tick ranges recorded at the full rate."""
    ticks_skipped: int
    """Number of ticks omitted by intention."""
    periods_missed: int
    rate_hz: float
    achieved_rate_hz: float | None
    duration_s: float
    paced: bool
    overruns: int
    ticks_limited: dict[str, int]
    """Number of ticks with a limited `command`, `drive` and `slew`, by these keys."""
    saturated_percent: float | None
    """Percentage of closed-loop ticks that limited a command or drive; None if the loop was never closed."""
    lateness_us: dict[str, float] | None
    """Quantiles and maximum {p50, p99, p999, max} in µs."""
    lateness_histogram: list[dict[str, float | None]]
    """Number of ticks by lateness, as `TimeHistogram.class_counts`; [] without timing."""
    exec_us: dict[str, float] | None
    """Quantiles and maximum {p50, p99, p999, max} in µs."""
    phases: dict[str, float | None]
    """Median durations (µs) of the phases of a tick, read_us, law_us and write_us; None without timing."""
    complete: bool
    result: str | None
    driver_error: str | None
    problems: list[str]
    realtime: Mapping[str, object] | None
    host: Mapping[str, object] | None
    axes: list[AxisSummary]
    imported: ImportOrigin | None
    """Source file and import settings of signals from another program; None for a recording by rtloop."""
    ranges: list[ValueRange]
    """Least and largest value of each imported signal."""
    trips: list[TripSummary]
    commands: dict[str, int]
    """Number of commands by sender, most frequent first."""
    events: int
    size_bytes: int
    bytes_per_tick: float | None

    def as_dict(self) -> dict[str, object]:
        """Summary as a dict, keys as the fields; axes, ranges and trips are dicts. NaN and infinity stay floats."""
        return asdict(self)


class AxisTotals:
    """Tracking error over closed-loop ticks and the largest drive of one axis."""

    def __init__(self, name: str, settled_within_um: float | None) -> None:
        """Begin with no ticks; `settled_within_um` is the tolerance band of the error in µm, None for none."""
        self.name, self._band_um = name, settled_within_um
        self._square_sum, self._count, self._settled_ticks, self._drive = 0.0, 0, 0, 0.0
        self._motion = Motion()

    def add(self, column: dict[str, Real], is_closed_loop: npt.NDArray[np.bool_] | None) -> None:
        """Add a block, arrays (n,) by column name; imported signals may lack error or drive.

        Mask `is_closed_loop` (n,) is None without a column of modes: then only the drive counts.
        """
        error_um, drive_v = column.get(f"{self.name}_error_um"), column.get(f"{self.name}_drive_v")
        if error_um is not None and is_closed_loop is not None:
            errors = error_um[is_closed_loop]
            self._square_sum += float(errors @ errors)
            self._count += len(errors)
            if self._band_um is not None:
                self._settled_ticks += int(np.count_nonzero(np.abs(errors) <= self._band_um))
        if drive_v is not None:
            self._drive = max(self._drive, float(np.abs(drive_v).max()))
            position_um = column.get(f"{self.name}_position_um")
            if position_um is not None and is_closed_loop is not None:
                self._motion.add(drive_v[is_closed_loop], position_um[is_closed_loop])

    def summary(self, columns: Sequence[str], tripped: bool) -> AxisSummary:
        """Return the figures of the axis; the drive is None if `columns` lacks it.

        `tripped`: the loop tripped; only then can `opposed` be True.
        """
        rms_um = math.sqrt(self._square_sum / self._count) if self._count else None
        drive_v = self._drive if f"{self.name}_drive_v" in columns else None
        settled = 100 * self._settled_ticks / self._count if self._count and self._band_um is not None else None
        opposed = tripped and self._motion.ran_away_opposed()
        return AxisSummary(self.name, rms_um, drive_v, self._band_um, settled, opposed)


class SignalExtremes:
    """The least and the largest number of each signal."""

    def __init__(self, units: dict[str, str]) -> None:
        """Begin with no values of the signals whose names are the keys of `units`."""
        self._units = units
        self._extremes = {name: (math.inf, -math.inf) for name in units}

    def add(self, column: dict[str, Real]) -> None:
        """Add a block: `column` maps names to arrays (n,), n ≥ 1, and must have every signal of `units`.

        Other columns and NaN are ignored.
        """
        for name, (minimum, maximum) in self._extremes.items():
            low, high = np.fmin.reduce(column[name]), np.fmax.reduce(column[name])
            self._extremes[name] = float(np.fmin(minimum, low)), float(np.fmax(maximum, high))

    def summary(self) -> list[ValueRange]:
        """Return the value range of each signal; both ends are None if it was always NaN."""
        return [
            ValueRange(name, self._units[name], *(extremes if extremes[0] <= extremes[1] else (None, None)))
            for name, extremes in self._extremes.items()
        ]


class RecordingTotals:
    """Sums, counts and histograms over the ticks of a recording."""

    def __init__(self, bands_um: dict[str, float | None], imported_units: dict[str, str]) -> None:
        """Begin with no ticks of the axes in `bands_um`, with their `settled_within_um` (None: none is configured).

        `imported_units` maps each imported signal to its unit.
        """
        self.ticks, self.overruns, self.periods_missed = 0, 0, 0
        self.closed_ticks, self.saturated_ticks = 0, 0
        self.limited_ticks = dict.fromkeys(LIMIT_FLAGS, 0)
        self.first: tuple[float, float] | None = None
        self.last = (0.0, 0.0)
        self.histograms = {name: TimeHistogram() for name in MEASURED_TIMES}
        self.axes = [AxisTotals(name, band_um) for name, band_um in bands_um.items()]
        self.extremes = SignalExtremes(imported_units)

    def add(self, column: dict[str, Real]) -> None:
        """Add the next ticks, arrays (n,) by column name, n ≥ 1.

        `tick`, `deadline_ns` and every imported signal must be there; other columns may be missing.
        """
        self.ticks += len(column["tick"])
        self.first = self.first or (float(column["tick"][0]), float(column["deadline_ns"][0]))
        self.last = float(column["tick"][-1]), float(column["deadline_ns"][-1])
        if "periods_missed" in column:
            self.periods_missed += int(column["periods_missed"].sum())
        flags = column["flags"].astype(np.int64) if "flags" in column else np.zeros(0, np.int64)
        has_flags = bool(flags.any())
        if has_flags:
            self.overruns += int(np.count_nonzero(flags & Flag.OVERRUN))
            for name, flag in LIMIT_FLAGS.items():
                self.limited_ticks[name] += int(np.count_nonzero(flags & flag))
        for name in self.histograms.keys() & column.keys():
            self.histograms[name].add(column[name])
        is_closed_loop = column["mode"] == Mode.CLOSED_LOOP if "mode" in column else None
        if is_closed_loop is not None and flags.size:
            self.closed_ticks += int(np.count_nonzero(is_closed_loop))
            if has_flags:
                saturated = flags[is_closed_loop] & (Flag.COMMAND_LIMITED | Flag.DRIVE_LIMITED)
                self.saturated_ticks += int(np.count_nonzero(saturated))
        with np.errstate(over="ignore", invalid="ignore"):  # A recording may hold any double.
            for axis in self.axes:
                axis.add(column, is_closed_loop)
            self.extremes.add(column)

    @property
    def ticks_spanned(self) -> int:
        """Last minus first tick number, whether the ticks between are in the recording or not; 0 without ticks."""
        return int(self.last[0] - self.first[0]) if self.first else 0

    @property
    def span_s(self) -> float:
        """Time in s from the first to the last deadline; 0 without ticks."""
        return (self.last[1] - self.first[1]) / 1e9 if self.first else 0.0


def summarise(path: RecordingPaths, progress: ReportTicks | None = None) -> Summary:
    """Summarise a recording, or all files of a rotated run, in one pass; damage is listed in `problems`.

    `progress` receives the number of ticks read. Raises RecordingError if a file is missing or no recording, is given
    twice, or belongs to another run.
    """
    with open_run(find_files(path)) as readers:
        totals = _sum_ticks(readers, progress)
        for reader in readers:
            deque(reader.snapshots(), maxlen=0)  # Reading the snapshots reports their damage.
        return _make_summary(readers, totals)


def _is_seamless(end: Mapping[str, Any] | None) -> bool:
    """Whether a file has no loss by its totals `end`: it is complete, or it was recovered and its `gaps` are empty.

    False for None, an unfinished file.
    """
    return end is not None and (end["complete"] or (end["result"] == RECOVERED and not end.get("gaps", True)))


def _overview_span_s(readers: Sequence[Reader], totals: RecordingTotals) -> float:
    """Time in s from the first to the last deadline of ticks and overviews; 0 without overviews or without ticks."""
    deadlines = [reader.overview[:, DEADLINE] for reader in readers if len(reader.overview)]
    if not deadlines or totals.first is None:
        return 0.0
    first, last = deadlines[0][0, MINIMUM], deadlines[-1][-1, MAXIMUM]
    return float(max(last, totals.last[1]) - min(first, totals.first[1])) / 1e9


def _make_summary(readers: Sequence[Reader], totals: RecordingTotals) -> Summary:
    """Return the summary of a run from `readers`, its files in order of the run, and `totals` over their ticks."""
    header, rate_hz = readers[0].header, float(readers[0].header["rate_hz"])
    events = [event for reader in readers for event in reader.events]
    ends = [reader.totals for reader in readers]
    end_totals = ends[-1]
    executed = end_totals["ticks_executed"] if end_totals else int(totals.last[0]) + 1 if totals.first else 0
    begin, skipped = (
        header.get("first_tick", 0),
        [tick_range for reader in readers for tick_range in reader.skipped_ranges],
    )
    executed = max([executed, *(first + count for first, count in skipped)])
    ticks_skipped = sum(count for _, count in skipped)
    lost = executed - begin - totals.ticks - ticks_skipped
    problems = [*missing_parts(readers), *(problem for reader in readers for problem in reader.problems)]
    is_complete = (
        bool(end_totals and end_totals["complete"]) and all(map(_is_seamless, ends)) and lost == 0 and not problems
    )
    reports = {name: histogram.report() for name, histogram in totals.histograms.items()}
    phases = {name: reports[name] for name in MEASURED_TIMES[2:]}
    size_bytes = sum(reader.size_bytes for reader in readers)
    trips = [
        TripSummary(event["tick"], event["what"]["causes"], event["what"].get("reason"))
        for event in events
        if event["kind"] == "tripped"
    ]
    return Summary(
        recording=str(readers[0].path),
        parts=[str(reader.path) for reader in readers],
        name=header.get("name"),
        ticks_expected=header.get("ticks_expected"),
        cut=header.get("cut"),
        ticks_logged=totals.ticks,
        ticks_lost=lost,
        around=header.get("around"),
        stretches=len(uncovered_ranges(begin, executed, skipped)),
        ticks_skipped=ticks_skipped,
        periods_missed=totals.periods_missed,
        rate_hz=rate_hz,
        achieved_rate_hz=totals.ticks_spanned / totals.span_s if totals.span_s else None,
        duration_s=max(totals.span_s, _overview_span_s(readers, totals)) + 1 / rate_hz if totals.ticks else 0.0,
        paced=header["paced"],
        overruns=totals.overruns,
        ticks_limited=totals.limited_ticks,
        saturated_percent=100 * totals.saturated_ticks / totals.closed_ticks if totals.closed_ticks else None,
        lateness_us=reports["lateness_us"],
        lateness_histogram=totals.histograms["lateness_us"].class_counts(),
        exec_us=reports["exec_us"],
        phases={name: None if report is None else report["p50"] for name, report in phases.items()},
        complete=is_complete,
        result=end_totals["result"] if end_totals else None,
        driver_error=end_totals.get("driver_error") if end_totals else None,
        problems=problems,
        realtime=header.get("realtime"),
        host=header.get("host"),
        axes=[axis.summary(readers[0].columns, bool(trips)) for axis in totals.axes],
        imported=header.get("imported"),
        ranges=totals.extremes.summary(),
        trips=trips,
        commands=dict(Counter(event["who"] for event in events if event["kind"] in COMMANDS).most_common()),
        events=len(events),
        size_bytes=size_bytes,
        bytes_per_tick=size_bytes / totals.ticks if totals.ticks else None,
    )


def _bands_um(header: Header) -> dict[str, float | None]:
    """Map each axis to its `settled_within_um` (µm) in the recorded configuration; None for an axis without it."""
    bands_um: dict[str, float | None] = dict.fromkeys(header["axes"])
    with suppress(tomllib.TOMLDecodeError, TypeError, AttributeError):
        for axis in tomllib.loads(header.get("configuration") or "").get("axis", ()):
            band_um = axis.get("limits", {}).get("settled_within_um")
            if axis.get("name") in bands_um and isinstance(band_um, int | float):
                bands_um[axis["name"]] = float(band_um)
    return bands_um


def _sum_ticks(readers: Sequence[Reader], progress: ReportTicks | None) -> RecordingTotals:
    """Sum up all ticks of all files, chunk by chunk; `progress` receives the number of ticks summed up."""
    header, axes = readers[0].header, readers[0].header["axes"]
    totals = RecordingTotals(_bands_um(header), header["imported"]["units"] if "imported" in header else {})
    names = [*COMMON, *(f"{axis}_{signal}" for axis in axes for signal in ("error_um", "drive_v", "position_um"))]
    if "imported" in header:
        names = [*readers[0].columns]
    for rows in (rows for reader in readers for rows in reader.blocks(names)):
        ticks_before = totals.ticks
        totals.add(dict(zip(names, rows.T, strict=True)))
        if progress and ticks_before // PROGRESS_TICKS < totals.ticks // PROGRESS_TICKS:
            progress(totals.ticks)
    return totals
