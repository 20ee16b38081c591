"""Counts of measured times, from which quantiles are read, in memory that does not grow with their number."""

from __future__ import annotations

import math

import numpy as np

from rtloop.foundation.arrays import Real

NS_PER_US = 1000.0
NO_TIME_US = 1e15
"""Limit of a time: about thirty years, longer than any run."""
CLASSES_US = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)


class TimeHistogram:
    """Counts of times in whole nanoseconds; beyond `LINEAR_NS` in steps of 2⁻¹² of their size."""

    LINEAR_NS = 1 << 20
    STEPS = 1 << 12

    def __init__(self) -> None:
        """Begin without any counted time."""
        self._counts = np.zeros(self.LINEAR_NS, np.int64)
        self._large: dict[int, int] = {}
        self._maximum = -math.inf

    def add(self, values_us: Real) -> None:
        """Count values in µs; NaN and values of NO_TIME_US or more are ignored, negative ones count as 0.

        Values are rounded to whole ns, from LINEAR_NS on down to steps of 2⁻¹² of their size; the maximum is exact.
        """
        if not len(values_us) or not values_us.max() < NO_TIME_US:
            values_us = values_us[values_us < NO_TIME_US]
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

    def _add_large(self, ns: Real) -> None:
        """Count times of LINEAR_NS or more, rounded down to steps of 2⁻¹² of their size."""
        fraction, exponent = np.frexp(ns)
        rounded = np.ldexp(np.floor(fraction * 2 * self.STEPS) / (2 * self.STEPS), exponent)
        for value, count in zip(*np.unique(rounded, return_counts=True), strict=True):
            self._large[int(value)] = self._large.get(int(value), 0) + int(count)

    def quantiles_us(self, *quantiles: float) -> list[float | None]:
        """Quantiles in µs, one for each fraction of `quantiles`; None for each without values.

        A quantile is the smallest value that at least this fraction of the values does not exceed.
        """
        small, large = np.flatnonzero(self._counts), sorted(self._large.items())
        values = np.concatenate([small, np.array([value for value, _ in large], np.int64)])
        counts = np.concatenate([self._counts[small], np.array([count for _, count in large], np.int64)])
        if not len(values):
            return [None] * len(quantiles)
        cumulative = np.cumsum(counts)
        ranks = [max(math.ceil(quantile * cumulative[-1]), 1) for quantile in quantiles]
        return [float(values[np.searchsorted(cumulative, rank)]) / NS_PER_US for rank in ranks]

    def class_counts(self) -> list[dict[str, float | None]]:
        """Counts by the classes of CLASSES_US, empty ones included, as {below_us, count}; [] without values.

        A class holds times from the bound of the class before up to, not including, `below_us` (None for the last one).
        """
        edges_ns = [round(edge * NS_PER_US) for edge in CLASSES_US]
        small = [int(part.sum()) for part in np.split(self._counts, edges_ns)]
        small[-1] += sum(self._large.values())
        if not sum(small):
            return []
        return [{"below_us": edge, "count": count} for edge, count in zip((*CLASSES_US, None), small, strict=True)]

    def report(self) -> dict[str, float] | None:
        """Return {p50, p99, p999, max} in µs; None without values."""
        p50, p99, p999 = self.quantiles_us(0.5, 0.99, 0.999)
        if p50 is None or p99 is None or p999 is None:
            return None
        return {"p50": p50, "p99": p99, "p999": p999, "max": self._maximum}
