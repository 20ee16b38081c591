"""The measurement that moves a loop now, and its progress: what `status` and `watch` tell of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple


class Progress(NamedTuple):
    """A measurement under way: its `activity` (response, learn), its axis, and of a learning the rms error of each
    cycle that was judged, µm, and how many cycles it has.
    """

    activity: str
    axis: str
    rms_um: tuple[float, ...] = ()
    cycles: int | None = None


class Underway:
    """The progress of the measurement of a service; there is at most one at a time."""

    def __init__(self) -> None:
        self._progress: Progress | None = None

    def for_json(self) -> dict[str, Any] | None:
        """Plain values; None while nothing is measured."""
        progress = self._progress
        return None if progress is None else progress._asdict()

    def add_cycle(self, rms_um: float) -> None:
        """Tell of a further cycle of the learning under way."""
        if self._progress is not None:
            self._progress = self._progress._replace(rms_um=(*self._progress.rms_um, rms_um))

    @contextmanager
    def begin(self, activity: str, axis: str, cycles: int | None = None) -> Iterator[None]:
        """Tell of a measurement for as long as the work in between goes on."""
        self._progress = Progress(activity, axis, cycles=cycles)
        try:
            yield
        finally:
            self._progress = None
