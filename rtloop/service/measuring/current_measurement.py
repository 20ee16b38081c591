"""Progress of the current measurement, for `/status` and `/watch`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple


class Progress(NamedTuple):
    """Progress of a measurement: `activity` (response, learn) and axis; for learning also the rms error of each
    finished cycle, µm, and the number of cycles.
    """

    activity: str
    axis: str
    rms_um: tuple[float, ...] = ()
    cycles: int | None = None


class CurrentMeasurement:
    """The current measurement of a service; there is at most one at a time."""

    def __init__(self) -> None:
        self._progress: Progress | None = None

    def for_json(self) -> dict[str, object] | None:
        """Return the progress as {activity, axis, rms_um, cycles}; None without a measurement.

        Of a learning, `rms_um` has the rms error of each finished cycle, in µm, and `cycles` is the number of cycles
        that it will have; otherwise they are () and None.
        """
        progress = self._progress
        return None if progress is None else progress._asdict()

    def add_cycle(self, rms_um: float) -> None:
        """Add the rms error of a finished cycle, µm; no effect without a measurement."""
        if self._progress is not None:
            self._progress = self._progress._replace(rms_um=(*self._progress.rms_um, rms_um))

    @contextmanager
    def begin(self, activity: str, axis: str, cycles: int | None = None) -> Iterator[None]:
        """Report a measurement during the work within; `cycles` is the number of cycles of a learning."""
        self._progress = Progress(activity, axis, cycles=cycles)
        try:
            yield
        finally:
            self._progress = None
