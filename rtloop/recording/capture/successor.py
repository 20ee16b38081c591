"""First ring position of a replacement recorder: it begins at a snapshot of the law, so that its file replays alone.

The dead recorder's file holds the ticks, events and snapshots since that snapshot as well, up to the tick
`repeats_before` of the header; a reader of both files takes the repeated data from the dead recorder's file.
"""

from __future__ import annotations

import numpy as np

from rtloop.engine.memory import SharedBlock
from rtloop.recording.capture.pending import snapshot_tick
from rtloop.recording.capture.progress import RingPosition
from rtloop.recording.capture.rings import RingReader

SPARE_DIVISOR = 4
"""The loop, which runs while the ticks are copied, needs one part in SPARE_DIVISOR of the ring of ticks."""


def snapshot_before(block: SharedBlock, end: RingPosition) -> RingPosition | None:
    """Return the ring position at the newest snapshot at or before `end`, where the dead recorder's file ends.

    The events from the snapshot's tick on follow that position. None if there is no such snapshot, if events since then
    are lost, or if the loop may soon overwrite its tick (SPARE_DIVISOR).
    """
    snapshots, events = RingReader(block, "snapshots"), RingReader(block, "events")
    ticks = [snapshot_tick(bytes(snapshot)) for snapshot in snapshots.take()]
    indices = [place for place, tick in enumerate(ticks) if tick <= end.ticks]
    if not indices:
        return None
    tick, slots = ticks[indices[-1]], len(block["ticks_slots"])
    if int(block["ticks_head"][0]) - tick > slots - slots // SPARE_DIVISOR:
        return None
    event_ticks = events.take()["tick"]
    earlier_events, oldest = np.flatnonzero(event_ticks < tick), events.position - len(event_ticks)
    if oldest and not len(earlier_events):
        return None
    event = oldest + int(earlier_events[-1]) + 1 if len(earlier_events) else 0
    snapshot = snapshots.position - len(ticks) + indices[-1]
    return RingPosition(tick, snapshot, min(event, end.events), end.lost)
