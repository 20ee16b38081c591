"""A run that begins in closed loop enters it as at a change of mode: the first command does not bump."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.workbench.other_law import make_trust, replay_on_the_rig
from tests.engine.harness import LoopBench, make_plan
from tests.laws.lab_stage import FEED, FEED_WITHOUT_ENTER, own_law, stage
from tests.recording.real_loop import ROOT, RealLoop, RecordedRun

HOLD = 'kind = "hold"\nvalue = 60.0'
LATER, TICKS = 37, 1500
SHIPPED = ("paper", "laws/pid", "laws/integral-resonant", "laws/positive-position", "laws/coupled", "laws/repetitive")
KICKING = own_law(
    "s.integral_um + c.feed * (told.reference_um + 20.0 * (told.reference_um - s.last_um))",
    "s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um\ns.last_um = told.reference_um",
    "s.last_um = told.reference_um\ns.integral_um = told.command_um - c.feed * told.reference_um",
    state="last_um",
)


def lab(folder: Path, law: str, noise_um: float = 0.003, mode: str = "closed_loop", schedule: str = "") -> str:
    """Write the law to `lab.py` and return the configuration of the stage with a reference of 60 µm from the start."""
    (folder / "lab.py").write_text(law)
    text = stage('file = "lab.py"', HOLD, noise_um) + schedule
    return text.replace("[loop]\n", f'[loop]\nmode = "{mode}"\n')


def change_to_closed_loop(tick: int) -> str:
    return f'[[schedule]]\nat_tick = {tick}\nmode = "closed_loop"\n'


@pytest.mark.parametrize("law", [FEED, FEED_WITHOUT_ENTER, KICKING], ids=["feed", "without enter", "lead"])
def test_the_first_command_does_not_bump(law: str, tmp_path: Path) -> None:
    """Over one tick the error decays by T/bump_s = 1/200; the lead of 20 ticks makes up to 21 times as much of it."""
    bench = LoopBench(make_plan(lab(tmp_path, law), tmp_path))
    rows = bench.run(2 * TICKS)
    assert len(rows) == 2 * TICKS
    assert not bench.trips()
    command_um = bench.column(rows, "x_command_um")
    assert abs(command_um[0]) < 0.05
    largest_um = 60.0 * (0.8 * (21 if law == KICKING else 1)) / 200
    assert np.abs(np.diff(command_um)[:20]).max() < 1.2 * largest_um
    assert abs(command_um[-1] - 60.0) < 6.0


def signals_from(bench: LoopBench, tick: int, names: list[str]) -> np.ndarray:
    rows = bench.run(tick + TICKS)
    return np.stack([bench.column(rows, name)[tick:] for name in names])


@pytest.mark.parametrize("law", [FEED, FEED_WITHOUT_ENTER, KICKING], ids=["feed", "without enter", "lead"])
def test_a_start_is_an_entry(law: str, tmp_path: Path) -> None:
    """Without noise, the ticks from a start are, to the bit, those from a change of mode out of rest."""
    names = [f"x_{name}" for name in ("position_um", "error_um", "command_um", "demand_v", "drive_v")]
    start = LoopBench(make_plan(lab(tmp_path, law, noise_um=0.0), tmp_path))
    expected = lab(tmp_path, law, noise_um=0.0, mode="off", schedule=change_to_closed_loop(LATER))
    np.testing.assert_array_equal(
        signals_from(start, 0, names), signals_from(LoopBench(make_plan(expected, tmp_path)), LATER, names)
    )


def test_a_change_before_the_first_tick_is_an_entry(tmp_path: Path) -> None:
    """A schedule that closes the loop at tick 0 does the same as the mode of the configuration."""
    scheduled = lab(tmp_path, FEED, mode="off", schedule=change_to_closed_loop(0))
    np.testing.assert_array_equal(
        signals_from(LoopBench(make_plan(scheduled, tmp_path)), 0, ["x_command_um"]),
        signals_from(LoopBench(make_plan(lab(tmp_path, FEED), tmp_path)), 0, ["x_command_um"]),
    )


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_laws_enter_and_replay(name: str, tmp_path: Path) -> None:
    """With a reference far from the position, the first command stays where the output is."""
    text = (ROOT / "deploy" / f"{name}.toml").read_text()
    parts = text.split("[axis.reference]\n")
    text = parts[0] + "".join(
        '[axis.reference]\nkind = "hold"\nvalue = 8.0\n' + part[part.find("\n[") :] for part in parts[1:]
    )
    recorded = RecordedRun(tmp_path / "run.mcap", text, paced=False)
    recorded.run_to(TICKS)
    recorded.loop.end()
    recorded.session.finish("finished")
    recording = load(recorded.path)
    for axis in recording.header["axes"]:
        assert abs(recording[f"{axis}_command_um"][0]) < 0.05
        assert abs(recording[f"{axis}_position_um"][-100:].mean() - 8.0) < 1.0
    report = replay(recording)
    assert report.identical
    assert report.ticks == TICKS


def record_lab(folder: Path, *, as_before: bool) -> Path:
    """Record the law with a feed; `as_before`: begun without an entry, as the loop of version 0.2.0 began."""
    text = lab(folder, FEED).replace("value = 60.0", "value = 10.0")
    recorded = RecordedRun.__new__(RecordedRun)
    recorded.path, recorded.loop = folder / "run.mcap", RealLoop(text, folder)
    if as_before:
        recorded.loop.law.axes["entering"], recorded.loop.law.axes["tap_index"] = 0, 0
    recorded.header = {**recorded.loop.header, "paced": False}
    recorded.begin()
    recorded.run_to(TICKS)
    recorded.loop.end()
    recorded.session.finish("finished")
    return recorded.path


@pytest.mark.parametrize("as_before", [False, True], ids=["with an entry", "without"])
def test_recordings_replay_whether_they_began_with_an_entry_or_not(as_before: bool, tmp_path: Path) -> None:
    path = record_lab(tmp_path, as_before=as_before)
    recording, trust = load(path), make_trust([tmp_path / "lab.py"], False)
    assert (abs(recording["x_command_um"][0]) > 7.0) == as_before
    report = replay(recording, trust=trust)
    assert report.identical
    assert report.ticks == TICKS
    [axis] = replay_on_the_rig([path], None, trust=trust)["axes"]
    assert axis["resimulated"] == axis["recorded"]
