"""Random changes of a loop's law, of its numbers and of its mode, made between ticks by the code of the service.

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
"""The section of each controller of two axes: the shipped one, and the user law PAIR."""
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
    """Return a loop that holds 5 µm without a slew limit, with a controller's section and the loaded laws `standby`.

    It is the paper's loop, or the shipped one of two axes. Without `model` no margins are computed at a change, which
    then takes milliseconds.
    """
    if "\naxes =" in controller:
        text = TWO_AXES.replace(TOGETHER["coupled"], controller)
        for section in re.findall(r"\[axis\.reference\]\n.*?\n\n", text, re.DOTALL):
            text = text.replace(section, HOLD + "\n", 1)
        text = text.replace("rate_hz = 10000\n", f"rate_hz = 10000\n{_standby_line(standby)}", 1)
        return text if model else MODEL.sub("", text)
    start, end = PAPER.index("[axis.controller]"), PAPER.index("# Eq (5)")
    text = PAPER[:start] + controller + "\n" + PAPER[end:]
    text = text[: text.index("[axis.reference]")] + HOLD + text[text.index("# [[schedule]]") :]
    text = text.replace("rate_hz = 10000\n", f"rate_hz = 10000\n{_standby_line(standby)}", 1)
    text = text.replace('specification = "paper-spec.toml"', "")
    return text if model else MODEL.sub("", text)


def _standby_line(standby: Sequence[str]) -> str:
    """Return the line of a configuration that names the loaded laws."""
    names = ", ".join(f'"{name}"' for name in standby)
    return f"laws = [{names}]\n"


class Changes:
    """Random changes to a running law; `done` counts the changes by kind, `refused` the refused ones."""

    def __init__(self, live: LiveLaw, desk: Desk, chance: Random) -> None:
        self._live, self._desk, self._chance = live, desk, chance
        self.done: Counter[str] = Counter()
        self.refused = 0

    def kinds(self) -> Sequence[Callable[[], object]]:
        """Return the functions that each make one kind of change; the next change is drawn from them."""
        raise NotImplementedError

    def one(self) -> None:
        """Make the next random change."""
        kind = self._chance.choice(self.kinds())
        try:
            kind()
            self.done[kind.__name__.strip("_")] += 1
        except RtloopError:
            self.refused += 1


class LawChanges(Changes):
    """Changes of the running law's numbers, of the mode, and of the law.

    The first law of `sections` is loaded as often as all other laws together. Each change draws every number again, up
    to a quarter from its section's value. `of` counts for each law the changes during, from and to it.
    """

    def __init__(self, live: LiveLaw, desk: Desk, chance: Random, sections: dict[str, dict[str, Any]]) -> None:
        super().__init__(live, desk, chance)
        self._sections = sections
        self._running = next(iter(sections))
        self.of: Counter[str] = Counter()

    def kinds(self) -> Sequence[Callable[[], object]]:
        """Return the change of numbers twice; a single law has a third one in place of the change of law."""
        return (self._numbers, self._numbers, self._mode, self._law if len(self._sections) > 1 else self._numbers)

    def one(self) -> None:
        """Make the next change and count it for its laws."""
        before, done_before = self._running, self.done.total()
        super().one()
        self.of.update({before, self._running} if self.done.total() > done_before else ())

    def _numbers(self) -> None:
        """Load the running law with other numbers."""
        self._load(self._running)

    def _law(self) -> None:
        """Load another law than the running one."""
        names = [name for name in self._sections if name != self._running]
        self._load(self._chance.choice((names[0], self._chance.choice(names))))

    def _mode(self) -> None:
        """Set a mode that is drawn at random."""
        mode = self._chance.choice((Mode.CLOSED_LOOP, *Mode))
        self._desk.submit(Kind.SET_MODE, values=[float(mode)])

    def _load(self, name: str) -> None:
        """Load a law with random numbers."""
        section = {key: self._draw_value(key, value) for key, value in self._sections[name].items()}
        self._live.load_controller("x", section)
        self._running = name

    def _draw_value(self, key: str, value: Any) -> Any:
        """Return the value of a key times a random factor; other types than numbers stay the same."""
        factor = self._chance.uniform(0.8, 1.25)
        if key == "repeat_s":
            return round(value * factor, 4)  # a whole number of ticks
        if isinstance(value, float):
            return value * factor
        if key == "decoupling":
            return [[share * factor for share in row] for row in value]
        return round(value * factor) if isinstance(value, int) and not isinstance(value, bool) else value


class SteppedDesk(Desk):
    """Desk that runs a tick of the loop before it reads each answer."""

    def __init__(self, loop: RealLoop) -> None:
        super().__init__(loop.block)
        self._loop = loop

    def _answer(self, kind: Kind, identity: int, cursor: int, position: int) -> int:
        self._loop.run(1)
        return super()._answer(kind, identity, cursor, position)


def change_at_random(
    folder: Path, sections: dict[str, str], files: dict[Path, Options], *, seed: int, count: int, model: bool
) -> LawChanges:
    """Record random changes of laws, at least `count` of the first of `sections`, in each of `files`; return them."""
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
    """Largest distances (V) of the demand, before limits, from the drive of the previous tick.

    `at_change_v` is the largest in the ticks of changes in closed loop, `largest_v` the largest in all ticks of modes
    that drive. `limited` is the number of ticks with an active limit.
    """

    at_change_v: float
    largest_v: float
    limited: int


def drive_steps(recording: rtloop.Recording) -> Steps:
    """Return the largest steps of any axis in a recording of changes, after the loop has settled."""
    steps = [_steps_of_axis(recording, axis) for axis in recording.header["axes"]]
    return Steps(*(max(values) for values in zip(*steps, strict=True)))


def _steps_of_axis(recording: rtloop.Recording, axis: str) -> Steps:
    """Return the largest steps of one axis."""
    demand_v, drive_v, mode, flags = recording.read(f"{axis}_demand_v", f"{axis}_drive_v", "mode", "flags")
    step_v = np.abs(demand_v - np.concatenate([[0.0], drive_v[:-1]]))
    settled, changed = np.arange(step_v.size) > SETTLED, np.zeros(step_v.size, bool)
    changed[[event["tick"] for event in recording.events if event["kind"] in ("set_mode", "load_law")]] = True
    return Steps(
        float(step_v[changed & (mode == Mode.CLOSED_LOOP)].max()),
        float(step_v[settled & (mode != Mode.OFF)].max()),
        int(np.count_nonzero(flags.astype(int) & LIMITED)),
    )
