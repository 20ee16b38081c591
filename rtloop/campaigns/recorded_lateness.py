"""Lateness of ticks for a campaign, from the recording of a paced run: how late the host's clock woke the loop.

A tick is late by the time from its first deadline to its wake: its recorded lateness, and the periods that it missed.
A wake more than a period late makes the next tick miss periods, too; the time that the wake had lost counts once.

At most MAX_LATENESS_SAMPLES numbers are drawn from. The largest is one of them: it is drawn more often than recorded.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rtloop.configuration.file import LARGEST_LATENESS_US, MAX_LATENESS_SAMPLES
from rtloop.errors import ConfigError
from rtloop.foundation.arrays import Real
from rtloop.recording.load import load

US_PER_S, NS_PER_US = 1e6, 1e3


def recorded_lateness(path: Path) -> tuple[float, ...]:
    """Return the lateness of the ticks of a recording in µs, rising, at most MAX_LATENESS_SAMPLES numbers.

    A tick before its deadline counts as 0 µs late. Raises RecordingError for a file that is no recording; ConfigError
    for a recording without lateness, as of a run in virtual time, and for a recording with a tick that is later than
    LARGEST_LATENESS_US.
    """
    recording = load(path)
    lateness_us, missed = recording.read("lateness_us", "periods_missed")
    late_us = _new_lateness(lateness_us, missed, US_PER_S / recording.header["rate_hz"])
    late_us = np.sort(np.maximum(late_us[~np.isnan(late_us)], 0.0))
    if not late_us.size:
        fault = "has no lateness: its ticks ran in virtual time; use a recording of a paced run"
        raise ConfigError(str(path), [f"lateness: {path.name} {fault}"])
    if late_us[-1] > LARGEST_LATENESS_US:
        fault = f"has a tick that is {late_us[-1]:.6g} µs late; allowed: at most {LARGEST_LATENESS_US:g} µs"
        raise ConfigError(str(path), [f"lateness: {path.name} {fault}"])
    return tuple((np.rint(reduce_samples(late_us, MAX_LATENESS_SAMPLES) * NS_PER_US) / NS_PER_US).tolist())


def _new_lateness(lateness_us: Real, missed: Real, period_us: float) -> Real:
    """Return the time from each tick's first deadline to its wake in µs, (n,); NaN where `lateness_us` is NaN.

    The time is `lateness_us` plus the duration of the `missed` periods. If the previous tick was more than a period
    late, the excess over the period counts at that tick, and is subtracted from this duration, down to 0.
    """
    lost_us = np.concatenate([[0.0], np.nan_to_num(np.maximum(lateness_us[:-1] - period_us, 0.0))])
    return lateness_us + np.maximum(missed * period_us - lost_us, 0.0)


def reduce_samples(ordered: Real, count: int) -> Real:
    """Return at most `count` of sorted numbers, at evenly spaced ranks, the least and the largest included; all, if
    they are not more.
    """
    if ordered.size <= count:
        return ordered
    return ordered[np.rint(np.linspace(0, ordered.size - 1, count)).astype(np.int64)]
