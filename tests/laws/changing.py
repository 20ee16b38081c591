"""A loop whose law, its numbers and its modes are changed at random by the code that a service uses, tick by tick.

The loop runs in the caller's process and in virtual time: the same seed gives the same recording.
"""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy as np

import rtloop
from rtloop.engine.messages import Kind
from rtloop.errors import RtloopError
from rtloop.recording.capture.session import Session
from rtloop.service.changing.building import builder_lifetime
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Desk
from rtloop.signals import Flag, Mode
from tests.recording.real_loop import PAPER, ROOT, Options, RealLoop

MODEL = re.compile(r"\[axis\.model\].*?(?=\n\[)", re.DOTALL)
CONTROLLERS = {
    "transfer": PAPER[PAPER.index("[axis.controller]") : PAPER.index("# Eq (5)")],
    **{
        tomllib.loads(section)["axis"]["controller"]["kind"]: section
        for path in sorted((ROOT / "deploy" / "laws").glob("*.toml"))
        for text in [path.read_text(encoding="utf-8")]
        for section in [text[text.index("[axis.controller]") : text.index("[axis.model]")]]
        if path.stem != "coupled"
    },
}
"""The section of each shipped controller of one axis, by its kind."""
TWO_AXES = (ROOT / "deploy" / "laws" / "coupled.toml").read_text(encoding="utf-8")
TOGETHER = {
    "coupled": TWO_AXES[TWO_AXES.index("[axis.controller]\n") : TWO_AXES.index("[axis.model]")],
    "pair": '[axis.controller]\nfile = "pair.py"\naxes = ["x", "y"]\nki_per_s = 100.0\nshared = 0.1\n\n',
}
"""The shipped one of several axes, and one of one's own (PAIR) beside it."""
PAIR = """
from rtloop.laws import ControllerOptions, CoupledController

class Options(ControllerOptions):
    ki_per_s: float = 100.0
    shared: float = 0.1

class Pair(CoupledController):
    axes = 2
    options_model = Options
    coefficients = {"ki": float, "shared": float}
    state = {"integral_um": (float, 2)}

    def build(self):
        return {"ki": self.options.ki_per_s * self.period_s, "shared": self.options.shared}

    def output(c, s, told):
        for i in range(2):
            told.command_um[i] = s.integral_um[i] - c.shared * s.integral_um[1 - i]

    def update(c, s, told):
        for i in range(2):
            s.integral_um[i] += c.ki * told.error_um[i] + told.applied_um[i] - told.command_um[i]
"""
HOLD = '[axis.reference]\nkind = "hold"\nvalue = 5.0\n'
SETTLED = 2000
APART = (1, 5, 50, 250, 1000)
"""Ticks from one change to the next."""
AT_CHANGE_V, MORE = 1e-9, 1.5
"""Allowed step of the demand in the tick of a change in closed loop; allowed step of any tick, in steps of C(z)."""
LIMITED = int(Flag.COMMAND_LIMITED | Flag.DRIVE_LIMITED | Flag.SLEW_LIMITED)


def configuration(controller: str, standby: Sequence[str], *, model: bool) -> str:
    """The paper's loop, holding 5 µm without a slew limit, with a controller and others standing by.

    Without its `model` there are no margins to find, and a change takes milliseconds.
    """
    if "\naxes =" in controller:
        text = TWO_AXES.replace(TOGETHER["coupled"], controller)
        for section in re.findall(r"\[axis\.reference\]\n.*?\n\n", text, re.DOTALL):
            text = text.replace(section, HOLD + "\n", 1)
        text = text.replace("rate_hz = 10000\n", f"rate_hz = 10000\n{_standing_by(standby)}", 1)
        return text if model else MODEL.sub("", text)
    start, end = PAPER.index("[axis.controller]"), PAPER.index("# Eq (5)")
    text = PAPER[:start] + controller + "\n" + PAPER[end:]
    text = text[: text.index("[axis.reference]")] + HOLD + text[text.index("# [[schedule]]") :]
    text = text.replace("rate_hz = 10000\n", f"rate_hz = 10000\n{_standing_by(standby)}", 1)
    text = text.replace('specification = "paper-spec.toml"', "")
    return text if model else MODEL.sub("", text)


def _standing_by(standby: Sequence[str]) -> str:
    names = ", ".join(f'"{name}"' for name in standby)
    return f"laws = [{names}]\n"


class Changes:
    """Random changes to a running law; `done` counts the changes by kind, `refused` the refused ones."""

    def __init__(self, live: LiveLaw, desk: Desk, chance: Random) -> None:
        self._live, self._desk, self._chance = live, desk, chance
        self.done: Counter[str] = Counter()
        self.refused = 0

    def kinds(self) -> Sequence[Callable[[], object]]:
        """Return the kinds of changes, from which the next is drawn."""
        raise NotImplementedError

    def one(self) -> None:
        """Make the next change."""
        kind = self._chance.choice(self.kinds())
        try:
            kind()
            self.done[kind.__name__.strip("_")] += 1
        except RtloopError:
            self.refused += 1


class LawChanges(Changes):
    """Numbers of the law that runs, modes, and another law: the first of `sections` as often as all others together.

    Every number is drawn anew, up to a quarter from what its section says. `of` counts the changes of each law: under
    which it ran, or which began or ended with it.
    """

    def __init__(self, live: LiveLaw, desk: Desk, chance: Random, sections: dict[str, dict[str, Any]]) -> None:
        super().__init__(live, desk, chance)
        self._sections = sections
        self._running = next(iter(sections))
        self.of: Counter[str] = Counter()

    def kinds(self) -> Sequence[Callable[[], object]]:
        """Numbers twice as often as the others; of one law alone there is no other."""
        return (self._numbers, self._numbers, self._mode, self._law if len(self._sections) > 1 else self._numbers)

    def one(self) -> None:
        """Make the next change and count it for its laws."""
        before, taken = self._running, self.done.total()
        super().one()
        self.of.update({before, self._running} if self.done.total() > taken else ())

    def _numbers(self) -> None:
        self._load(self._running)

    def _law(self) -> None:
        others = [name for name in self._sections if name != self._running]
        self._load(self._chance.choice((others[0], self._chance.choice(others))))

    def _mode(self) -> None:
        mode = self._chance.choice((Mode.CLOSED_LOOP, *Mode))
        self._desk.submit(Kind.SET_MODE, values=[float(mode)])

    def _load(self, name: str) -> None:
        section = {key: self._drawn(key, value) for key, value in self._sections[name].items()}
        self._live.load_controller("x", section)
        self._running = name

    def _drawn(self, key: str, value: Any) -> Any:
        factor = self._chance.uniform(0.8, 1.25)
        if key == "repeat_s":
            return round(value * factor, 4)  # a whole number of ticks
        if isinstance(value, float):
            return value * factor
        if key == "decoupling":
            return [[share * factor for share in row] for row in value]
        return round(value * factor) if isinstance(value, int) and not isinstance(value, bool) else value


class SteppedDesk(Desk):
    """Desk that executes a tick of the loop for each answer."""

    def __init__(self, loop: RealLoop) -> None:
        super().__init__(loop.block)
        self._loop = loop

    def _answer(self, kind: Kind, identity: int, cursor: int, position: int) -> int:
        self._loop.run(1)
        return super()._answer(kind, identity, cursor, position)


def change_at_random(
    folder: Path, sections: dict[str, str], files: dict[Path, Options], *, seed: int, count: int, model: bool
) -> LawChanges:
    """Record changes among the laws of `sections`, `count` of them of the first, in each of `files`."""
    first = next(iter(sections))
    standby = [f"{name}.py" if "file =" in section else name for name, section in sections.items()]
    loop, chance = RealLoop(configuration(sections[first], standby, model=model), folder), Random(seed)
    sessions = [Session(loop.block, path, loop.header, options) for path, options in files.items()]
    desk = SteppedDesk(loop)
    parsed = {name: tomllib.loads(section)["axis"]["controller"] for name, section in sections.items()}
    changes = LawChanges(LiveLaw(loop.prepared, loop.block, desk, {}), desk, chance, parsed)
    with builder_lifetime():
        loop.run(SETTLED)
        while changes.of[first] < count:
            changes.one()
            loop.run(chance.choice(APART))
            for session in sessions:
                session.drain()
                session.write_due()
    loop.end()
    for session in sessions:
        session.drain()
        session.finish("finished")
    return changes


class Steps(NamedTuple):
    """Distances of the demand from the drive in force, before limits, in modes that drive.

    The largest in the tick of a change in closed loop; the largest of any tick, from one change to the next too; ticks
    in which something was limited.
    """

    at_change_v: float
    largest_v: float
    limited: int


def steps_of(recording: rtloop.Recording) -> Steps:
    """Return the largest steps of any axis in a recording of changes, after the loop has settled."""
    steps = [_steps_of_axis(recording, axis) for axis in recording.header["axes"]]
    return Steps(*(max(values) for values in zip(*steps, strict=True)))


def _steps_of_axis(recording: rtloop.Recording, axis: str) -> Steps:
    demand_v, drive_v, mode, flags = recording.read(f"{axis}_demand_v", f"{axis}_drive_v", "mode", "flags")
    step_v = np.abs(demand_v - np.concatenate([[0.0], drive_v[:-1]]))
    settled, changed = np.arange(step_v.size) > SETTLED, np.zeros(step_v.size, bool)
    changed[[event["tick"] for event in recording.events if event["kind"] in ("set_mode", "load_law")]] = True
    return Steps(
        float(step_v[changed & (mode == Mode.CLOSED_LOOP)].max()),
        float(step_v[settled & (mode != Mode.OFF)].max()),
        int(np.count_nonzero(flags.astype(int) & LIMITED)),
    )
