"""A replay finds a difference from the law at the right tick, which is computed here with numpy."""

from __future__ import annotations

import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop.kernel.layout import COEFFICIENTS, LOOP_STATE
from rtloop.laws.shipped import transfer
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import load
from rtloop.recording.replay.replay import Replay, replay
from rtloop.recording.replay.snapshots import first_difference
from rtloop.signals import DEADLINE, PERIODS_MISSED
from tests.recording.conftest import EVENTFUL_TICKS
from tests.recording.real_loop import PAPER, TWO_AXES, RealLoop, RecordedRun, read_rows
from tests.recording.tamper import Rows, rewrite


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def difference(path: Path) -> dict[str, Any]:
    """Return the first difference of a replay; there must be one."""
    first = replay(load(path)).first_difference
    assert first is not None
    return first


def difference_place(path: Path) -> tuple[int, str]:
    """Return (tick, signal) of the first difference of a replay."""
    first = difference(path)
    return first["tick"], first["signal"]


def flip_bit(rows: Rows, tick: int, column: int) -> None:
    """Flip the lowest bit of a column at a tick, in place."""
    for row in np.flatnonzero(rows[:, 0] == tick):
        rows.view(np.uint64)[row, column] ^= np.uint64(1)


def test_one_bit_of_one_input_is_found_at_its_tick(eventful: Path, path: Path):
    recording = load(eventful)
    column, volts = recording.columns.index("x_adc_v"), recording["x_adc_v"]
    changed = (volts.view(np.uint64) ^ np.uint64(1)).view(np.float64)
    is_visible = (changed * 10.0 != volts * 10.0) & (np.arange(EVENTFUL_TICKS) > 1_234)  # After rounding.
    tick = int(np.flatnonzero(is_visible)[0])
    rewrite(eventful, path, rows=lambda rows: flip_bit(rows, tick, column))
    values = {"recorded": volts[tick] * 10.0, "replayed": changed[tick] * 10.0}
    assert difference(path) == {"tick": tick, "signal": "x_position_um", **values}


@pytest.mark.parametrize("signal_name", ["x_reference_um", "x_command_um", "x_drive_v", "x_demand_v"])
def test_one_bit_of_any_other_signal_is_found_at_its_tick(signal_name: str, eventful: Path, path: Path):
    column = load(eventful).columns.index(signal_name)
    rewrite(eventful, path, rows=lambda rows: flip_bit(rows, 20_111, column))
    assert difference(path)["tick"] == 20_111


@pytest.mark.parametrize(
    ("signal_name", "offset", "expected"),
    [("x_feed_um", 0.01, "x_command_um"), ("mode", -1.0, "mode"), ("flags", 16.0, "flags")],
)
def test_a_changed_value_is_found_at_its_tick(
    signal_name: str, offset: float, expected: str, eventful: Path, path: Path
):
    """x_feed_um, an input, shows in the command; mode and flags show in themselves."""
    column = load(eventful).columns.index(signal_name)

    def change(rows: Rows) -> None:
        rows[rows[:, 0] == 20_111, column] += offset

    assert difference_place(rewrite(eventful, path, rows=change)) == (20_111, expected)


def change_first_snapshot(source: Path, path: Path, offset: int, value: float) -> Path:
    """Rewrite `source` with one number of the first snapshot changed."""

    def change(data: bytearray) -> None:
        if int.from_bytes(data[:8], "little") == 0:
            struct.pack_into("<d", data, offset, value)

    return rewrite(source, path, law=change)


def test_one_unit_in_the_last_place_of_a_coefficient_is_found(eventful: Path, path: Path):
    offset, changed = 8 + COEFFICIENTS.fields["um_per_v"][1], np.nextafter(10.0, 11.0)  # type: ignore[index]
    assert struct.unpack_from("<d", next(iter(load(eventful).snapshots())).data, offset) == (10.0,)
    volts = load(eventful)["x_adc_v"]
    expected = int(np.flatnonzero(volts * changed != volts * 10.0)[0])
    assert difference_place(change_first_snapshot(eventful, path, offset, changed)) == (expected, "x_position_um")


def test_a_coefficient_without_an_effect_is_found_at_the_next_snapshot(eventful: Path, path: Path):
    offset = 8 + COEFFICIENTS.fields["sample_age_limit_us"][1]  # type: ignore[index]
    first = difference(change_first_snapshot(eventful, path, offset, 123.0))
    assert (first["tick"], first["signal"], first["replayed"]) == (10_000, "law.x.sample_age_limit_us", 123.0)


@pytest.mark.parametrize(("shift", "found_at"), [(1, 5_000), (-1, 4_999)])
def test_a_command_shifted_by_one_tick_is_found_at_the_right_one(shift: int, found_at: int, eventful: Path, path: Path):
    def move(event: dict[str, Any]) -> None:
        if event["kind"] == "set_mode" and event["tick"] == 5_000:
            event["tick"] += shift

    assert difference_place(rewrite(eventful, path, event=move)) == (found_at, "mode")


def test_a_rewritten_recording_without_a_change_is_identical(eventful: Path, path: Path):
    rewrite(eventful, path)
    assert read_rows([path]).tobytes() == read_rows([eventful]).tobytes()
    report = replay(load(path))
    assert (report.identical, report.ticks) == (True, EVENTFUL_TICKS)


def test_another_layout_of_the_law_is_refused(path: Path):
    law = RealLoop(PAPER).header["law"]
    RecordedRun(path, PAPER, {"law": {**law, "sha256": "0" * 64}}, paced=False).end(100)
    with pytest.raises(RecordingError, match="which stores a law's state differently"):
        replay(load(path))


def test_a_different_state_is_named():
    loop = RealLoop(TWO_AXES)
    loop.run(1)
    data = bytes(loop.block["snapshots_slots"][0])[8:]
    law = loop.law.layout
    within = COEFFICIENTS.itemsize + law.slot_bytes("feedforward")[0] + transfer.COEFFICIENTS.fields["b"][1]  # type: ignore[index]
    offset = law.coefficients.itemsize + within + 8
    changed = bytearray(data)
    changed[offset] ^= 1
    name, recorded, replayed = first_difference(data, bytes(changed), ["x", "y"], loop.law)
    assert name == "law.y.b[1]"
    assert recorded == struct.unpack_from("<d", data, offset)[0] != replayed


@pytest.mark.parametrize("field", LOOP_STATE.names or ())
def test_a_different_state_of_the_loop_is_named(field: str):
    loop = RealLoop(TWO_AXES)
    loop.run(1)
    data = bytes(loop.block["snapshots_slots"][0])[8:]
    changed = bytearray(data)
    begin = len(loop.law.coefficients.tobytes()) + len(loop.law.axes.tobytes())
    changed[begin + LOOP_STATE.fields[field][1]] ^= 1  # type: ignore[index]
    name, recorded, replayed = first_difference(data, bytes(changed), ["x", "y"], loop.law)
    assert name.partition("[")[0] == f"law.loop.{field}"
    assert recorded != replayed


@pytest.mark.parametrize(("ticks", "is_judged"), [(50, False), (51, True)])
def test_a_rate_is_judged_from_fifty_periods_on(ticks: int, is_judged: bool):
    """The first ticks of a run may be late by the time of some periods."""
    rows = np.zeros((ticks, PERIODS_MISSED + 1))
    rows[:, DEADLINE] = 200_000 * np.arange(ticks)
    differences: list[Any] = []
    self = SimpleNamespace(
        _recording=SimpleNamespace(header={"rate_hz": 10_000.0}),
        _record_difference=lambda *details: differences.append(details),
    )
    Replay._compare_rate(self, rows)  # type: ignore[arg-type]
    assert [(signal, recorded) for _, signal, recorded, _ in differences] == [("rate_hz", 10_000.0)] * is_judged
