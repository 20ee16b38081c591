"""A mistake in a law is a trip that names law, axis and tick, or is refused before the loop runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rtloop
from rtloop.engine.loop import Outcome
from rtloop.engine.messages import Kind
from rtloop.errors import ConfigError
from rtloop.recording.file.topics.events import law_label
from rtloop.recording.replay.laws import TrustedLaws
from rtloop.recording.replay.replay import replay
from rtloop.signals import Mode
from tests.engine.harness import AXIS, LoopBench, make_plan, text
from tests.laws.changing import HOLD as HOLD_5_UM
from tests.laws.changing import configuration
from tests.laws.failing import ENDLESS, ENDLESS_UM, FAILING, REFUSED
from tests.laws.failing import text as law_text
from tests.service.test_run import run

HOLD = '[axis.controller]\nfile = "mine.py"\n[axis.reference]\nkind = "hold"\nvalue = 5.0\n'
CANARY = 0xA5


def user_law_plan(folder: Path, law: str):
    """Return the plan of a loop with a law from a file."""
    (folder / "mine.py").write_text(law)
    return make_plan(text(AXIS, HOLD), folder)


@pytest.mark.parametrize("name", FAILING)
def test_it_trips_and_the_outputs_come_down(name, tmp_path):
    law, tick, sentence = FAILING[name]
    plan = user_law_plan(tmp_path, law)
    bench = LoopBench(plan)
    rows = bench.run(1000)
    assert bench.outcome is Outcome.DONE
    (trip,) = bench.trips([law_label(law.kind, law.file) for law in plan.laws])
    assert (trip["tick"], trip["what"]["causes"]) == (tick, ["law"])
    assert trip["what"]["reason"].startswith("x: law 'mine' (mine.py) ")
    assert sentence in trip["what"]["reason"]
    drive_v = bench.column(rows, "x_drive_v")
    assert np.all(np.abs(drive_v) <= 10.0)
    assert np.max(np.abs(np.diff(drive_v[tick:]))) <= 0.1 + 1e-12
    assert drive_v[tick] == drive_v[tick - 1]
    assert drive_v[-1] == 0.0
    assert set(bench.column(rows, "mode")[tick:]) == {float(Mode.OFF)}


@pytest.mark.parametrize("name", ["writes beyond its array", "writes before its array"])
def test_no_memory_but_its_own_is_written(name, tmp_path):
    """Bytes behind the law's state and all coefficients do not change."""
    bench = LoopBench(user_law_plan(tmp_path, FAILING[name][0]))
    law = bench.law.layout.laws[-1]
    room = bench.law.layout.slot_bytes("controller")[1]
    spare_bytes = bench.law.axes["controller"][0, law.state.itemsize : room]
    spare_bytes[:] = CANARY
    before = bench.law.coefficients.tobytes(), bench.law.axes["feedforward"].tobytes()
    bench.run(199)
    feedforward_state = bench.law.axes["feedforward"].tobytes()
    bench.run(50)
    assert np.all(spare_bytes == CANARY)
    assert bench.law.coefficients.tobytes() == before[0]
    assert feedforward_state != before[1]  # the loop ran


def test_after_a_reset_it_may_be_entered_again(tmp_path):
    """The state begins at zeros, without the values from before the trip."""
    bench = LoopBench(user_law_plan(tmp_path, FAILING["grows without bound"][0]))
    bench.run(400)
    bench.send(Kind.RESET_TRIP)
    bench.send(Kind.SET_MODE, Mode.CLOSED_LOOP)
    rows = bench.run(190)
    assert set(bench.column(rows, "mode")) == {float(Mode.CLOSED_LOOP)}
    assert np.all(np.isfinite(bench.column(rows, "x_command_um")))


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_before_anything_runs(name, tmp_path):
    law, sentence = REFUSED[name]
    with pytest.raises(ConfigError, match=sentence):
        user_law_plan(tmp_path, law)


@pytest.mark.system
def test_one_that_never_ends_is_killed_and_its_outputs_parked(tmp_path):
    """The recording before the failure is complete. `make faults` has the same on a board that outlives the run."""
    (tmp_path / "mine.py").write_text(ENDLESS)
    steps = f'[axis.reference]\nkind = "steps"\nlevels = [5.0, {ENDLESS_UM + 5.0}]\ndwell_s = 0.2\n'
    config, law = tmp_path / "lab.toml", '[axis.controller]\nfile = "mine.py"\n'
    tolerate_late_ticks = ("late_ticks = 10", "late_ticks = 0")
    text = configuration(law, [], model=False).replace(*tolerate_late_ticks)
    config.write_text(text.replace(HOLD_5_UM, steps))
    code, summary, sentence = run(config, "--duration", "3", "--out", tmp_path)
    assert code == 1
    assert "stood still and was killed; rtloop parked the outputs" in sentence
    assert (summary["ticks_logged"], summary["ticks_lost"]) == (2000, 0)
    report = replay(rtloop.load(summary["recording"]), trust=TrustedLaws(recorded=True))
    assert (report.ticks, report.first_difference) == (2000, None)


def test_a_law_without_enter_is_entered_without_a_bump(tmp_path):
    """The drive makes no larger step from raw at 3 V into closed loop than either mode does."""
    law = law_text().replace("    def enter(c, s, told):\n        s.integral_um = told.command_um\n", "")
    assert "enter" not in law
    bench = LoopBench(user_law_plan(tmp_path, law))
    bench.send(Kind.SET_REFERENCE, 0, 3.0)
    bench.send(Kind.SET_MODE, Mode.RAW)
    bench.run(2000)
    bench.send(Kind.SET_REFERENCE, 0, 5.0)
    bench.send(Kind.SET_MODE, Mode.CLOSED_LOOP)
    drive_v = bench.column(bench.run(4000), "x_drive_v")
    assert np.max(np.abs(np.diff(drive_v))) < 0.05
    assert abs(drive_v[0] - 3.0) < 0.05
