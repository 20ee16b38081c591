"""Plans of a bad network: the copies of each datagram, drawn from a seed or listed by a test."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple


class Copy(NamedTuple):
    """A copy of a datagram: delay in slots until it arrives, and its damage, "" for none."""

    delay: int = 0
    damage: str = ""


DAMAGES = ("bits", "burst", "cut", "empty", "longer", "huge")


def damage_datagram(data: bytes, damage: str, chance: random.Random) -> bytes:
    """Return the datagram with the damage: one to three bits or a burst of 32 bits, its end cut off, or more bytes."""
    if damage == "bits":
        for place in chance.sample(range(8 * len(data)), chance.randint(1, 3)):
            data = data[: place // 8] + bytes([data[place // 8] ^ 1 << place % 8]) + data[place // 8 + 1 :]
    elif damage == "burst":
        place = chance.randrange(len(data) - 4)
        data = (
            data[:place] + bytes(byte ^ chance.randint(1, 255) for byte in data[place : place + 4]) + data[place + 4 :]
        )
    elif damage in ("cut", "empty"):
        data = data[: chance.randrange(1, len(data)) if damage == "cut" else 0]
    elif damage:
        data += chance.randbytes(chance.randint(1, 8) if damage == "longer" else 4000)
    return data


@dataclass
class Plan:
    """A random plan: shares of datagrams that are lost, delayed, doubled and damaged in each direction.

    `delays` are the largest delays in slots. `strangers` is the share of slots with each kind of forged datagram: from
    another sender, of an earlier run, and false answers from the node's address.
    """

    seed: int
    lost: float = 0.05
    late: float = 0.1
    doubled: float = 0.05
    damage: float = 0.05
    delays: int = 5
    strangers: float = 0.0
    chance: random.Random = field(init=False)

    def __post_init__(self) -> None:
        """Seed the random numbers."""
        self.chance = random.Random(self.seed)

    def fate(self, direction: str) -> tuple[Copy, ...]:
        """Return the copies of the next datagram; `direction` is "drive" or "sample"."""
        chance = self.chance
        if chance.random() < self.lost:
            return ()
        copies = []
        for _ in range(2 if chance.random() < self.doubled else 1):
            delay = chance.randint(1, self.delays) if chance.random() < self.late else 0
            copies.append(Copy(delay, chance.choice(DAMAGES) if chance.random() < self.damage else ""))
        return tuple(copies)


class Script(Plan):
    """A listed plan: copies of datagrams by direction and number; all other datagrams arrive once and at once."""

    def __init__(self, copies: dict[tuple[str, int], tuple[Copy, ...]] | None = None) -> None:
        super().__init__(0)
        self._copies, self._counts = copies or {}, Counter[str]()

    def fate(self, direction: str) -> tuple[Copy, ...]:
        """Return the copies of the next datagram."""
        self._counts[direction] += 1
        return self._copies.get((direction, self._counts[direction] - 1), (Copy(),))
