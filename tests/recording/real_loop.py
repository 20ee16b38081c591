"""A real law on the simulated rig in the test's own process, recorded there or by the recorder's process."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.engine.assembly import Assembly, law_at_rest
from rtloop.engine.clock import clock_context, unpaced_clock
from rtloop.engine.memory import ProcessState, SharedBlock, Word
from rtloop.recording.capture.session import Options, Session
from rtloop.supervision.description import recording_header

ROOT = Path(__file__).resolve().parents[2]
PAPER = (ROOT / "deploy" / "paper.toml").read_text()
TWO_AXES = (ROOT / "deploy" / "two-axis.toml").read_text()
BURST_TICKS = 2_000
UNLIMITED_SLACK = 1 << 62


def scheduled() -> str:
    """The paper's loop with saturation, slew limits, changes of mode, a trip, its reset and another reference."""
    entries = [
        (3_000, 'mode = "feedforward"'),
        (5_000, 'mode = "closed_loop"'),
        (7_000, 'mode = "off"'),
        (7_400, 'mode = "closed_loop"'),
        (9_000, 'reference = { kind = "steps", levels = [55.0, -70.0], dwell_s = 0.1 }'),
        (14_000, "reset_trip = true"),
        (14_001, 'reference = { kind = "sine", amplitude = 20.0, frequency_hz = 5.0 }'),
        (14_001, 'mode = "closed_loop"'),
    ]
    text = changed(
        ("# slew_v_per_s = 20000.0 ", "slew_v_per_s = 20000.0 "),
        ("command_um = 42.0", "command_um = 30.0"),
        ("position_um = 60.0", "position_um = 28.0"),
    )
    return text + "".join(f"\n[[schedule]]\nat_tick = {tick}\n{what}\n" for tick, what in entries)


def changed(*changes: tuple[str, str]) -> str:
    """The paper's configuration with some text replaced."""
    text = PAPER
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


class RealLoop:
    """The compiled loop of a configuration in virtual time, which waits for nobody."""

    def __init__(self, text: str, folder: Path = ROOT / "deploy") -> None:
        self.prepared = prepare(parse(text, "test", folder, "test"), paced=False)
        plan = self.prepared.plan
        self.block = SharedBlock.create(plan.sizes)
        os.set_inheritable(self.block.fd, True)
        self.block.store(Word.LOOP_STATE, ProcessState.RUNNING)
        self._context = clock_context(plan.pacing.rate_hz)
        head = self.block.ring("ticks").head
        clock = unpaced_clock(self._context, head, self.block["words"], Word.RECORDER_CURSOR, UNLIMITED_SLACK)
        self._driver = plan.driver()
        facts, self.law = self._driver.facts, law_at_rest(plan)
        self._assembly = Assembly(plan, self.block, facts, self._driver.open(), clock, self.law)
        self.header = recording_header(self.prepared, {})

    @property
    def tick(self) -> int:
        """Ticks executed."""
        return int(self._assembly.loop.tick)

    def take_snapshots_every(self, ticks: int) -> None:
        """Another distance than a second's."""
        self._assembly.loop.snapshot_ticks = ticks

    def run(self, ticks: int) -> None:
        """Execute `ticks` more."""
        self._assembly.run(self.tick + ticks)

    def end(self) -> None:
        """Say that the loop is over."""
        self.block.store(Word.LOOP_STATE, ProcessState.FINISHED)


def record(path: Path, text: str, ticks: int, **options: float) -> list[Path]:
    """Record a loop of `ticks` ticks without losing one; the finished files."""
    loop = RealLoop(text)
    session = Session(loop.block, path, loop.header, Options(min_free_bytes=0, **options))  # type: ignore[arg-type]
    while loop.tick < ticks:
        loop.run(min(BURST_TICKS, ticks - loop.tick))
        while session.cursor < loop.tick:
            session.drain()
            session.write_due()
    totals = session.finish("finished")
    assert (totals["ticks_logged"], totals["complete"]) == (ticks, True), totals
    return [Path(name) for name in totals["paths"]]


def rows_of(paths: list[Path]) -> np.ndarray:
    """All records of some files, in order."""
    from rtloop.recording.load import load

    return np.concatenate(list(load(paths).blocks()))
