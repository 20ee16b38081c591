"""What a driver of a node must count, by the definitions in docs/drivers.md, from what arrived in each tick."""

from __future__ import annotations

from itertools import accumulate

from rtloop.drivers.node.card import OBSERVED
from tests.drivers.relay_frames import Arrival

COUNTS = OBSERVED[:7]
FRAMES_PER_TICK = 64
"""Largest number of frames that the driver takes in a tick; the others wait for the next one."""


STRANGERS_EVERY = 64
"""Ticks from one count of other senders' datagrams to the next; the first is in the tick before those of `accounts`."""


def accounts(arrivals: list[list[Arrival]], first: int) -> list[list[int]]:
    """Return the counts of COUNTS after each tick, by their definitions; tick k awaits the answer to drive first + k.

    A tick takes what has come up to that answer; the rest waits for the next one. A sample is lost if one with a higher
    sequence has come and it has not; late if it comes after such a one.
    """
    queue: list[Arrival] = []
    known: dict[str, list[int]] = {"firsts": [], "again": []}
    invalid = foreign = held = level = strangers = 0
    rows = []
    for tick, arrived in enumerate(arrivals):
        queue += [arrival for arrival in arrived if arrival.kind != "stranger"]
        strangers += sum(arrival.kind == "stranger" for arrival in arrived)
        awaited = [arrival.kind == "sample" and arrival.sequence == first + tick for arrival in queue]
        count = min(awaited.index(True) + 1 if True in awaited else len(queue), FRAMES_PER_TICK)
        taken, queue = queue[:count], queue[count:]
        for arrival in taken:
            invalid += arrival.kind == "invalid"
            foreign += arrival.kind == "foreign"
            if arrival.kind == "sample":
                known["again" if arrival.sequence in known["firsts"] else "firsts"].append(arrival.sequence)
        if (tick + 1) % STRANGERS_EVERY == 0:
            foreign, strangers = foreign + min(strangers, FRAMES_PER_TICK), max(strangers - FRAMES_PER_TICK, 0)
        firsts = known["firsts"]
        late = sum(number < highest for number, highest in zip(firsts, accumulate(firsts, max), strict=True))
        missing = max(firsts) - first + 1 - len(firsts)
        is_held = max(firsts) != first + tick
        held += is_held
        level = level + 2 if is_held else max(level - 1, 0)
        rows.append([missing, late, len(known["again"]), invalid, foreign, held, level])
    return rows
