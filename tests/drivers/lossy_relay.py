"""A bad network between driver and node: datagrams are lost, delayed, reordered, doubled and damaged by a plan.

For the loop, the relay's socket is the node. Time is counted in slots: a slot begins with each datagram of the loop.
The relay logs the arrivals at both ends in each slot; frames are written and read after docs/node-protocol.md alone.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections import Counter
from collections.abc import Iterator
from typing import Any

from rtloop.drivers.node.keys import read_key
from tests.drivers.network_plan import Copy, Plan, damage_datagram
from tests.drivers.relay_frames import (
    LOOP,
    STRANGER,
    Arrival,
    DriveFrame,
    Node,
    drive_content,
    parse_drive,
    refusal_content,
    sample_content,
)  # fmt: skip
from tests.node.frames import ANSWER, APPLY, DRIVE, REFUSAL, SAMPLE, UNSEALED, Seal, frame

PERIOD_US = 1000
"""Time that the node's clock advances with each datagram."""
LARGEST_DATAGRAM = 65_536
LONGEST_S = 60.0
"""Time-out in s of a datagram on a busy machine."""


class Relay:
    """The bad network: a thread between the loop's socket and a node that it calls.

    Before `begin(plan)` and after `end()` the network loses nothing. `slots` counts the loop's datagrams since `begin`,
    `fates` counts copies by direction and fate.
    """

    def __init__(self, node: Node, period_us: int = PERIOD_US) -> None:
        self.node, self.now_us, self._period_us = node, 10_000_000, period_us
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stranger.bind(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        self._plan: Plan | None = None
        self._changed = threading.Condition()
        self.handled, self.slots = 0, 0
        self.fates = Counter[str]()
        self.drives: dict[int, DriveFrame] = {}
        """Drives that the loop sent in its newest session, by sequence."""
        self.arrivals: list[list[Arrival]] = []
        """Arrivals at the loop in each slot."""
        self.output_problems: list[str] = []
        """Sentences about movements of the outputs that no drive of the loop explains."""
        self.applied: list[tuple[int, tuple[int, ...]]] = []
        """Sequence and codes of each drive that has reached the outputs."""
        self.earlier: list[bytes] = []
        """Frames of earlier sessions, in both directions, from which forged frames are drawn."""
        self._answers: list[bytes] = []
        self._to_node: list[tuple[int, float, bytes, bool]] = []
        self._to_loop: list[tuple[int, float, bytes, Arrival]] = []
        self._loop_address: tuple[str, int] = ("", 0)
        self._session = self._newest = 0
        self.floods: dict[int, int] = {}
        """Slot → number of invalid datagrams that the loop gets in front of its answer."""
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def begin(self, plan: Plan) -> None:
        """Treat the loop's datagrams by the plan, from the next one on."""
        with self._changed:
            self._plan, self.slots, self.arrivals, self.applied = plan, 0, [], []

    def end(self) -> None:
        """Carry all datagrams again; delayed datagrams are lost."""
        with self._changed:
            self._plan = None
            self._to_node.clear()
            self._to_loop.clear()

    def wait_handled(self, count: int) -> None:
        """Wait until the relay has carried `count` datagrams of the loop since its start."""
        with self._changed:
            assert self._changed.wait_for(lambda: self.handled >= count, LONGEST_S), "a datagram of the loop"

    def close(self) -> None:
        """End the thread and close the sockets."""
        self._stranger.sendto(b"end", ("127.0.0.1", self.port))
        self._thread.join()
        self._socket.close()
        self._stranger.close()

    def _work(self) -> None:
        """Carry datagrams until the socket `_stranger` sends one."""
        end_address = self._stranger.getsockname()
        while True:
            data, address = self._socket.recvfrom(LARGEST_DATAGRAM)
            if address == end_address:
                return
            with self._changed:
                self._loop_address = address
                self._carry(data)
                self.handled += 1
                self._changed.notify_all()

    def _carry(self, data: bytes) -> None:
        """Carry a datagram of the loop, and all delayed ones that are due, to the node and back."""
        self.now_us += self._period_us
        drive = parse_drive(data)
        if drive is not None:
            if drive.session != self._session:
                self.earlier += self._answers[-100:]
                self._session, self._newest, self.drives, self._answers = drive.session, 0, {}, []
            self.drives[drive.sequence] = drive
        if self._plan is None:
            if answer := self._call_node(data, LOOP, is_intact=True):
                self._answers.append(answer)
                self._socket.sendto(answer, self._loop_address)
            self._answers.append(data)
            return
        self.arrivals.append([])
        for copy in self._draw("drive", self._plan):
            content = damage_datagram(data, copy.damage, self._plan.chance)
            self._to_node.append((self.slots + copy.delay, self._plan.chance.random(), content, not copy.damage))
        self._forge(self._plan)
        for item in self._due(self._to_node):
            self._take_answer(self._call_node(item[2], LOOP, item[3]), self._plan)
        for _ in range(self.floods.get(self.slots, 0)):
            self._send(self._plan.chance.randbytes(40), Arrival("invalid"))
        for item in self._due(self._to_loop):
            self._send(item[2], item[3])
        self._answers.append(data)
        self.slots += 1

    def _draw(self, direction: str, plan: Plan) -> tuple[Copy, ...]:
        """Draw the copies of the next datagram, count their fates, and return them."""
        copies = plan.fate(direction)
        kinds = ["doubled"] * (len(copies) > 1) + ["lost"] * (not copies)
        kinds += [copy.damage or ("late" if copy.delay else "good") for copy in copies]
        self.fates.update(f"{direction} {kind}" for kind in kinds)
        return copies

    def _due(self, queue: list[Any]) -> Iterator[Any]:
        """Remove the due datagrams from a queue and yield them in their order."""
        for item in sorted((item for item in queue if item[0] <= self.slots), key=lambda item: item[:2]):
            queue.remove(item)
            yield item

    def _call_node(self, data: bytes, sender: str, is_intact: bool) -> bytes:
        """Give the node a datagram, compare its outputs with the drive, and return the answer."""
        before = self.node.outputs
        answer = self.node.receive(data, sender, self.now_us)
        after, drive = self.node.outputs, parse_drive(data) if is_intact and sender == LOOP else None
        is_accepted = drive is not None and drive.session == self._session and drive.sequence > self._newest
        is_accepted = is_accepted and answer[2:3] != bytes([REFUSAL])
        if drive is not None and is_accepted:
            self._newest = drive.sequence
        if self._plan is None:
            return answer
        if drive is not None and is_accepted and drive.flags & APPLY:
            self.applied.append((drive.sequence, after))
            if after != self.drives[drive.sequence].codes:
                self.output_problems.append(f"outputs {after} after drive {drive}")
        elif after != before and not (self.node.counts[1] and abs(after[0]) <= abs(before[0])):  # the watchdog's ramp
            self.output_problems.append(f"outputs {before} → {after} by {data.hex()} of the {sender}")
        return answer

    def _take_answer(self, answer: bytes, plan: Plan) -> None:
        """Send the node's answer to the loop by the plan."""
        if not answer:
            return
        self._answers.append(answer)
        arrival = self._classify(answer)
        for copy in self._draw("sample", plan):
            content = damage_datagram(answer, copy.damage, plan.chance)
            item = Arrival("invalid") if copy.damage else arrival
            self._to_loop.append((self.slots + copy.delay, plan.chance.random(), content, item))

    def _classify(self, answer: bytes) -> Arrival:
        """Return the arrival as which the loop must count an undamaged frame of the node."""
        sequence, session = struct.unpack_from("<II", answer, 4)
        if answer[2] not in (SAMPLE, REFUSAL):
            return Arrival("invalid")
        if session != self._session:
            return Arrival("foreign")
        if answer[2] == REFUSAL:
            self.output_problems.append(f"a refusal: {answer.hex()}")
            return Arrival("refusal", sequence)
        return Arrival("sample", sequence, struct.unpack(f"<{answer[17]}i", answer[28:-12]))

    def _send(self, data: bytes, arrival: Arrival, is_strange: bool = False) -> None:
        """Send a datagram to the loop and log its arrival, from the node's address or from another one."""
        (self._stranger if is_strange else self._socket).sendto(data, self._loop_address)
        self.arrivals[-1].append(arrival)

    def _forge(self, plan: Plan) -> None:
        """Send forged datagrams to both ends, each kind by its share."""
        chance = plan.chance
        newest = max(self.drives)
        boot = next(struct.unpack_from("<I", data, 12)[0] for data in self._answers if data[2] == SAMPLE)
        codes = (chance.randint(-20_000, 20_000),)
        if chance.random() < plan.strangers:  # A stranger drives the loop's session.
            self._call_node(
                frame(DRIVE, newest + 3, drive_content(self._session, APPLY | ANSWER, codes), UNSEALED), STRANGER, False
            )
        if chance.random() < plan.strangers:  # A drive of another session, from the loop's address.
            data = frame(DRIVE, newest + 2, drive_content(self._session ^ 1, APPLY | ANSWER, codes), UNSEALED)
            self._take_answer(self._call_node(data, LOOP, False), plan)
        if chance.random() < plan.strangers and self._answers:  # An old drive of this session is repeated.
            data = chance.choice(self._answers)
            if parse_drive(data):
                self._take_answer(self._call_node(data, LOOP, True), plan)
        if chance.random() < plan.strangers:  # A stranger answers the newest drive.
            data = frame(SAMPLE, newest, sample_content(self._session, boot, codes), UNSEALED)
            self._send(data, Arrival("stranger"), True)
        if chance.random() < plan.strangers:  # A sample of another session, from the node's address.
            data = frame(SAMPLE, newest, sample_content(self._session ^ 1, boot, codes), UNSEALED)
            self._send(data, Arrival("foreign"))
        if chance.random() < plan.strangers:  # A sample whose sequence no drive has had.
            data = frame(SAMPLE, newest + 5, sample_content(self._session, boot, codes), UNSEALED)
            self._send(data, Arrival("foreign" if self.node.key else "invalid"))
        if self.node.key and chance.random() < plan.strangers:  # An answer to the newest drive, by one without the key.
            self._send(
                chance.choice(
                    (
                        frame(SAMPLE, newest, sample_content(self._session, boot, codes), UNSEALED),
                        frame(REFUSAL, newest, refusal_content(self._session, boot), UNSEALED),
                    )
                ),
                Arrival("foreign"),
            )
        if self.node.key and chance.random() < plan.strangers:  # The node's refusal of a drive that another has sent.
            seal = Seal(read_key(self.node.key), boot, 1)
            self._send(frame(REFUSAL, newest, refusal_content(self._session, boot), seal), Arrival("foreign"))
        if chance.random() < plan.strangers and self.earlier:  # A frame of an earlier run, at either end.
            data = chance.choice(self.earlier)
            self._send(data, self._classify(data))
            self._take_answer(self._call_node(data, LOOP, False), plan)


@contextlib.contextmanager
def relayed(node: Node, period_us: int = PERIOD_US) -> Iterator[Relay]:
    """Yield a relay to a node, and close it at the end."""
    relay = Relay(node, period_us)
    try:
        yield relay
    finally:
        relay.close()
