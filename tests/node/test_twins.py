"""The node in C and the simulated node in Python, written separately from one document, answer with equal bytes."""

from __future__ import annotations

import random
from ctypes import CDLL

import pytest

from rtloop.drivers.node.options import UdpOptions
from rtloop.drivers.node.simulated import SimulatedNode
from tests.node.bench import BOOT, Bench
from tests.node.frames import ANSWER, APPLY, OPEN, PARK, Channel, drive, hello

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


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_both_nodes_answer_alike(library: CDLL, seed: int):
    draw = random.Random(seed)
    options = UdpOptions(host="127.0.0.1", digital_inputs=2, digital_outputs=3, safe_v=1.5, park_slew_v_per_s=900.0)
    python = StillNode(options, ["x"], boot=BOOT)
    python._rig.advance_to = lambda _: None  # The plant stands still: only the protocol is tested.
    inputs, outputs = channels(python)
    answers = moves = refusals = 0
    with Bench(library) as c:
        assert c.start(inputs, outputs, (2, 3), hold_us=10_000_000)
        sequence = {session: draw.getrandbits(32) for session in (0, 7, 8)}
        codes = [python.codes[0]]
        for step in range(STEPS):
            c.now_us += draw.choice((0, 1, 150, 999, 1000, 1700, 9_000)) + (60_000 if draw.random() < 0.02 else 0)
            c.poll()
            python.poll(c.now_us)
            assert python.codes == c.codes
            session, sender = draw.choice((7,) * 20 + (8, 0)), draw.choice((SENDERS[0],) * 30 + SENDERS[1:])
            sequence[session] = (sequence[session] + draw.choice((1,) * 20 + (0, 2**32 - 1, 2**31))) % 2**32
            if draw.random() < 0.5:
                codes = [draw.choice((draw.randint(-(2**23), 2**23 - 1),) * 9 + (2**23, outputs[0].safe))]
            hold_us = draw.choice((20_000,) * 20 + (0, 2**32 - 1))
            flags = draw.choice(FLAGS)
            frame = drive(
                session, sequence[session], flags, codes * draw.choice((1,) * 30 + (2,)), draw.getrandbits(16), hold_us
            )
            if draw.random() < 0.1:
                frame = hello(session, draw.choice((1, 1, 2)), sequence[session])
            if draw.random() < 0.1:
                place = draw.randrange(len(frame))
                frame = frame[:place] + bytes([frame[place] ^ 1 << draw.randrange(8)]) + frame[place + 1 :]
            before = list(python.codes)
            expected, actual = python.receive(frame, sender, c.now_us) or b"", c.send_bytes(frame, sender)
            if len(actual) > 60:  # A WELCOME also describes the board's converters.
                expected, actual = expected[:24] + expected[32:-4], actual[:24] + actual[32:-4]
            else:
                digital = slice(18, 20)  # The boards' digital inputs differ.
                if actual[2:3] == b"\x73":
                    expected, actual = (b[: digital.start] + b[digital.stop : -4] for b in (expected, actual))
            assert actual == expected, (step, flags, session, sender)
            assert (python.codes, python.digital & 7) == (c.codes, c.digital & 7)
            answers, moves, refusals = answers + bool(actual), moves + (before != python.codes), python.refused
    assert min(answers, moves, refusals) > STEPS // 50
