"""How late the ticks of the last minute woke, for all clients: a histogram a second, and what it says of the host."""

from __future__ import annotations

from collections import deque

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.panel.stretch import Batch, Stretch
from rtloop.panel.views.frames import pack_frame
from rtloop.panel.views.service import Description
from rtloop.signals import COMMON_SIGNALS, DEADLINE, EXEC, LATENESS, PERIODS_MISSED

WINDOW_S = 60
FINE_PER_DECADE, SHOWN_PER_DECADE = 100, 10
DECADES = (-1, 6)
"""Of µs: what is below the first is counted with it, what is beyond the last likewise."""
LATE_SHARE = 0.001
"""More ticks than that later than a period speak against a host, as `rtloop doctor` has it."""
WORSE_RATIO = 2.0
"""p99 of the last ten seconds against that of the minute."""
RECENT_S = 10
RELEVANT_PART = 0.05
"""Of a period: less does not matter, however much worse it got."""
EDGES_US = 10.0 ** np.linspace(*DECADES, (DECADES[1] - DECADES[0]) * FINE_PER_DECADE + 1)
_LATENESS, _EXEC, _DEADLINE, _MISSED = (COMMON_SIGNALS[i].name for i in (LATENESS, EXEC, DEADLINE, PERIODS_MISSED))


class Second:
    """What is kept of a second."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.late, self.executed = np.zeros((2, EDGES_US.size - 1))
        self.worst_us = self.missed = self.beyond = 0.0


class Timing:
    """Of the ticks that are fed."""

    def __init__(self, loop: Description) -> None:
        self._period_us = 1e6 / loop.rate_hz
        self._seconds: deque[Second] = deque(maxlen=WINDOW_S)
        self._batch = Batch(loop.rate_hz)

    def feed(self, stretch: Stretch) -> None:
        """Count them, in the end."""
        self._count(self._batch.add(stretch))

    def _count(self, stretch: Stretch | None) -> None:
        """Each in its second."""
        if stretch is None:
            return
        seconds = (stretch[_DEADLINE] // 1_000_000_000).astype(np.int64)
        ends = np.append(np.flatnonzero(np.diff(seconds)) + 1, seconds.size)
        first = 0
        for end in ends.tolist():
            rows = slice(first, end)
            second = self._current_second(int(seconds[first]))
            late_us = stretch[_LATENESS][rows]
            second.late += _histogram(late_us)
            second.executed += _histogram(stretch[_EXEC][rows])
            second.worst_us = max(second.worst_us, float(np.nan_to_num(late_us).max()))
            second.beyond += float(np.count_nonzero(late_us > self._period_us))
            second.missed += float(stretch[_MISSED][rows].sum())
            first = end

    def frame(self) -> bytes:
        """The last minute."""
        self._count(self._batch.take())
        seconds = [second for second in self._seconds if second.number > self._seconds[-1].number - WINDOW_S]
        lateness_counts, exec_counts = (
            sum((getattr(second, name) for second in seconds), _empty_histogram()) for name in ("late", "executed")
        )
        step = FINE_PER_DECADE // SHOWN_PER_DECADE
        return pack_frame(
            "timing",
            {
                "window_s": len(seconds),
                "ticks": int(lateness_counts.sum()),
                "worst_us": max((second.worst_us for second in seconds), default=0.0),
                "periods_missed": int(sum(second.missed for second in seconds)),
                "p50_us": quantile_us(lateness_counts, 0.5),
                "p99_us": quantile_us(lateness_counts, 0.99),
                "exec_p50_us": quantile_us(exec_counts, 0.5),
                "exec_p99_us": quantile_us(exec_counts, 0.99),
                "advice": self._advice(seconds, lateness_counts),
            },
            {"edges_us": EDGES_US[::step], "counts": lateness_counts.reshape(-1, step).sum(axis=1)},
        )

    def _current_second(self, number: int) -> Second:
        if self._seconds and number < self._seconds[-1].number:
            self._seconds.clear()
        if not self._seconds or self._seconds[-1].number != number:
            self._seconds.append(Second(number))
        return self._seconds[-1]

    def _advice(self, seconds: list[Second], lateness_counts: Real) -> list[str]:
        """What `rtloop doctor` would say of these ticks; empty where nothing speaks against the host."""
        ticks, advice = lateness_counts.sum(), []
        worst_us = max((second.worst_us for second in seconds), default=0.0)
        beyond_count, missed_periods = (
            sum(second.beyond for second in seconds),
            int(sum(second.missed for second in seconds)),
        )
        if ticks and beyond_count / ticks >= LATE_SHARE:
            advice.append(f"{100 * beyond_count / ticks:.2f} % of the ticks were late by more than a period")
        elif worst_us > self._period_us:
            advice.append(f"a tick was {worst_us:.0f} µs late, and {missed_periods} periods were missed")
        recent = sum((second.late for second in seconds[-RECENT_S:]), _empty_histogram())
        now_us, all_us = quantile_us(recent, 0.99), quantile_us(lateness_counts, 0.99)
        if (
            len(seconds) > 2 * RECENT_S
            and now_us
            and all_us
            and now_us > WORSE_RATIO * all_us
            and now_us > RELEVANT_PART * self._period_us
        ):
            advice.append(f"it gets worse: one tick in a hundred of the last {RECENT_S} s was {now_us:.0f} µs late")
        if advice:
            advice.append("`rtloop doctor CONFIG` looks for the cause on this host, and says what mends it")
        return advice


def quantile_us(counts: Real, fraction: float) -> float | None:
    """Within the bin by a straight line; None without ticks, as in virtual time."""
    cumulative = np.concatenate([[0.0], np.cumsum(counts)])
    return float(np.interp(fraction * cumulative[-1], cumulative, EDGES_US)) if cumulative[-1] else None


def _histogram(values_us: Real) -> Real:
    values_us = values_us[np.isfinite(values_us)]
    bins = np.searchsorted(EDGES_US, values_us, side="right") - 1
    return np.bincount(np.clip(bins, 0, EDGES_US.size - 2), minlength=EDGES_US.size - 1).astype(float)


def _empty_histogram() -> Real:
    return np.zeros(EDGES_US.size - 1)
