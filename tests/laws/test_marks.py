"""Marks: outputs that follow reference or position without a user law; references that a gate starts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rtloop
from rtloop.engine.messages import Kind
from rtloop.errors import ConfigError
from rtloop.recording.file.topics.validation import header_extras
from rtloop.recording.replay.replay import replay
from rtloop.signals import Mode
from tests.engine.harness import LoopBench, make_plan, prepare_text
from tests.recording.real_loop import PAPER, record

CHANNELS = """
[inputs.gate]
channel = "adc1"
[outputs.line]
channel = "dac1"
axis = "x"
mark = "rising"
max_v = 5.0
[outputs.busy]
channel = "dac2"
axis = "x"
mark = "moving"
max_v = 4.0
[outputs.far]
channel = "dac3"
axis = "x"
mark = "position"
level_um = 6.0
max_v = 3.0

[[axis]]"""
TRIANGLE = 'kind = "triangle"\namplitude = 10.0\nfrequency_hz = 5.0\n'
STAIRCASE = 'kind = "steps"\nlevels = [0.0, 4.0, 12.0, 8.0]\ndwell_s = 0.05\n'


def configuration(reference: str, *changes: tuple[str, str]) -> str:
    """Return the paper's loop with three marks and an input, each looped back, after replacements of texts."""
    text = PAPER[: PAPER.index("[axis.reference]")].replace('specification = "paper-spec.toml"', "")
    text = text.replace('kind = "sim"\n', 'kind = "sim"\nloopback = 3\n', 1).replace("\n[[axis]]", CHANNELS, 1)
    text = (
        "\n".join(line for line in text.splitlines() if not line.startswith("# ")) + "\n[axis.reference]\n" + reference
    )
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def test_marks_follow_reference_and_position(tmp_path: Path):
    bench = LoopBench(make_plan(configuration(TRIANGLE), tmp_path))
    rows = bench.run(4000)
    reference_um = bench.column(rows, "x_reference_um")
    rising = np.diff(reference_um, prepend=0.0) > 0
    np.testing.assert_array_equal(bench.column(rows, "line_v"), np.where(rising, 5.0, 0.0))
    assert 0.4 < rising.mean() < 0.6
    np.testing.assert_array_equal(bench.column(rows, "busy_v")[1:], 4.0)
    far = bench.column(rows, "x_position_um") >= 6.0
    np.testing.assert_array_equal(bench.column(rows, "far_v"), np.where(far, 3.0, 0.0))
    assert 0.1 < far.mean() < 0.3
    edges = np.flatnonzero(np.diff(bench.column(rows, "line_v")) > 0)
    np.testing.assert_allclose(np.diff(edges)[1:] * 1e-4, 0.2, atol=1e-9)  # it begins in the middle of a rising line


def test_a_step_is_marked_in_its_tick(tmp_path: Path):
    bench = LoopBench(make_plan(configuration(STAIRCASE), tmp_path))
    rows = bench.run(4000)
    steps_um = np.diff(bench.column(rows, "x_reference_um"), prepend=0.0)
    assert np.count_nonzero(steps_um) == 7
    np.testing.assert_array_equal(bench.column(rows, "busy_v"), np.where(steps_um != 0, 4.0, 0.0))
    np.testing.assert_array_equal(bench.column(rows, "line_v"), np.where(steps_um > 0, 5.0, 0.0))


def test_marks_are_low_where_outputs_are_off_and_with_a_voltage_as_reference(tmp_path: Path):
    bench = LoopBench(make_plan(configuration(TRIANGLE), tmp_path))
    bench.run(100)
    for mode, is_marked in ((Mode.FEEDFORWARD, True), (Mode.RAW, False), (Mode.OFF, False)):
        bench.send(Kind.SET_MODE, mode)
        rows = bench.run(300)[50:]
        assert bench.column(rows, "busy_v").any() == is_marked, mode


def test_a_replay_from_any_snapshot_has_the_same_marks(tmp_path: Path):
    recording = rtloop.load(record(tmp_path / "marks.mcap", configuration(TRIANGLE), 6000))
    assert recording["line_v"].max() == 5.0
    assert replay(recording).identical
    header = recording.header
    assert [(output.mark, output.level_um) for output in header_extras(header).outputs] == [
        (1, 0.0),
        (2, 0.0),
        (3, 6.0),
    ]
    for output in header["extras"]["outputs"]:  # as in recordings of earlier versions
        del output["mark"], output["level_um"]
    assert [output.mark for output in header_extras(header).outputs] == [0, 0, 0]


@pytest.mark.parametrize("state", ["high", "low"])
def test_a_gate_starts_and_holds_the_reference(tmp_path: Path, state: str):
    """The gate is the mark of the position, looped back: it is low at first."""
    changes = (
        ('[inputs.gate]\nchannel = "adc1"', '[inputs.gate]\nchannel = "adc3"'),
        ("rate_hz = 10000\n", f'rate_hz = 10000\nhold_input = "gate"\nhold_min_v = 2.0\nhold_while = "{state}"\n'),
        ("level_um = 6.0", "level_um = 0.5"),
    )
    levels = STAIRCASE.replace("[0.0, 4.0, 12.0, 8.0]", "[4.0, 12.0, 8.0]" if state == "low" else "[0.0, 4.0]")
    bench = LoopBench(make_plan(configuration(levels, *changes), tmp_path))
    rows = bench.run(4000)
    gate, reference_um = bench.column(rows, "gate_v") >= 2.0, bench.column(rows, "x_reference_um")
    held = gate if state == "high" else ~gate
    assert 0 < held.sum() < 4000
    elapsed = np.cumsum(~held) - (0 if held[0] else 1)
    elapsed[0] = 0
    values = np.array([4.0, 12.0, 8.0] if state == "low" else [0.0, 4.0])
    np.testing.assert_array_equal(reference_um, values[np.maximum(elapsed, 0) // 500 % values.size])


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("level_um = 6.0\n", "", "outputs.far.*level_um: missing"),
        ('mark = "moving"', 'mark = "moving"\nlevel_um = 1.0', "outputs.busy.*level_um: 1 µm"),
        ('mark = "moving"', 'mark = "falling"', "outputs.busy.mark"),
    ],
)
def test_a_wrong_mark_is_refused_by_name(tmp_path: Path, before: str, after: str, message: str):
    with pytest.raises(ConfigError, match=message):
        prepare_text(configuration(TRIANGLE, (before, after)), tmp_path)
