"""Draw of a world: its configuration, the requests of its clients and its faults, from a seed alone."""

from __future__ import annotations

import errno
import hashlib
import random
from dataclasses import dataclass
from typing import Any

RATE_HZ = 1000.0
KEY = "open sesame"
CLIENTS = ("ann", "ben", "")
"""Two clients with a name, and one without, as a page; each has some threads, the actors NAME/NUMBER."""
ACTORS = tuple(f"{client}/{number}" for client in CLIENTS for number in (1, 2, 3))
HEAD = """
[loop]
rate_hz = 1000
mode = "{mode}"
[driver]
kind = "sim"
"""
CHANNEL = """
[driver.channels.{axis}]
input = "adc{number}"
output = "dac{number}"
um_per_v = 10.0
"""
AXIS = """
[[axis]]
name = "{axis}"
[axis.feedforward]
thresholds_v = [0.0]
weights_um_per_v = [{um_per_v}]
[axis.controller]
form = "zpk"
gain = {gain}
poles = [[0.0, 0.0]]
[axis.model]
form = "zpk"
gain = 200.0
poles = [[-200.0, 0.0]]
[axis.limits]
drive_v = {drive_v}
bump_s = 0.005
slew_v_per_s = {slew}
trip_slew_v_per_s = {trip_slew}
[axis.interlocks]
sample_age_us = 1000.0
position_um = 30.0
[axis.reference]
kind = "{kind}"
"""
SINE = "amplitude = 1.0\noffset = 3.0\nfrequency_hz = 5.0\n"
SERVICE = """
[service]
arm = {arm}
stall_ms = {stall}
restarts = 100
emergency_key_sha256 = "{key}"
{tare}
{recover}
[recording]
folder = "FOLDER/recordings"
min_free_mib = 0.0
{rotate}
"""
RECOVER = """
[service.recover]
wait_s = 0.2
confirmations = 2
confirmation_s = 0.05
max_per_hour = {count}
"""
UM_PER_V = (4.0, 2.0)


@dataclass(frozen=True)
class Action:
    """A request of a client, or a fault, at a time (s since the world's begin)."""

    at_s: float
    actor: str
    kind: str
    values: tuple[Any, ...] = ()

    def __str__(self) -> str:
        return f"{self.at_s:8.3f} s  {self.actor:6} {self.kind} {' '.join(map(repr, self.values))}"


@dataclass(frozen=True)
class Draw:
    """All that a seed draws, but the interleaving."""

    text: str
    axes: tuple[str, ...]
    seconds: float
    actions: tuple[Action, ...]
    lock_timeout_s: float
    preemption: float
    fine: float


def draw_world(seed: int) -> Draw:
    """Return the world of a seed."""
    draw = random.Random(f"{seed} world")
    axes = ("x",) if draw.random() < 0.6 else ("x", "y")
    text = _draw_text(draw, axes)
    seconds = draw.choice((4.0, 8.0, 16.0))
    actions = [*_draw_requests(draw, axes, seconds), *_draw_faults(draw, seconds)]
    actions.sort(key=lambda action: action.at_s)
    return Draw(text, axes, seconds, tuple(actions), draw.choice((1.0, 3.0, 60.0)), draw.choice((0.0, 0.005, 0.03)),
                draw.choice((0.0, 0.001, 0.005, 0.02)))  # fmt: skip


def _draw_text(draw: random.Random, axes: tuple[str, ...]) -> str:
    text = HEAD.format(mode=draw.choice(("closed_loop", "feedforward", "raw")))
    text += "".join(CHANNEL.format(axis=axis, number=number) for number, axis in enumerate(axes))
    for number, axis in enumerate(axes):
        is_sine = draw.random() < 0.6
        text += AXIS.format(
            axis=axis, um_per_v=UM_PER_V[number], gain=draw.choice((20.0, 60.0)), drive_v=draw.choice((6.0, 10.0)),
            slew=draw.choice((100.0, 400.0, 2000.0)), trip_slew=draw.choice((20.0, 200.0, 1000.0)),
            kind="sine" if is_sine else "hold",
        ) + (SINE if is_sine else "value = 3.0\n")  # fmt: skip
    is_armed_first = draw.random() < 0.5
    return text + SERVICE.format(
        arm=str(is_armed_first).lower(), key=hashlib.sha256(KEY.encode()).hexdigest(),
        stall=draw.choice((500.0, 5000.0)), tare=draw.choice(("", "tare_s = 0.1")),
        recover=RECOVER.format(count=draw.choice((1, 3, 20))) if draw.random() < 0.6 else "",
        rotate=draw.choice(("", "", "rotate_s = 2.0")),
    )  # fmt: skip


REQUESTS = {
    "start": 12, "stop": 8, "reset": 8, "arm": 8, "mode": 8, "setpoint": 8, "reference": 4, "waveform": 4, "tune": 4,
    "limits": 2, "controller": 2, "undo": 3, "reload": 3, "lock": 2, "unlock": 4, "key": 2, "response": 3, "learn": 2,
    "status": 3, "hostile": 2,
}  # fmt: skip
"""Requests and their weights."""


RECIPES = (
    ("arm", "start"), ("arm", "start"), ("reset", "arm", "start"), ("arm", "closed", "hold", "response"),
    ("arm", "closed", "hold", "learn"), ("start", "stop"), ("stop", "start"), ("tune", "undo"), ("tune", "tune"),
    ("setpoint", "waveform", "waveform"), ("reload", "tune"), ("closed", "raw", "closed"), ("unlock", "key"),
    ("hold", "setpoint", "reference"), ("stop", "stop"), ("arm", "start", "trip", "reset"),
)  # fmt: skip
"""Requests that follow each other, each at once, a little later, or from another thread of the client."""
PAUSES_S = (0.0, 0.0, 0.001, 0.005, 0.02, 0.1, 0.3)


def _draw_requests(draw: random.Random, axes: tuple[str, ...], seconds: float) -> list[Action]:
    """Return requests one by one and by recipes; most come from one client, so that its lock refuses few."""
    interval_s, at_s = draw.choice((0.15, 0.4, 1.0)), 0.0
    actions, busy_client = [], draw.choice(CLIENTS)
    while (at_s := at_s + draw.expovariate(1.0 / interval_s)) < seconds:
        client = busy_client if draw.random() < 0.85 else draw.choice(CLIENTS)
        single = draw.choices([*REQUESTS], [*REQUESTS.values()])
        kinds, begin_s = draw.choice(RECIPES) if draw.random() < 0.5 else single, at_s
        for kind in kinds:
            begin_s += 0.6 * (kind in ("response", "learn"))
            actor = f"{client}/{draw.choice((1, 1, 2, 3))}"
            actions.append(Action(round(begin_s, 4), actor, kind, _values(draw, kind, draw.choice(axes))))
            begin_s += draw.choice(PAUSES_S)
    return actions


def _values(draw: random.Random, kind: str, axis: str) -> tuple[Any, ...]:
    """Return the values of a request of this kind."""
    match kind:
        case "mode":
            return (draw.choice(("off", "raw", "feedforward", "closed_loop", "closed_loop")),)
        case "setpoint":
            return axis, draw.choice((-2.0, 0.5, 2.0, 4.0, 500.0))
        case "reference":
            return axis, draw.choice((0.5, 2.0)), draw.choice((1.0, 7.0, -3.0))
        case "waveform":
            return axis, draw.choice((10, 400)), draw.choice((1.0, 3.0)), draw.random() < 0.5
        case "tune":
            return axis, draw.choice(("interlocks", "controller")), draw.choice((-1.0, 5.0, 25.0, 40.0))
        case "limits":
            return axis, draw.choice((3.0, 6.0))
        case "controller":
            return axis, draw.choice((20.0, 40.0, 1e9))
        case "undo" | "learn":
            return (axis,)
        case "reload":
            return (draw.choice(("same", "gain", "invalid", "no recover")),)
        case "key":
            return (draw.choice((KEY, KEY, "wrong")),)
        case "hold":
            return axis, draw.choice((2.0, 3.0))
        case "response":
            return axis, draw.choice((None, 0.3, 2.0))
        case "hostile":
            return (draw.randrange(6),)
    return ()


FAULTS = ("old sample", "nan", "jump", "read error", "write error", "short hang", "hang", "long hang", "long hang",
          "loop death",
          "recorder death", "death in write", "disk full", "disk error", "short write", "card gone",
          "reload by signal", "reload by signal")  # fmt: skip


def _draw_faults(draw: random.Random, seconds: float) -> list[Action]:
    count = draw.choice((0, 1, 3, 6))
    actions = []
    for _ in range(count):
        kind = draw.choice(FAULTS)
        duration_s = {"short hang": (0.02, 0.3), "hang": (0.45, 0.55), "long hang": (0.7, 4.0)}.get(kind, (0.002, 0.6))
        values: tuple[Any, ...] = (round(draw.uniform(*duration_s), 4),)
        if kind in ("short write", "death in write"):
            values = (round(draw.random(), 3),)
        actions.append(Action(draw.uniform(0.3, seconds), "fault", kind, values))
    return actions


DISTURBING = ("loop death", "recorder death", "death in write", "disk full", "disk error", "short write")
"""Faults after which a recording may be incomplete."""
DISK_ERRORS = {"disk full": errno.ENOSPC, "disk error": errno.EIO}
