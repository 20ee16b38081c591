"""`rtloop.load`: open a recording, with its signals as numpy arrays, DataFrame or Dataset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rtloop.recording.file.run_readers import RecordingPaths, find_files
from rtloop.recording.recorded_signals import RecordedSignals
from rtloop.recording.views import frames
from rtloop.recording.views.selection import Selection

if TYPE_CHECKING:
    import pandas
    import xarray


class Recording(RecordedSignals):
    """Recording of one run, whose signals are also available as a DataFrame of pandas or a Dataset of xarray."""

    def to_pandas(
        self, signals: Sequence[str] = (), start_s: float = 0.0, end_s: float = math.inf, every: int = 1
    ) -> pandas.DataFrame:
        """Return signals (names or patterns, all by default) as a DataFrame over the time in s since the start.

        `tick` and `deadline_ns` are always included. `start_s` and `end_s`, both included, limit the time; of these
        ticks, the first is taken, and those whose number is a multiple of `every` above it. The DataFrame's `attrs`
        hold `recording` (the path), `name`, `rate_hz`, `units` (text by signal) and `events` (a list).
        Raises RecordingError if a pattern fits no signal, a limited time span holds no tick, or `every` is below 1;
        MissingExtra without pandas.

        >>> rtloop.load("run.mcap").to_pandas(["x_position_um"], start_s=0.1, end_s=0.1002).round(2)
                  tick  deadline_ns  x_position_um
        time_s
        0.1000  1000.0  100000000.0          19.81
        0.1001  1001.0  100100000.0          19.82
        0.1002  1002.0  100200000.0          19.81
        """
        return frames.to_pandas(self, Selection(tuple(signals), start_s, end_s, every))

    def to_xarray(
        self, signals: Sequence[str] = (), start_s: float = 0.0, end_s: float = math.inf, every: int = 1
    ) -> xarray.Dataset:
        """Return signals (names or patterns, all by default) as a Dataset over the time in s since the start.

        Arguments and signals are the same as in `to_pandas`. The `attrs` of each variable hold its `units` and
        `long_name`, the `attrs` of the Dataset `recording` (the path), `name`, `rate_hz` and `events` (JSON text).
        Raises RecordingError if a pattern fits no signal, a limited time span holds no tick, or `every` is below 1;
        MissingExtra without xarray.
        """
        return frames.to_xarray(self, Selection(tuple(signals), start_s, end_s, every))


def load(path: RecordingPaths) -> Recording:
    """Open a recording: a file, a pattern such as `NAME-*.mcap`, or the files of one rotated run in any order.

    Signals are read on first use. Raises RecordingError if a file is missing or no recording, is given twice, or
    belongs to another run.

    >>> run = rtloop.load("run.mcap")
    >>> run
    <Recording run.mcap: axes x, 10000 Hz, 23 signals>
    >>> round(float(run["x_position_um"].max()), 1), run.units["x_position_um"], len(run)
    (20.1, 'µm', 7000)
    """
    return Recording(find_files(path))
