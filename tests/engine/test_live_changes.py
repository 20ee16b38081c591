"""Changes of a running law: its memory fits the new coefficients, whether they are more or fewer than before."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from rtloop.engine.loop import Outcome
from rtloop.engine.messages import Kind
from rtloop.kernel.memory import slot_view
from rtloop.kernel.reference import Generator
from rtloop.laws.shipped.prandtl_ishlinskii import COEFFICIENTS
from rtloop.signals import Mode
from tests.engine.harness import AXIS, CONTROLLER, IDEAL, LoopBench, text

ROOT = Path(__file__).resolve().parents[2]
LENGTHS = 0, 1, 3, 64, 128
SECTION = "[0.02, 0.04, 0.02, -1.56, 0.64]"
REFERENCE = '[axis.reference]\nkind = "hold"\nvalue = 20.0\n'


def prefilter(taps: int, sections: int = 0) -> str:
    """Return the section of a pre-filter: a moving average over `taps` ticks, then `sections` low-passes."""
    average = ", ".join([repr(1 / taps)] * taps) if taps else ""
    return f"[axis.prefilter]\ntaps = [{average}]\nsections = [{', '.join([SECTION] * sections)}]\n"


def configuration(taps: int, sections: int = 0, mode: str = "closed_loop") -> str:
    """Return the configuration of a loop that holds 20 µm behind such a pre-filter."""
    return text(IDEAL, AXIS, CONTROLLER, prefilter(taps, sections), REFERENCE, mode=mode)


OTHER_SECTION = configuration(0, 1).replace(SECTION, "[0.25, 0.5, 0.25, 0.0, 0.0]")
"""Configuration with a low-pass of another bandwidth, whose output would jump with the memory of SECTION."""


@pytest.mark.parametrize(
    ("before", "after"),
    [
        *((configuration(taps), configuration(new_taps)) for taps, new_taps in permutations(LENGTHS, 2)),
        *((configuration(5, count), configuration(7, added)) for count, added in permutations((0, 1, 2, 12), 2)),
        (configuration(0, 1), OTHER_SECTION),
    ],
)
def test_a_constant_reference_stays_where_it_is_under_any_other_prefilter(before: str, after: str):
    """The index into the taps also stays within their record."""
    bench = LoopBench(before)
    bench.run(3999)
    bench.load_law(after)
    bench.run(1)
    for _ in range(3):
        assert 0 <= int(bench.law.axes["tap_index"][0]) < 128
        rows = bench.run(170)
        np.testing.assert_allclose(bench.column(rows, "x_error_um") + bench.column(rows, "x_position_um"), 20.0)


def sine_through_taps(taps: str, command_taps: str) -> str:
    """Return the configuration of a loop that follows a sine through two rows of taps."""
    rows = f"[axis.prefilter]\ntaps = [{taps}]\ncommand_taps = [{command_taps}]\n"
    sine = '[axis.reference]\nkind = "sine"\namplitude = 15.0\nfrequency_hz = 20.0\n'
    return text(IDEAL, AXIS, CONTROLLER, rows, sine, mode="closed_loop")


@pytest.mark.parametrize(
    ("taps", "command_taps"),
    [("0.5, 0.5", "0.9"), ("0.2, 0.2, 0.2, 0.2, 0.2, 0.0, 0.0, 0.0, 0.0", "0.1, -0.1, 0.3"), ("1.0", "")],
)
def test_other_taps_take_over_without_a_jump(taps: str, command_taps: str):
    """The command of a sine makes no larger step at and after the change than before it."""
    bench = LoopBench(sine_through_taps("0.25, 0.25, 0.25, 0.25", "0.6, -0.1"))
    commands_um = bench.column(bench.run(4321), "x_command_um")
    before = np.diff(commands_um[1000:])
    bench.load_law(sine_through_taps(taps, command_taps))
    after = np.diff(bench.column(bench.run(3000), "x_command_um"), prepend=commands_um[-1])
    assert np.abs(after).max() < 1.1 * np.abs(before).max()
    assert np.abs(after[-500:]).max() > 0.1 * np.abs(before).max()


def test_sections_that_stay_the_same_go_on():
    """A change of another key leaves the filter alone: its outputs for a sine are the same to the last bit."""
    sine = '[axis.reference]\nkind = "sine"\namplitude = 15.0\nfrequency_hz = 20.0\n'
    parts = text(IDEAL, AXIS, CONTROLLER, prefilter(3, 2), sine, mode="off")
    changed, unchanged = LoopBench(parts), LoopBench(parts)
    rows = [bench.run(60) for bench in (changed, unchanged)]
    changed.load_law(parts + "[axis.limits]\ncommand_um = 33.0\n")
    rows = [bench.run(60) for bench in (changed, unchanged)]
    assert changed.law.coefficients["command_limit_um"][0] == 33.0
    targets = [bench.column(part, "x_error_um") + bench.column(part, "x_position_um")
               for bench, part in zip((changed, unchanged), rows, strict=True)]  # fmt: skip
    assert targets[0].tobytes() == targets[1].tobytes()


@pytest.mark.parametrize("axis", [0, 1])
def test_another_law_for_one_of_two_axes_leaves_the_other_as_it_is(axis: int):
    two_axes = (ROOT / "deploy" / "two-axis.toml").read_text()
    bench = LoopBench(two_axes)
    bench.run(5)
    before = bench.law.coefficients.copy()
    staged = before.copy()
    staged["command_limit_um"] = 31.0, 32.0
    bench.block["staged"][: staged.nbytes] = np.frombuffer(staged.tobytes(), np.uint8)
    bench.send(Kind.LOAD_LAW, 0.0, axis=axis)
    bench.run(5)
    assert Kind.REFUSED not in bench.kinds()
    assert bench.law.coefficients[axis].tobytes() == staged[axis].tobytes()
    assert bench.law.coefficients[1 - axis].tobytes() == before[1 - axis].tobytes()


@pytest.mark.parametrize("sections", [0, 2])
def test_a_closed_loop_is_entered_without_the_volts_that_the_taps_hold(sections: int):
    """The position reaches 20 µm without overshoot in closed loop after raw mode at −5 V."""
    bench = LoopBench(configuration(128, sections, mode="raw"))
    bench.send(Kind.SET_REFERENCE, Generator.HOLD, -5.0)
    bench.run(2000)
    bench.send(Kind.SET_REFERENCE, Generator.HOLD, 20.0)
    bench.send(Kind.SET_MODE, Mode.CLOSED_LOOP)
    rows = bench.run(6000)
    target_um = bench.column(rows, "x_error_um") + bench.column(rows, "x_position_um")
    np.testing.assert_allclose(target_um, 20.0)
    assert bench.column(rows, "x_position_um").max() < 20.5
    assert bench.column(rows, "x_position_um")[-1] == pytest.approx(20.0, abs=0.1)


@pytest.mark.parametrize(
    ("name", "value"),
    [("play_count", 255), ("order", 32), ("tap_count", 4096), ("section_count", 1000), ("row_stop", 255)],
)
def test_a_count_beyond_its_record_is_a_trip_and_not_a_write(name: str, value: int):
    """A forged count ends the run with LAW_FAILED; the reserved bytes and the mode do not change."""
    bench = LoopBench(configuration(4, 1))
    bench.run(100)
    bench.events()
    drive_v = float(bench.block["last_drive_v"][0])
    guard_bytes = bench.law.axes["reserved"].tobytes() + bench.law.state["mode"].tobytes()
    controller, plays = (bench.law.slot_record(0, slot, "coefficients") for slot in ("controller", "feedforward"))
    controller.coupled = 1
    forged = next(record for record in (controller, plays, bench.law.coefficients[0]) if name in record.dtype.names)
    forged[name] = value
    bench.run(10)
    assert bench.outcome is Outcome.LAW_FAILED
    assert bench.kinds() == [Kind.TRIPPED]
    assert bench.law.axes["reserved"].tobytes() + bench.law.state["mode"].tobytes() == guard_bytes
    assert bench.block["last_drive_v"][0] == pytest.approx(drive_v, abs=0.05)


def test_a_law_whose_counts_do_not_fit_is_refused_and_the_old_one_goes_on():
    bench = LoopBench(configuration(4, 1))
    bench.run(100)
    bench.events()
    forged = bench.law.coefficients.copy()
    slot_view(forged[0], "feedforward", COEFFICIENTS).play_count = 68
    bench.block["staged"][: forged.nbytes] = np.frombuffer(forged.tobytes(), np.uint8)
    bench.send(Kind.LOAD_LAW, 1.0, axis=0)
    bench.run(100)
    assert bench.outcome is Outcome.DONE
    assert bench.kinds() == [Kind.REFUSED]
    assert bench.law.slot_record(0, "feedforward", "coefficients").play_count == 16
