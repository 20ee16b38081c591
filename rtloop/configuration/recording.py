"""[recording]: folder, rotation and contents of recordings; signals and memory of a recording around events."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Self

from pydantic import Field, model_validator

from rtloop.engine.memory import RING_SECONDS, Sizes, ring_ticks
from rtloop.foundation.options import Options
from rtloop.recording.capture.conditions import parse_comparison, signal_problem
from rtloop.recording.file.event_window import EventWindow

MOST_BYTES = 1 << 30
"""Limit for the loop's ring, which is locked in memory, and the recorder's copy of it."""


class AroundOptions(Options):
    """Events around which every tick is recorded; elsewhere an overview is recorded.

    `on` are the conditions that make an event. Every tick is recorded from `before_s` before an event to `after_s`
    after it; the overview has one interval each `every_s`.
    """

    before_s: float = Field(default=10.0, ge=0, le=600)
    """Time before an event from which on every tick is recorded; the recorder holds it in memory."""
    after_s: float = Field(default=30.0, ge=0, le=86_400)
    """Time after the last tick of an event until which every tick is recorded."""
    on: Annotated[tuple[str, ...], Field(strict=False, min_length=1, max_length=50)]
    """Conditions that make an event: `trip`, `mode`, `command`, `late`, or a comparison such as `abs(x_error_um) >
    5.0`."""
    every_s: float = Field(default=1.0, ge=0.05, le=60)
    """Interval of which the overview has least, largest and mean value of each signal, between events."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Require each text of `on` to be a condition."""
        for text in self.on:
            try:
                parse_comparison(text)
            except ValueError as error:
                raise ValueError(f"on: {text!r}: {error}") from None
        return self


class RecordingOptions(Options):
    """Folder, rotation and contents of recordings.

    A file is followed by another one at `rotate_mib` or after `rotate_s` (None: no such limit). At least `min_free_mib`
    of the disk stay free. `around` None: every tick is recorded.
    """

    folder: str = "recordings"
    """Folder of the recordings; a relative path starts at the working directory."""
    rotate_mib: float | None = Field(default=None, gt=0)
    """Size from which on the recording continues in another file; by default it stays one file."""
    rotate_s: float | None = Field(default=None, gt=0)
    """Duration after which the recording continues in another file; by default it stays one file."""
    min_free_mib: float = Field(default=64.0, ge=0)
    """Free space on the disk below which recording pauses; the loop continues, and the ticks are lost."""
    around: AroundOptions | None = None
    """Events around which alone every tick is recorded; by default every tick of the run is."""
    keep_gib: float | None = Field(default=None, gt=0)
    """Total size beyond which the oldest files of this configuration's recordings are removed, except around trips."""
    message_index: bool = True
    """16 bytes a tick, without which viewers that are not in Python refuse the file."""


def event_window(options: AroundOptions) -> EventWindow:
    """Return the options as the EventWindow of header and recorder: the same before_s, after_s, on and every_s."""
    return EventWindow(options.before_s, options.after_s, options.on, options.every_s)


def ring_sizes(options: AroundOptions | None, sizes: Sizes) -> Sizes:
    """Return `sizes` of a shared block with a higher `rate_hz`, which makes its ring of ticks larger.

    The ring then also holds the ticks before an event, for a restarted recorder. Without `options`, the sizes are
    unchanged.
    """
    if options is None:
        return sizes
    return sizes._replace(rate_hz=sizes.rate_hz * event_window(options).ring_factor(RING_SECONDS))


def event_recording_faults(options: AroundOptions | None, columns: Sequence[str], rate_hz: float) -> list[str]:
    """Return a line for each fault of [recording] around; [] for None. `columns` are all signals of a record.

    Faults are a condition of `on` with an unknown signal, and more than MOST_BYTES of memory for the ticks before an
    event.
    """
    if options is None:
        return []
    faults = [f"recording.around.on: {fault}" for text in options.on if (fault := signal_problem(text, columns))]
    window = event_window(options)
    memory_bytes = 8 * len(columns) * (
        ring_ticks(rate_hz * window.ring_factor(RING_SECONDS)) + round(window.max_delay_s * rate_hz)
    )  # fmt: skip
    if memory_bytes > MOST_BYTES:
        faults.append(
            f"recording.around.before_s: {options.before_s:g} s at {rate_hz:g} Hz with {len(columns)} signals needs "
            f"{memory_bytes >> 20} MiB of memory; allowed: up to {MOST_BYTES >> 20} MiB"
        )
    return faults
