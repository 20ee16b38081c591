"""The node in C and the simulated node in Python, written separately from one document, answer with equal bytes."""

from __future__ import annotations

import random
from ctypes import CDLL

import pytest

from rtloop.drivers.node.options import UdpOptions
from rtloop.drivers.node.simulated import SHORTEST_PERIOD_US, SimulatedNode
from tests.node.bench import BOOT, KEY, Bench
from tests.node.frames import ANSWER, APPLY, OPEN, PARK, Channel, Seal, drive, hello

STEPS = 4000
SENDERS = (0xC0A80001_1234, 0xC0A80002_1234)
FLAGS = (
    *(OPEN | ANSWER,) * 4, *(APPLY | ANSWER,) * 20, *(APPLY,) * 4, *(ANSWER,) * 4, PARK | ANSWER, OPEN | APPLY | ANSWER,
)  # fmt: skip


class StillNode(SimulatedNode):
    """The simulated node with inputs that always read code 0."""

    def _read_inputs(self) -> list[int]:
        return [0] * len(self._inputs)


def channels(node: SimulatedNode) -> tuple[list[Channel], list[Channel]]:
    """Return inputs and outputs of the node as channels of the C library's bench."""
    inputs, outputs = ([Channel(*scale) for scale in scales] for scales in (node._inputs, node._outputs))
    return inputs, outputs


def damaged_seal(seal: Seal, draw: random.Random) -> Seal:
    """Return a seal of another key, or one whose opening or turn is one off."""
    field = draw.choice(("key", "opening", "turn"))
    if field == "key":
        return seal._replace(key=draw.randbytes(16))
    return seal._replace(**{field: getattr(seal, field) + draw.choice((-1, 1))})


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("key", [None, KEY], ids=["open", "keyed"])
def test_both_nodes_answer_alike(library: CDLL, seed: int, key: bytes | None):
    draw = random.Random(seed)
    options = UdpOptions(host="127.0.0.1", digital_inputs=2, digital_outputs=3, safe_v=1.5, park_slew_v_per_s=900.0)
    python = StillNode(options, ["x"], boot=BOOT, key=key)
    python._rig.advance_to = lambda _: None  # The plant stands still: only the protocol is tested.
    inputs, outputs = channels(python)
    answers = moves = refusals = 0
    with Bench(library) as c:
        assert c.start(inputs, outputs, (2, 3), hold_us=10_000_000, key=key, period_us=SHORTEST_PERIOD_US)
        sequence = {session: draw.choice((draw.getrandbits(32), 2**32 - 50)) for session in (0, 7, 8)}
        codes = [python.codes[0]]
        for step in range(STEPS):
            c.now_us += draw.choice((0, 1, 150, 999, 1000, 1700, 9_000)) + (60_000 if draw.random() < 0.02 else 0)
            c.poll()
            python.poll(c.now_us)
            assert python.codes == c.codes
            session, sender = draw.choice((7,) * 20 + (8, 0)), draw.choice((SENDERS[0],) * 30 + SENDERS[1:])
            sequence[session] += draw.choice((1,) * 40 + (0, -1, 200_000))
            number = sequence[session] + draw.choice((0,) * 40 + (200_001, 2**31))
            if draw.random() < 0.5:
                codes = [draw.choice((draw.randint(-(2**23), 2**23 - 1),) * 9 + (2**23, outputs[0].safe))]
            hold_us = draw.choice((20_000,) * 20 + (0, 2**32 - 1))
            flags = draw.choice(FLAGS)
            if flags & OPEN and not python._session:
                number = sequence[session] = sequence[session] % 2**32
            opening = c.counters.sessions - (not flags & OPEN or python._session == session)
            seal = Seal(key, BOOT, opening, number // 2**32)
            seal = damaged_seal(seal, draw) if key and draw.random() < 0.1 else seal
            count, digital = draw.choice((1,) * 30 + (2,)), draw.getrandbits(16)
            frame = drive(session, number, flags, codes * count, digital, hold_us, seal)
            if draw.random() < 0.1:
                frame = hello(session, draw.choice((2, 2, 1)), number)
            if draw.random() < 0.1:
                place = draw.randrange(len(frame))
                frame = frame[:place] + bytes([frame[place] ^ 1 << draw.randrange(8)]) + frame[place + 1 :]
            before = list(python.codes)
            c.set_inputs([0], python.digital)
            expected, actual = python.receive(frame, sender, c.now_us) or b"", c.send_bytes(frame, sender)
            assert actual == expected, (step, flags, session, sender)
            assert (python.codes, python.digital & 7) == (c.codes, c.digital & 7)
            assert c.counters[:3] == (python.invalid, python.old, python.refused)
            assert c.counters.foreign == python.foreign
            answers, moves, refusals = answers + bool(actual), moves + (before != python.codes), python.refused
    assert min(answers, moves, refusals) > STEPS // 50
    assert (python.foreign > STEPS // 50) is (key is not None)
