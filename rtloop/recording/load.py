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
        """Signals (names or patterns, all by default) between two times as a DataFrame over the time in s.

        Its `attrs` hold `units` and `events`. Raises RecordingError, MissingExtra.
        """
        return frames.to_pandas(self, Selection(tuple(signals), start_s, end_s, every))

    def to_xarray(
        self, signals: Sequence[str] = (), start_s: float = 0.0, end_s: float = math.inf, every: int = 1
    ) -> xarray.Dataset:
        """Signals between two times as a Dataset: units in each variable's `attrs`, events as JSON in the Dataset's.

        Raises RecordingError, MissingExtra.
        """
        return frames.to_xarray(self, Selection(tuple(signals), start_s, end_s, every))


def load(path: RecordingPaths) -> Recording:
    """Open a recording: a file, a pattern such as `NAME-*.mcap`, or the files of one rotated run in any order.

    Raises RecordingError.
    """
    return Recording(find_files(path))
