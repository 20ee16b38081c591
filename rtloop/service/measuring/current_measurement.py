"""Progress of the current measurement, for `/status` and `/watch`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple


class Progress(NamedTuple):
    """Progress of a measurement: `activity` (response, learn) and axis; for learning also the rms error of each
    finished cycle, µm, beginning with the one without learning, and the number of cycles that follow that one.
    """

    activity: str
    axis: str
    rms_um: tuple[float, ...] = ()
    cycles: int | None = None


class CurrentMeasurement:
    """The current measurement of a service; there is at most one at a time."""

    def __init__(self) -> None:
        """Begin without a measurement."""
        self._progress: Progress | None = None

    def for_json(self) -> dict[str, object] | None:
        """Return the progress as {activity, axis, rms_um, cycles}; None without a measurement.

        In a learning, `rms_um` has the rms error of each finished cycle, in µm, first of the cycle without learning;
        `cycles` is the requested number of cycles that follow that one. Else `rms_um` is () and `cycles` None.
        """
        progress = self._progress
        return None if progress is None else progress._asdict()

    def add_cycle(self, rms_um: float) -> None:
        """Add the rms error of a finished cycle, µm; no effect without a measurement."""
        if self._progress is not None:
            self._progress = self._progress._replace(rms_um=(*self._progress.rms_um, rms_um))

    @contextmanager
    def begin(self, activity: str, axis: str, cycles: int | None = None) -> Iterator[None]:
        """Let `for_json` report a measurement of `axis` during the work within.

        `activity` is "response" or "learn"; `cycles` is the requested number of cycles of a learning, else None.
        """
        self._progress = Progress(activity, axis, cycles=cycles)
        try:
            yield
        finally:
            self._progress = None
