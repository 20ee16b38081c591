"""What a recording holds, in numbers: one pass over its chunks, in memory that does not grow with its length."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.recording.reader import Reader
from rtloop.signals import Flag, Mode

MEASURED = ("lateness_us", "exec_us", "read_us", "law_us", "write_us")
COMMON = ("tick", "deadline_ns", "periods_missed", "flags", "mode", *MEASURED)
NS_PER_US = 1000.0
CLASSES_US = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
BATCH_ROWS = 1 << 18


class Histogram:
    """Counts of times in whole nanoseconds; beyond `LINEAR_NS` in steps of 2⁻¹² of their size."""

    LINEAR_NS = 1 << 20
    STEPS = 1 << 12

    def __init__(self) -> None:
        self._counts = np.zeros(self.LINEAR_NS, np.int64)
        self._large: dict[int, int] = {}
        self._maximum = -math.inf

    def add(self, values_us: np.ndarray[Any, Any]) -> None:
        """Count values in µs; NaN is not counted."""
        if not len(values_us) or np.isnan(values_us.max()):
            values_us = values_us[np.isfinite(values_us)]
        if not len(values_us):
            return
        self._maximum = max(self._maximum, float(values_us.max()))
        ns = np.maximum(values_us, 0.0) * NS_PER_US + 0.5
        large = ns >= self.LINEAR_NS
        if large.any():
            self._add_large(ns[large])
            ns = ns[~large]
        counts = np.bincount(ns.astype(np.int64))
        self._counts[: len(counts)] += counts

    def _add_large(self, ns: np.ndarray[Any, Any]) -> None:
        fraction, exponent = np.frexp(ns)
        rounded = np.ldexp(np.floor(fraction * 2 * self.STEPS) / (2 * self.STEPS), exponent)
        for value, count in zip(*np.unique(rounded, return_counts=True), strict=True):
            self._large[int(value)] = self._large.get(int(value), 0) + int(count)

    def quantiles_us(self, *quantiles: float) -> list[float | None]:
        """The smallest recorded value that at least this share of all values does not exceed."""
        large = sorted(self._large.items())
        values = np.concatenate([np.arange(self.LINEAR_NS), np.array([value for value, _ in large], np.int64)])
        below = np.cumsum(np.concatenate([self._counts, np.array([count for _, count in large], np.int64)]))
        if below[-1] == 0:
            return [None] * len(quantiles)
        ranks = [max(math.ceil(quantile * below[-1]), 1) for quantile in quantiles]
        return [float(values[np.searchsorted(below, rank)]) / NS_PER_US for rank in ranks]

    def classes(self) -> list[dict[str, Any]]:
        """Counts below each of CLASSES_US, and None for the rest; empty where nothing was measured."""
        edges_ns = [round(edge * NS_PER_US) for edge in CLASSES_US]
        small = [int(part.sum()) for part in np.split(self._counts, edges_ns)]
        small[-1] += sum(self._large.values())
        if not sum(small):
            return []
        return [{"below_us": edge, "count": count} for edge, count in zip((*CLASSES_US, None), small, strict=True)]

    def report(self) -> dict[str, float] | None:
        """p50, p99, p999 and max in µs; None where nothing was measured."""
        p50, p99, p999 = self.quantiles_us(0.5, 0.99, 0.999)
        if p50 is None or p99 is None or p999 is None:
            return None
        return {"p50": p50, "p99": p99, "p999": p999, "max": self._maximum}


class AxisSums:
    """Tracking error over closed-loop ticks and the largest drive of one axis."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._square_sum, self._count, self._drive = 0.0, 0, 0.0

    def add(self, error_um: Any, drive_v: Any, closed: Any) -> None:
        """Count a block; `closed` says which ticks ran in closed loop."""
        errors = error_um[closed]
        self._square_sum += float(errors @ errors)
        self._count += len(errors)
        self._drive = max(self._drive, float(np.abs(drive_v).max()))

    def report(self) -> dict[str, Any]:
        """The axis in the summary; no error where the loop was never closed."""
        rms = math.sqrt(self._square_sum / self._count) if self._count else None
        return {"name": self.name, "rms_error_um": rms, "max_abs_drive_v": self._drive}


class Totals:
    """What is summed up over the ticks of a recording."""

    def __init__(self, axes: list[str]) -> None:
        self.ticks, self.overruns, self.periods_missed = 0, 0, 0
        self.first: tuple[float, float] | None = None
        self.last = (0.0, 0.0)
        self.histograms = {name: Histogram() for name in MEASURED}
        self.axes = [AxisSums(name) for name in axes]

    def add(self, column: dict[str, np.ndarray[Any, Any]]) -> None:
        """A block of consecutive ticks, by column."""
        self.ticks += len(column["tick"])
        self.first = self.first or (float(column["tick"][0]), float(column["deadline_ns"][0]))
        self.last = float(column["tick"][-1]), float(column["deadline_ns"][-1])
        self.periods_missed += int(column["periods_missed"].sum())
        self.overruns += int(np.count_nonzero(column["flags"].astype(np.int64) & Flag.OVERRUN))
        for name, histogram in self.histograms.items():
            histogram.add(column[name])
        closed = column["mode"] == Mode.CLOSED_LOOP
        for axis in self.axes:
            axis.add(column[f"{axis.name}_error_um"], column[f"{axis.name}_drive_v"], closed)

    @property
    def span_s(self) -> float:
        """From the first deadline to the last."""
        return (self.last[1] - self.first[1]) / 1e9 if self.first else 0.0


def summarise(path: Path | str) -> dict[str, Any]:
    """The object of `rtloop info --json`, tolerant of damage, which it names. Raises RecordingError."""
    with Reader(path, tolerant=True) as reader:
        totals = _sum_up(reader)
        events, finished = reader.events, reader.totals
        header, rate_hz = reader.header, float(reader.header["rate_hz"])
        executed = finished["ticks_executed"] if finished else int(totals.last[0]) + 1 if totals.first else 0
        lost = executed - header.get("first_tick", 0) - totals.ticks
        reports = {name: histogram.report() for name, histogram in totals.histograms.items()}
        return {
            "recording": str(reader.path),
            "name": header.get("name"),
            "ticks_expected": header.get("ticks_expected"),
            "ticks_logged": totals.ticks,
            "ticks_lost": lost,
            "periods_missed": totals.periods_missed,
            "rate_hz": rate_hz,
            "achieved_rate_hz": (totals.ticks - 1) / totals.span_s if totals.span_s else None,
            "duration_s": totals.span_s + 1 / rate_hz if totals.ticks else 0.0,
            "paced": header["paced"],
            "overruns": totals.overruns,
            "lateness_us": reports["lateness_us"],
            "lateness_histogram": totals.histograms["lateness_us"].classes(),
            "exec_us": reports["exec_us"],
            "phases": {name: report and report["p50"] for name, report in reports.items() if name in MEASURED[2:]},
            "complete": bool(finished and finished["complete"] and lost == 0 and not reader.problems),
            "result": finished["result"] if finished else None,
            "problems": reader.problems,
            "realtime": header.get("realtime"),
            "axes": [axis.report() for axis in totals.axes],
            "trips": [
                {"tick": event["tick"], "causes": event["what"]["causes"]}
                for event in events
                if event["kind"] == "tripped"
            ],
            "events": len(events),
            "size_bytes": reader.size_bytes,
            "bytes_per_tick": reader.size_bytes / totals.ticks if totals.ticks else None,
        }


def _sum_up(reader: Reader) -> Totals:
    axes = reader.header["axes"]
    totals = Totals(axes)
    names = [*COMMON, *(f"{axis}_{signal}" for axis in axes for signal in ("error_um", "drive_v"))]
    batch, fill = np.empty((len(names), BATCH_ROWS)), 0
    for rows in reader.blocks(names):
        if fill + len(rows) > BATCH_ROWS:
            totals.add(dict(zip(names, batch[:, :fill], strict=True)))
            fill = 0
        batch[:, fill : fill + len(rows)] = rows.T
        fill += len(rows)
    if fill:
        totals.add(dict(zip(names, batch[:, :fill], strict=True)))
    return totals
