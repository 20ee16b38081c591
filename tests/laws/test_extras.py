"""Inputs and outputs beside sensors and drives: a law that reads and sets them, loopback, held references."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rtloop
from rtloop.engine.messages import Kind
from rtloop.errors import ConfigError
from rtloop.kernel.extras import ExtraOutput
from rtloop.recording.capture.session import Session
from rtloop.recording.replay.laws import TrustedLaws
from rtloop.recording.replay.replay import replay
from rtloop.signals import Mode
from tests.engine.harness import LoopBench, make_plan, prepare_text
from tests.laws.test_coupled import EXAMPLE as COUPLED
from tests.recording.real_loop import PAPER, Options, RealLoop

MINE = '''
from rtloop.laws import Controller
from rtloop.kernel.validity import Allowed

class Mine(Controller):
    """An integrator that gives a pulse of one tick wherever the position passes a multiple of `every_um`."""

    inputs = ("back",)
    outputs = ("pulse", "count")
    coefficients = {"ki": float, "every_um": float, "pulse": int, "count": int, "back": int}
    allowed_coefficients = {name: Allowed(0, 7) for name in ("pulse", "count", "back")}
    state = {"integral_um": float, "line": float, "passed": float, "seen": float}

    def build(self):
        return {"ki": 150.0 * self.period_s, "every_um": 2.0, **self.channels}

    def output(c, s, told):
        line = float(int(told.position_um / c.every_um + 1000.0))
        if line != s.line:
            told.outputs[c.pulse] = 5.0
            s.passed += 1.0
        s.line = line
        if told.inputs[c.back] > 2.5:
            s.seen += 1.0
        told.outputs[c.count] = 0.1 * s.seen
        return s.integral_um

    def update(c, s, told):
        s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um

    def enter(c, s, told):
        s.integral_um = told.command_um
'''
LOOPBACK = 'kind = "sim"\nloopback = 2\n'
CHANNELS = """
[inputs.spare]
channel = "adc2"
[inputs.back]
channel = "adc1"
[outputs.count]
channel = "dac2"
axis = "x"
max_v = 0.75
[outputs.pulse]
channel = "dac1"
axis = "x"
min_v = 0.0

[[axis]]"""


def configuration(*changes: tuple[str, str]) -> str:
    """Return the paper's loop with the law MINE and two channels looped back, after replacements of texts."""
    start, end = PAPER.index("[axis.controller]"), PAPER.index("# Eq (5)")
    text = PAPER[:start] + '[axis.controller]\nfile = "mine.py"\n' + PAPER[end:]
    text = text.replace('kind = "sim"\n', LOOPBACK, 1).replace("\n[[axis]]", CHANNELS, 1)
    text = text.replace('specification = "paper-spec.toml"', "")
    text = "\n".join(line for line in text.splitlines() if not line.startswith("# ")) + "\n"
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with the law MINE in `mine.py`."""
    (tmp_path / "mine.py").write_text(MINE)
    return tmp_path


def test_a_law_reads_and_sets_them(folder):
    """The law sets a pulse at each line that the position passes, reads it a tick later, and counts up to the limit."""
    prepared = prepare_text(configuration(), folder)
    plan = prepared.plan
    assert prepared.checks[0].running.stable  # pulses and count do not change the command, so the loop stays linear
    assert plan.extras.outputs == (ExtraOutput("count", 0, -10.0, 0.75, 0.0), ExtraOutput("pulse", 0, 0.0, 10.0, 0.0))
    bench = LoopBench(plan)
    rows = bench.run(3000)
    position_um, pulse_v = bench.column(rows, "x_position_um"), bench.column(rows, "pulse_v")
    lines = np.trunc(position_um / 2.0 + 1000.0)
    expected = np.flatnonzero(np.diff(lines, prepend=0.0))
    assert expected.size > 5
    np.testing.assert_array_equal(np.flatnonzero(pulse_v), expected)
    assert set(pulse_v[expected]) == {5.0}
    back_v = bench.column(rows, "back_v")
    np.testing.assert_array_equal(back_v[1:], pulse_v[:-1])
    counted = np.minimum(0.1 * np.cumsum(back_v > 2.5), 0.75)
    np.testing.assert_allclose(bench.column(rows, "count_v"), counted, atol=1e-12)
    np.testing.assert_array_equal(bench.column(rows, "spare_v")[1:], bench.column(rows, "count_v")[:-1])


def test_where_the_loop_is_not_closed_they_are_safe(folder):
    text = configuration(("max_v = 0.75", "min_v = -1.0"))
    bench = LoopBench(make_plan(text, folder))
    closed_rows = bench.run(500)
    assert bench.column(closed_rows, "count_v")[-1] > 0
    for mode in (Mode.FEEDFORWARD, Mode.OFF):
        bench.send(Kind.SET_MODE, mode)
        rows = bench.run(200)
        assert set(bench.column(rows, "count_v")) == {0.0}
        assert set(bench.column(rows, "pulse_v")) == {0.0}


def test_an_output_that_is_no_number_trips(folder):
    (folder / "mine.py").write_text(MINE.replace("= 0.1 * s.seen", "= 1e308 * 1e308"))
    bench = LoopBench(make_plan(configuration(), folder))
    rows = bench.run(50)
    assert set(bench.column(rows, "mode")[1:]) == {float(Mode.OFF)}
    assert set(bench.column(rows, "count_v")) == {0.0}
    assert (
        "law 'mine' returned inf from output of the controller" in bench.trips(["", "", "'mine'"])[0]["what"]["reason"]
    )


def test_a_replay_comes_to_the_same(folder):
    loop = RealLoop(configuration(), folder)
    session = Session(loop.block, folder / "extras.mcap", loop.header, Options(min_free_bytes=0))
    for _ in range(3):
        loop.run(2000)
        session.drain()
        session.write_due()
    loop.end()
    session.drain()
    session.finish("finished")
    recording = rtloop.load(folder / "extras.mcap")
    assert recording["count_v"].max() == 0.75
    report = replay(recording, trust=TrustedLaws(recorded=True))
    assert report.identical
    assert report.ticks == 6000


def test_references_stand_still_while_they_are_held(folder):
    """The gate is the law's output `pulse`, looped back."""
    text = configuration(
        ("rate_hz = 10000\n", 'rate_hz = 10000\nhold_input = "back"\nhold_min_v = 2.5\n'),
    )
    start = text.index("[axis.reference]")
    text = text[:start] + '[axis.reference]\nkind = "triangle"\namplitude = 10.0\nfrequency_hz = 5.0\n'
    bench = LoopBench(make_plan(text, folder))
    rows = bench.run(4000)
    held = bench.column(rows, "back_v") >= 2.5
    reference_um = bench.column(rows, "x_reference_um")
    assert held.sum() > 5
    steps = np.diff(reference_um)
    assert np.all(steps[held[1:]] == 0.0)
    assert np.all(steps[~held[1:]] != 0.0)
    elapsed_ticks = np.arange(4000) - np.cumsum(held)
    phase = np.modf(elapsed_ticks * 1e-4 * 5.0 + 0.25)[0]
    np.testing.assert_allclose(reference_um, 10.0 * np.where(phase < 0.5, 4 * phase - 1, 3 - 4 * phase), atol=1e-9)


def test_a_coupled_law_has_them_too(tmp_path):
    law = """
from rtloop.laws import CoupledController

class Mine(CoupledController):
    axes = 2
    outputs = ("sum",)
    coefficients = {"none": float}

    def build(self):
        return {"none": 0.0}

    def output(c, s, told):
        told.command_um[0] = 0.0
        told.command_um[1] = 0.0
        told.outputs[0] = 0.1 * (told.reference_um[0] + told.reference_um[1])

    def update(c, s, told):
        pass
"""
    (tmp_path / "mine.py").write_text(law)
    start, end = COUPLED.index("[axis.controller]\n"), COUPLED.index("[axis.model]")
    text = COUPLED[:start] + '[axis.controller]\nfile = "mine.py"\naxes = ["x", "y"]\n' + COUPLED[end:]
    text = text.replace('kind = "sim"\n', LOOPBACK, 1)
    text = text.replace("\n[[axis]]", '\n[outputs.sum]\nchannel = "dac3"\naxis = "y"\n\n[[axis]]', 1)
    bench = LoopBench(make_plan(text, tmp_path))
    rows = bench.run(5000)  # the offset of the first entry has decayed
    expected = 0.1 * (bench.column(rows, "x_reference_um") + bench.column(rows, "y_reference_um"))
    np.testing.assert_allclose(bench.column(rows, "sum_v")[-200:], expected[-200:], atol=0.01)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('channel = "adc1"', 'channel = "adc7"', "inputs.back.channel: 'adc7'"),
        ('channel = "dac1"', 'channel = "dac0"', "outputs.pulse.channel: 'dac0' is used by the drive of axis x"),
        ('channel = "dac1"', 'channel = "dac2"', "outputs.pulse.channel: 'dac2' is used by output count"),
        ("min_v = 0.0\n\n[[axis]]", "min_v = 1.0\n\n[[axis]]", "outputs.pulse: 1 … 10 V; .* safe voltage, 0 V"),
        ("max_v = 0.75", "max_v = 11.0", "outputs.count: -10 … 11 V"),
        ('channel = "dac1"\naxis = "x"', 'channel = "dac1"\naxis = "z"', "outputs.pulse.axis: 'z' is not an axis"),
        (
            "[inputs.back]",
            "[inputs.black]",
            "law 'mine' needs the input 'back' in .inputs.; available for this law: spare, black",
        ),
        ("[outputs.count]", "[outputs.spare]", "outputs.spare: an input has the same name"),
        ("[inputs.spare]", "[inputs.enable]", "inputs.enable: its column enable_v would have the name of a signal"),
        ("[inputs.spare]", "[inputs.x_drive]", "inputs.x_drive: its column x_drive_v would have the name of a signal"),
        ("rate_hz = 10000\n", 'rate_hz = 10000\nhold_input = "gate"\n', "hold_input: 'gate' is not among"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(folder, before, after, message):
    with pytest.raises(ConfigError, match=message):
        prepare_text(configuration((before, after)), folder)
