"""A replay finds what does not agree with the law, at the right tick, which is worked out here with numpy."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.kernel.layout import COEFFICIENTS
from rtloop.laws.shipped import transfer
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.replay.snapshots import first_difference
from tests.recording.real_loop import PAPER, TWO_AXES, RealLoop, record, rows_of, scheduled
from tests.recording.tamper import Rows, rewrite

TICKS = 25_000


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in which everything happens."""
    return record(tmp_path_factory.mktemp("gate") / "run.mcap", scheduled(), TICKS)[0]


def flip_bit(rows: Rows, tick: int, column: int) -> None:
    """Flip the lowest bit of one number."""
    for row in np.flatnonzero(rows[:, 0] == tick):
        rows.view(np.uint64)[row, column] ^= np.uint64(1)


def test_one_bit_of_one_input_is_found_at_its_tick(whole: Path, tmp_path: Path):
    recording = load(whole)
    column, volts = recording.columns.index("x_adc_v"), recording["x_adc_v"]
    nudged = (volts.view(np.uint64) ^ np.uint64(1)).view(np.float64)
    seen = np.flatnonzero((nudged * 10.0 != volts * 10.0) & (np.arange(TICKS) > 1_234))  # where rounding shows it
    tick = int(seen[0])
    path = rewrite(whole, tmp_path / "run.mcap", rows=lambda rows: flip_bit(rows, tick, column))
    found = difference(path)
    assert (found["tick"], found["signal"]) == (tick, "x_position_um")
    assert found["recorded"] == volts[tick] * 10.0
    assert found["replayed"] == nudged[tick] * 10.0


@pytest.mark.parametrize("signal_name", ["x_reference_um", "x_command_um", "x_drive_v", "x_demand_v"])
def test_one_bit_of_any_other_signal_is_found_at_its_tick(signal_name: str, whole: Path, tmp_path: Path):
    column = load(whole).columns.index(signal_name)
    path = rewrite(whole, tmp_path / "run.mcap", rows=lambda rows: flip_bit(rows, 20_111, column))
    assert difference(path)["tick"] == 20_111


def test_what_a_table_adds_to_the_command_is_an_input_whose_effect_is_judged(whole: Path, tmp_path: Path):
    column = load(whole).columns.index("x_feed_um")

    def add(rows: Rows) -> None:
        rows[rows[:, 0] == 20_111, column] += 0.01

    found = difference(rewrite(whole, tmp_path / "run.mcap", rows=add))
    assert (found["tick"], found["signal"]) == (20_111, "x_command_um")


@pytest.mark.parametrize(("signal_name", "by"), [("mode", -1.0), ("flags", 16.0)])
def test_another_mode_or_flag_is_found_at_its_tick(signal_name: str, by: float, whole: Path, tmp_path: Path):
    column = load(whole).columns.index(signal_name)

    def change(rows: Rows) -> None:
        rows[rows[:, 0] == 20_111, column] += by

    found = difference(rewrite(whole, tmp_path / "run.mcap", rows=change))
    assert (found["tick"], found["signal"]) == (20_111, signal_name)


def test_one_unit_in_the_last_place_of_a_coefficient_is_found(whole: Path, tmp_path: Path):
    offset = 8 + COEFFICIENTS.fields["um_per_v"][1]  # type: ignore[index]
    assert struct.unpack_from("<d", next(iter(load(whole).snapshots())).data, offset) == (10.0,)

    def nudge(data: bytearray) -> None:
        if int.from_bytes(data[:8], "little") == 0:
            struct.pack_into("<d", data, offset, np.nextafter(10.0, 11.0))

    volts = load(whole)["x_adc_v"]
    expected = int(np.flatnonzero(volts * np.nextafter(10.0, 11.0) != volts * 10.0)[0])
    found = difference(rewrite(whole, tmp_path / "run.mcap", law=nudge))
    assert (found["tick"], found["signal"]) == (expected, "x_position_um")


def test_a_coefficient_that_has_no_effect_yet_is_found_at_the_next_snapshot(whole: Path, tmp_path: Path):
    offset = 8 + COEFFICIENTS.fields["sample_age_limit_us"][1]  # type: ignore[index]

    def nudge(data: bytearray) -> None:
        if int.from_bytes(data[:8], "little") == 0:
            struct.pack_into("<d", data, offset, 123.0)

    found = difference(rewrite(whole, tmp_path / "run.mcap", law=nudge))
    assert (found["tick"], found["signal"]) == (10_000, "law.x.sample_age_limit_us")
    assert found["replayed"] == 123.0


@pytest.mark.parametrize(("shift", "found_at"), [(1, 5_000), (-1, 4_999)])
def test_a_command_shifted_by_one_tick_is_found_at_the_right_one(
    shift: int, found_at: int, whole: Path, tmp_path: Path
):
    def move(event: dict[str, Any]) -> None:
        if event["kind"] == "set_mode" and event["tick"] == 5_000:
            event["tick"] += shift

    found = difference(rewrite(whole, tmp_path / "run.mcap", event=move))
    assert (found["tick"], found["signal"]) == (found_at, "mode")


def test_a_rewritten_recording_is_identical_where_nothing_was_changed(whole: Path, tmp_path: Path):
    path = rewrite(whole, tmp_path / "run.mcap")
    assert rows_of([path]).tobytes() == rows_of([whole]).tobytes()
    report = replay(load(path))
    assert (report.identical, report.ticks) == (True, TICKS)


def test_another_layout_of_the_law_is_refused(tmp_path: Path):
    loop = RealLoop(PAPER)
    loop.header["law"]["sha256"] = "0" * 64
    path = tmp_path / "run.mcap"
    session = Session(loop.block, path, loop.header, Options(min_free_bytes=0))
    loop.run(100)
    session.drain()
    session.finish("finished")
    with pytest.raises(RecordingError, match="whose law is laid out differently"):
        replay(load(path))


def test_differences_of_state_are_named():
    loop = RealLoop(TWO_AXES)
    loop.run(1)
    data = bytes(loop.block["snapshots_slots"][0])[8:]
    other = bytearray(data)
    law = loop.law.layout
    within = COEFFICIENTS.itemsize + law.slot_bytes("feedforward")[0] + transfer.COEFFICIENTS.fields["b"][1]  # type: ignore[index]
    place = law.coefficients.itemsize + within + 8
    other[place] ^= 1
    name, recorded, replayed_value = first_difference(data, bytes(other), ["x", "y"], loop.law)
    assert name == "law.y.b[1]"
    assert recorded == struct.unpack_from("<d", data, place)[0] != replayed_value


def difference(path: Path) -> dict[str, Any]:
    found = replay(load(path)).first_difference
    assert found is not None
    return found
