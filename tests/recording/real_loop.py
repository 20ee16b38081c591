"""A real law on the simulated rig in the test's own process, recorded there or by the recorder's process."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

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
NO_CHANGES: Mapping[str, Any] = MappingProxyType({})


def schedule(*entries: tuple[int, str]) -> str:
    """Return the configuration text of scheduled changes (tick, change)."""
    return "".join(f"\n[[schedule]]\nat_tick = {tick}\n{change}\n" for tick, change in entries)


def eventful_configuration() -> str:
    """Return the paper's configuration with limits that act, changes of mode, a trip, its reset, a new reference."""
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
    text = changed_configuration(
        ("# slew_v_per_s = 20000.0 ", "slew_v_per_s = 20000.0 "),
        ("command_um = 42.0", "command_um = 30.0"),
        ("position_um = 60.0", "position_um = 28.0"),
    )
    return text + schedule(*entries)


def changed_configuration(*changes: tuple[str, str]) -> str:
    """Return the paper's configuration with some text replaced; each old text must occur once."""
    text = PAPER
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


class RealLoop:
    """The compiled loop of a configuration in virtual time, which does not wait for a recorder."""

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
        """Number of executed ticks."""
        return int(self._assembly.loop.tick)

    def take_snapshots_every(self, ticks: int) -> None:
        """Set the number of ticks between snapshots (default: one second of ticks)."""
        self._assembly.loop.snapshot_ticks = ticks

    def run(self, ticks: int) -> None:
        """Execute `ticks` more ticks."""
        self._assembly.run(self.tick + ticks)

    def end(self) -> None:
        """Mark the loop as finished."""
        self.block.store(Word.LOOP_STATE, ProcessState.FINISHED)


class RecordedRun:
    """A run of a real law, recorded in the test's process, as a paced run by default; `header` changes the header."""

    session_class = Session

    def __init__(
        self, path: Path, text: str | None = None, header: Mapping[str, Any] = NO_CHANGES, *, paced: bool = True,
        **options: Any,
    ) -> None:  # fmt: skip
        self.path, self.loop = path, RealLoop(eventful_configuration() if text is None else text)
        self.header = {**self.loop.header, **header, "paced": paced}
        self.begin(**options)

    def begin(self, **options: Any) -> None:
        """Begin a session; a later session replaces a recorder that died."""
        options = {"min_free_bytes": 0, **options}
        self.session = self.session_class(self.loop.block, self.path, self.header, Options(**options))

    def run_to(self, tick: int) -> None:
        """Execute ticks and drain them all; data of more than a chunk is written, or lost."""
        while self.loop.tick < tick:
            self.loop.run(min(BURST_TICKS, tick - self.loop.tick))
            self.drain()

    def drain(self) -> None:
        """Drain all executed ticks into the session, and write the data that is due."""
        while self.session.cursor < self.loop.tick:
            self.session.drain()
            self.session.write_due()

    def copy_part(self, name: str, source: str | None = None) -> Path:
        """Copy the unfinished file, or `source` beside it, to `name`: a copy without the lock of this process."""
        copy = self.path.with_name(name)
        copy.write_bytes(self.path.with_name(source or f"{self.path.name}.part").read_bytes())
        return copy

    def end(self, tick: int = 0) -> dict[str, Any]:
        """Run to `tick` and finish the recording. Returns the totals."""
        self.run_to(tick)
        return self.session.finish("finished")


def record(path: Path, text: str, ticks: int, **options: float) -> list[Path]:
    """Record `ticks` ticks of a loop without a loss. Returns the paths of the finished files."""
    totals = RecordedRun(path, text, paced=False, **options).end(ticks)
    assert (totals["ticks_logged"], totals["complete"]) == (ticks, True), totals
    return [Path(name) for name in totals["paths"]]


def read_rows(paths: list[Path]) -> np.ndarray:
    """Return all rows (ticks, columns) of a recording's files."""
    from rtloop.recording.load import load

    return np.concatenate(list(load(paths).blocks()))
