"""Oracle of a node driver's counts: computed from the arrivals of each tick by the definitions in docs/drivers.md."""

from __future__ import annotations

from itertools import accumulate

from rtloop.drivers.node.card import OBSERVED
from tests.drivers.relay_frames import Arrival

COUNTS = OBSERVED[:7]
FRAMES_PER_TICK = 64
"""Largest number of frames that the driver processes in a tick; further frames wait for the next tick."""


STRANGERS_EVERY = 64
"""Period in ticks of the count of other senders' datagrams; the first count is in the tick before the first row."""


def expected_counts(arrivals: list[list[Arrival]], first: int) -> list[list[int]]:
    """Return the counts of COUNTS after each tick; in tick k the answer to drive first + k is due.

    A tick processes the arrivals up to that answer; later ones wait for the next tick. A sample is lost if it has not
    arrived and one with a higher sequence has; it is late if it arrives after one with a higher sequence.
    """
    queue: list[Arrival] = []
    samples: dict[str, list[int]] = {"firsts": [], "again": []}
    invalid = foreign = held = level = strangers = 0
    rows = []
    for tick, arrived in enumerate(arrivals):
        queue += [arrival for arrival in arrived if arrival.kind != "stranger"]
        strangers += sum(arrival.kind == "stranger" for arrival in arrived)
        awaited = [arrival.kind == "sample" and arrival.sequence == first + tick for arrival in queue]
        count = min(awaited.index(True) + 1 if True in awaited else len(queue), FRAMES_PER_TICK)
        processed, queue = queue[:count], queue[count:]
        for arrival in processed:
            invalid += arrival.kind == "invalid"
            foreign += arrival.kind == "foreign"
            if arrival.kind == "sample":
                samples["again" if arrival.sequence in samples["firsts"] else "firsts"].append(arrival.sequence)
        if (tick + 1) % STRANGERS_EVERY == 0:
            foreign, strangers = foreign + min(strangers, FRAMES_PER_TICK), max(strangers - FRAMES_PER_TICK, 0)
        firsts = samples["firsts"]
        late = sum(number < highest for number, highest in zip(firsts, accumulate(firsts, max), strict=True))
        missing = max(firsts) - first + 1 - len(firsts)
        is_held = max(firsts) != first + tick
        held += is_held
        level = level + 2 if is_held else max(level - 1, 0)
        rows.append([missing, late, len(samples["again"]), invalid, foreign, held, level])
    return rows
