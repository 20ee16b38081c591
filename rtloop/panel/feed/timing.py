"""Lateness of the ticks of the last minute, for all clients: a histogram for each second, and advice about the host."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from rtloop.client.ticks.tick_stretch import Batch, Stretch
from rtloop.foundation.arrays import Real
from rtloop.panel.protocol.frames import pack_frame
from rtloop.panel.service.service import Description
from rtloop.signals import COMMON_SIGNALS, DEADLINE, EXEC, LATENESS, PERIODS_MISSED

WINDOW_S = 60
FINE_PER_DECADE, SHOWN_PER_DECADE = 100, 10
DECADES = (-1, 6)
"""Exponents of the lowest and highest edge in µm; values outside count in the first or last bin."""
LATE_SHARE = 0.001
"""Share of ticks later than a period from which the host is unsuitable, as in `rtloop doctor`."""
WORSE_RATIO = 2.0
"""Ratio of two p99, of the last RECENT_S and of the minute, from which a warning is given."""
RECENT_S = 10
RELEVANT_PART = 0.05
"""Part of a period below which lateness gives no warning, however much it grew."""
EDGES_US = 10.0 ** np.linspace(*DECADES, (DECADES[1] - DECADES[0]) * FINE_PER_DECADE + 1)
_LATENESS, _EXEC, _DEADLINE, _MISSED = (COMMON_SIGNALS[i].name for i in (LATENESS, EXEC, DEADLINE, PERIODS_MISSED))


class TimingSecond:
    """Figures of the ticks due in second `number` since the start of the run.

    `late` and `executed` (bins,) are histograms over EDGES_US of lateness and execution time. `worst_us` is the largest
    lateness, `missed` the number of missed periods, `beyond` the number of ticks that were late by more than a period.
    """

    def __init__(self, number: int) -> None:
        """Begin second `number` of the run without ticks: all figures are 0."""
        self.number = number
        self.late, self.executed = np.zeros((2, EDGES_US.size - 1))
        self.worst_us = self.missed = self.beyond = 0.0


class Timing:
    """Figures of the last minute of one run."""

    def __init__(self, loop: Description) -> None:
        """Begin a run of the described loop, without ticks."""
        self._period_us = 1e6 / loop.rate_hz
        self._seconds: deque[TimingSecond] = deque(maxlen=WINDOW_S)
        self._batch = Batch(loop.rate_hz)

    def feed(self, stretch: Stretch) -> None:
        """Add the next ticks of the run; they are collected and counted in batches, at the latest by `frame`."""
        self._count(self._batch.add(stretch))

    def _count(self, stretch: Stretch | None) -> None:
        """Add each tick of a stretch to the figures of the second in which it was due; None has no effect."""
        if stretch is None:
            return
        seconds = (stretch[_DEADLINE] // 1_000_000_000).astype(np.int64)
        bounds = [0, *(np.flatnonzero(np.diff(seconds)) + 1).tolist(), seconds.size]
        for first, end in pairwise(bounds):
            rows = slice(first, end)
            second = self._current_second(int(seconds[first]))
            late_us = stretch[_LATENESS][rows]
            second.late += _histogram(late_us)
            second.executed += _histogram(stretch[_EXEC][rows])
            second.worst_us = max(second.worst_us, float(np.nan_to_num(late_us).max()))
            second.beyond += float(np.count_nonzero(late_us > self._period_us))
            second.missed += float(stretch[_MISSED][rows].sum())

    def frame(self) -> bytes:
        """Return the binary message "timing" with the figures of the last minute, up to the newest tick.

        Header: `window_s` (number of seconds with ticks), `ticks` (number with a lateness), `periods_missed`;
        `worst_us`, `p50_us` and `p99_us` of the lateness; `exec_p50_us` and `exec_p99_us` of the execution time;
        `advice`, a list of warnings. Quantiles are None and `worst_us` is 0 if no tick has a measured time, as in
        virtual time. Arrays: `counts` (bins,), the histogram of the lateness, over `edges_us` (bins + 1,).
        """
        self._count(self._batch.take())
        seconds = [second for second in self._seconds if second.number > self._seconds[-1].number - WINDOW_S]
        lateness, execution = _sum(second.late for second in seconds), _sum(second.executed for second in seconds)
        worst_us = max((second.worst_us for second in seconds), default=0.0)
        missed = int(sum(second.missed for second in seconds))
        return pack_frame(
            "timing",
            {
                "window_s": len(seconds),
                "ticks": int(lateness.sum()),
                "worst_us": worst_us,
                "periods_missed": missed,
                "p50_us": quantile_us(lateness, 0.5),
                "p99_us": quantile_us(lateness, 0.99),
                "exec_p50_us": quantile_us(execution, 0.5),
                "exec_p99_us": quantile_us(execution, 0.99),
                "advice": self._advice(seconds, lateness, worst_us, missed),
            },
            {
                "edges_us": EDGES_US[:: FINE_PER_DECADE // SHOWN_PER_DECADE],
                "counts": lateness.reshape(-1, FINE_PER_DECADE // SHOWN_PER_DECADE).sum(axis=1),
            },
        )

    def _current_second(self, number: int) -> TimingSecond:
        """Return the figures of second `number` of the run, new ones if it has just begun.

        A number below the newest one, of a clock that went back, discards all other figures.
        """
        if self._seconds and number < self._seconds[-1].number:
            self._seconds.clear()
        if not self._seconds or self._seconds[-1].number != number:
            self._seconds.append(TimingSecond(number))
        return self._seconds[-1]

    def _advice(self, seconds: list[TimingSecond], lateness: Real, worst_us: float, missed: int) -> list[str]:
        """Return warnings about late ticks and growing lateness, then a hint at `rtloop doctor`; [] without a warning.

        `lateness` is the histogram (bins,) of all ticks of `seconds`, `worst_us` their largest lateness, `missed` their
        number of missed periods.
        """
        ticks, advice, beyond = lateness.sum(), [], sum(second.beyond for second in seconds)
        if ticks and beyond / ticks >= LATE_SHARE:
            advice.append(
                f"{100 * beyond / ticks:.2f} % of the ticks of the last minute were late by more than a period"
            )
        elif worst_us > self._period_us:
            advice.append(f"a tick was {worst_us:.0f} µs late, and {missed} periods were missed")
        recent_us = quantile_us(_sum(second.late for second in seconds[-RECENT_S:]), 0.99) or 0.0
        limit_us = max(WORSE_RATIO * (quantile_us(lateness, 0.99) or np.inf), RELEVANT_PART * self._period_us)
        if len(seconds) > 2 * RECENT_S and recent_us > limit_us:
            advice.append(
                f"lateness grows: in the last {RECENT_S} s, one tick in 100 was at least {recent_us:.0f} µs late"
            )
        if advice:
            advice.append("to find the cause on this host and a remedy, run `rtloop doctor CONFIG`")
        return advice


def quantile_us(counts: Real, fraction: float) -> float | None:
    """Return the quantile `fraction` (0 … 1), in µs, of a histogram `counts` (bins,) over EDGES_US.

    The quantile is interpolated linearly within a bin; None if all counts are 0, as in virtual time.
    """
    cumulative = np.concatenate([[0.0], np.cumsum(counts)])
    return float(np.interp(fraction * cumulative[-1], cumulative, EDGES_US)) if cumulative[-1] else None


def _histogram(values_us: Real) -> Real:
    """Return the counts (bins,) of finite values over EDGES_US; values outside count in the first or last bin."""
    values_us = values_us[np.isfinite(values_us)]
    bins = np.searchsorted(EDGES_US, values_us, side="right") - 1
    return np.bincount(np.clip(bins, 0, EDGES_US.size - 2), minlength=EDGES_US.size - 1).astype(float)


def _sum(histograms: Iterable[Real]) -> Real:
    """Return the sum of histograms (bins,); zeros if there are none."""
    return sum(histograms, np.zeros(EDGES_US.size - 1))
