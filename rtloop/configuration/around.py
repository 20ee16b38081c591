"""Whether a run can be recorded around events: its signals, and the memory that it takes."""

from __future__ import annotations

from collections.abc import Sequence

from rtloop.configuration.file import AroundOptions
from rtloop.engine.memory import RING_SECONDS, Sizes, ring_ticks
from rtloop.recording.capture.conditions import signal_problem
from rtloop.recording.file.event_window import EventWindow
from rtloop.recording.file.topics.overview import MAX_COLUMNS

MOST_BYTES = 1 << 30
"""Of the loop's ring, which is locked in memory, and of the recorder's copy of it."""


def around_of(options: AroundOptions) -> EventWindow:
    """As the recorder is told."""
    return EventWindow(options.before_s, options.after_s, options.on, options.every_s)


def ring_sizes(options: AroundOptions | None, sizes: Sizes) -> Sizes:
    """Of the shared block: its ring holds what waits in the recorder's memory as well, for one that takes its place."""
    if options is None:
        return sizes
    return sizes._replace(rate_hz=sizes.rate_hz * around_of(options).ring_factor(RING_SECONDS))


def around_faults(options: AroundOptions | None, columns: Sequence[str], rate_hz: float) -> list[str]:
    """What is wrong with [recording] around, where records have these columns."""
    if options is None:
        return []
    faults = [f"recording.around.on: {fault}" for text in options.on if (fault := signal_problem(text, columns))]
    if len(columns) > MAX_COLUMNS:
        faults.append(f"recording.around: {len(columns)} signals; of at most {MAX_COLUMNS} an overview is kept")
    window = around_of(options)
    memory_bytes = 8 * len(columns) * (
        ring_ticks(rate_hz * window.ring_factor(RING_SECONDS)) + round(window.max_delay_s * rate_hz)
    )  # fmt: skip
    if memory_bytes > MOST_BYTES:
        faults.append(
            f"recording.around.before_s: {options.before_s:g}: at {rate_hz:g} Hz and {len(columns)} signals that takes "
            f"{memory_bytes >> 20} MiB of memory; at most {MOST_BYTES >> 20} MiB are allowed"
        )
    return faults
