"""Play of a drawn world: its actions at their times, its invariants at each tick and answer."""

from __future__ import annotations

import logging
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from tests.worlds.board import Board
from tests.worlds.invariants import Invariants, Violation
from tests.worlds.schedule import ACTORS, DISK_ERRORS, DISTURBING, UM_PER_V, Action, Draw, draw_world
from tests.worlds.world import Request, World

LAG = 0.18
"""Share of the way to its rest that a board's axis covers in a tick."""
CONTROLLER = {"form": "zpk", "poles": [[0.0, 0.0]]}


@dataclass
class Outcome:
    """Result of a world: its first violation or error, None without one."""

    seed: int
    failure: str | None
    digest: str = ""
    virtual_s: float = 0.0
    ticks: int = 0
    answers: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    codes: Counter[str] = field(default_factory=Counter)


def play(seed: int, actions: Sequence[Action] | None = None) -> Outcome:
    """Play the world of a seed, with all its actions or only some of them."""
    logging.disable(logging.CRITICAL)
    draw = draw_world(seed)
    actions = draw.actions if actions is None else actions
    world = World(draw, seed, Board(UM_PER_V[: len(draw.axes)], LAG))
    invariants, failure, begin_s = Invariants(world, draw.text, draw.lock_timeout_s), None, world.turns.now_s
    world.on_stretch, world.on_begin = invariants.on_stretch, invariants.flush
    actors = [partial(_act, world, draw, name, actions, invariants) for name in (*ACTORS, "fault")]
    try:
        world.live(actors, draw.seconds)
        invariants.at_end(any(action.kind in DISTURBING for action in actions))
    except Violation as violation:
        failure = str(violation)
    except Exception as error:
        failure = "".join(traceback.format_exception(error, limit=-3)).strip()
    finally:
        world.close()
        logging.disable(logging.NOTSET)
    faults = Counter(action.kind for action in actions if action.actor == "fault")
    codes = Counter(f"{request.path} {request.code}" for request in world.requests)
    return Outcome(seed, failure, world.digest(), world.turns.now_s - begin_s, invariants.ticks, invariants.answers,
                   faults, codes)  # fmt: skip


def _act(world: World, draw: Draw, name: str, actions: Sequence[Action], invariants: Invariants) -> None:
    """Do the actions of one actor, each at its time or after the one before."""
    begin_s = world.turns.now_s
    for action in actions:
        if action.actor == name and world.error is None:
            world.turns.sleep(max(begin_s + action.at_s - world.turns.now_s, 0.0))
            if name == "fault":
                _fail(world, draw, action)
            else:
                request = _request(world, draw, action)
                with world.turns.undivided():
                    invariants.on_answer(request)


def _request(world: World, draw: Draw, action: Action) -> Request:
    """Send the request of an action."""
    send: Callable[..., Request] = partial(world.request, action.actor.split("/")[0])
    match action.kind, action.values:
        case "closed" | "raw", ():
            return send("POST", "/mode", {"mode": {"closed": "closed_loop"}.get(action.kind, action.kind)})
        case "trip", ():
            return send("POST", "/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 0.1}})
        case "setpoint" | "hold", (axis, value):
            return send("POST", "/setpoint", {"axis": axis, "value": value})
        case "reference", (axis, amplitude, hertz):
            reference = {"kind": "sine", "amplitude": amplitude, "offset": 2.0, "frequency_hz": hertz}
            return send("POST", "/reference", {"axis": axis, "reference": reference})
        case "waveform", (axis, count, height, repeat):
            samples = [height + 0.01 * (len(world.requests) % 50) + 0.001 * (k % 7) for k in range(count)]
            return send("POST", "/waveform", {"axis": axis, "samples": samples, "repeat": repeat})
        case "mode", (mode,):
            return send("POST", "/mode", {"mode": mode})
        case "tune", (axis, section, value):
            values = {"position_um": value} if section == "interlocks" else {"gain": value}
            return send("POST", "/tune", {"axis": axis, "section": section, "values": values})
        case "limits", (axis, value):
            return send("POST", "/tune", {"axis": axis, "section": "limits", "values": {"command_um": 4 * value}})
        case "controller", (axis, gain):
            return send("POST", "/controller", {"axis": axis, "controller": CONTROLLER | {"gain": gain}})
        case "undo", (axis,):
            return send("POST", "/undo", {"axis": axis})
        case "reload", (change,):
            _write_configuration(world, draw, change)
            return send("POST", "/reload")
        case "lock", ():
            return send("POST", "/lock", {})
        case "unlock", ():
            return send("DELETE", "/lock")
        case "key", (key,):
            return send("POST", "/lock", {"emergency_key": key})
        case "response", (axis, gone_after_s):
            return send("POST", "/response", {"axis": axis, "duration_s": 1.0, "amplitude_um": 0.5}, gone_after_s)
        case "learn", (axis,):
            samples = [2.0 + 0.2 * (k % 50) / 50 for k in range(100)]
            return send("POST", "/learn", {"axis": axis, "samples": samples, "cycles": 2})
        case "status", ():
            return send("GET", "/status")
        case "hostile", (number,):
            return send("POST", *_hostile(number))
        case kind, _:
            return send("POST", f"/{kind}")


def _hostile(number: int) -> tuple[str, Any]:
    """Return a request that no client may send, with its path."""
    return (
        ("/setpoint", b"{"),
        ("/setpoint", {"axis": "x", "value": "NaN", "more": 1}),
        ("/setpoint", {"axis": "z", "value": 1.0}),
        ("/mode", {"mode": "fast"}),
        ("/waveform", {"axis": "x", "samples": [1e300, 2.0]}),
        ("/tune", {"axis": "x", "section": "driver", "values": {"kind": "shm"}}),
    )[number]


def _write_configuration(world: World, draw: Draw, change: str) -> None:
    """Write a changed configuration in place of the file of the service."""
    text = draw.text.replace("FOLDER", str(world.folder))
    if change == "gain":
        text = text.replace("gain = 20.0", "gain = 30.0").replace("gain = 60.0", "gain = 50.0")
    elif change == "invalid":
        text = text.replace("bump_s = 0.005", "bump_s = -1.0")
    elif change == "no recover":
        text = text.split("[service.recover]")[0] + "[recording]" + text.split("[recording]")[1]
    world.config.write_text(text)


def _fail(world: World, draw: Draw, action: Action) -> None:
    """Let a fault happen, for its duration."""
    board, (value,) = world.board, action.values
    attributes: dict[str, tuple[str, Any, Any]] = {
        "old sample": ("age_us", 5000.0, 0.0), "nan": ("replacement_v", float("nan"), None),
        "jump": ("jump_um", 15.0, 0.0), "read error": ("refuses_read", True, False),
        "write error": ("refuses_write", True, False), "card gone": ("is_gone", True, False),
    }  # fmt: skip
    if action.kind in attributes:
        name, bad, good = attributes[action.kind]
        setattr(board, name, bad)
        world.turns.sleep(value)
        setattr(board, name, good)
    elif action.kind.endswith("hang"):
        world.hangs_until_s = world.turns.now_s + value
    elif action.kind == "loop death":
        if world.running is not None:
            world.running.kill()
    elif action.kind == "recorder death":
        for child in world.recorders:
            child.kill()
    elif action.kind in DISK_ERRORS:
        world.disk_error = DISK_ERRORS[action.kind]
        world.turns.sleep(value)
        world.disk_error = None
    elif action.kind == "reload by signal":
        _write_configuration(world, draw, "gain" if value > 0.3 else "same")
        world.signals_s.append(world.turns.now_s)
        world.service.request_reload()
    else:
        world.cut_write = value, action.kind == "death in write"
