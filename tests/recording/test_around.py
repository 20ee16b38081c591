"""What a recording around events keeps, bit for bit, what it tells of the rest, and that every stretch replays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from rtloop.engine.memory import Word
from rtloop.recording.capture.conditions import Conditions, parse_comparison, signal_problem
from rtloop.recording.capture.decimation import Decimation
from rtloop.recording.cutting.cut import cut
from rtloop.recording.errors import RecordingError
from rtloop.recording.file import layout
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics.overview import uncovered_ranges
from rtloop.recording.load import Recording, load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.bands import read_bands
from rtloop.recording.views.summary import summarise
from tests.recording import rewriting
from tests.recording.around import SECOND, STEP, TICKS, TRIP, Selected, around, kept_seconds, recorded_whole

ON = ("trip", "abs(x_drive_v) >= 6.5")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray[Any, Any]:
    return recorded_whole(tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def selected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = Selected(tmp_path_factory.mktemp("selected") / "run.mcap", around(*ON))
    totals = run.whole()
    assert (totals["ticks_lost"], totals["complete"], totals["error"]) == (0, True, None)
    return run.path


@pytest.fixture(scope="module")
def expected(whole: np.ndarray[Any, Any], selected: Path) -> list[int]:
    """The seconds that are to be kept, by the whole recording alone."""
    hits = whole[np.abs(whole[:, load(selected).columns.index("x_drive_v")]) >= 6.5, 0]
    assert np.any((hits > STEP) & (hits < STEP + SECOND))  # and so there are two stretches at least
    found = kept_seconds(np.append(hits, TRIP), TICKS // SECOND)
    assert 5 < len(found) < 15
    return found


def seconds_of(recording: Recording) -> list[int]:
    return np.unique(recording["tick"] // SECOND).astype(int).tolist()


def test_keeps_what_is_around_events_bit_for_bit(whole: np.ndarray[Any, Any], selected: Path, expected: list[int]):
    recording = load(selected)
    rows = np.concatenate(list(recording.blocks()))
    assert seconds_of(recording) == expected
    assert len(rows) == len(expected) * SECOND
    assert rows.tobytes() == np.ascontiguousarray(whole[rows[:, 0].astype(int)]).tobytes()
    begun = [(event["tick"], event["what"]["on"]) for event in recording.events if event["kind"] == "kept"]
    drive = np.abs(whole[:, recording.columns.index("x_drive_v")]) >= 6.5
    firsts = [int(np.flatnonzero(drive)[0]), int(np.flatnonzero(drive[STEP:])[0]) + STEP]
    assert begun == [(tick, ON[1]) for tick in firsts]
    assert firsts[0] < TRIP  # which therefore begins none
    assert recording.problems == []


def test_an_overview_of_every_second_that_is_left_out(whole: np.ndarray[Any, Any], selected: Path, expected: list[int]):
    left_out = [k for k in range(TICKS // SECOND) if k not in expected]
    overview = load(selected).overview
    assert (overview.tick // SECOND).tolist() == left_out
    assert set(overview.ticks) == {SECOND}
    for name in ("x_position_um", "x_drive_v", "tick", "lateness_us", "flags"):
        column = load(selected).columns.index(name)
        for index, k in enumerate(left_out):
            values = whole[k * SECOND : (k + 1) * SECOND, column]
            found = [part[index] for part in overview[name]]
            if np.isnan(values).all():
                assert np.isnan(found).all()
            else:
                assert found[:2] == [values.min(), values.max()]
                assert found[2] == pytest.approx(values.mean(), rel=1e-12, abs=1e-12)
    with pytest.raises(KeyError, match="no signal 'y'"):
        overview["y"]


def test_stock_tools_read_the_overview(selected: Path, expected: list[int]):
    with selected.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = [one.decoded_message for one in reader.iter_decoded_messages(topics=["/overview"])]
        file.seek(0)
        times = [message.log_time for _, _, message in make_reader(file).iter_messages(topics=["/events"])]
    assert times == sorted(times)
    overview = load(selected).overview
    assert [one.tick_min for one in found] == overview.tick.tolist()
    assert [one.x_error_um_max for one in found] == overview["x_error_um"].most.tolist()
    assert len(found) == TICKS // SECOND - len(expected)


def test_every_stretch_replays_identical(selected: Path, expected: list[int]):
    recording = load(selected)
    report = replay(recording)
    stretches = 1 + np.count_nonzero(np.diff(expected) > 1)
    assert (report.identical, report.gaps, report.not_verified) == (True, [], [])
    assert (report.ticks, report.stretches) == (len(expected) * SECOND, stretches)
    assert report.skipped == TICKS - report.ticks
    summary = summarise(selected)
    assert (summary.stretches, summary.ticks_skipped, summary.ticks_lost) == (stretches, report.skipped, 0)
    assert summary.complete
    assert summary.duration_s == pytest.approx(TICKS / SECOND)


def test_every_stretch_is_cut_out_and_replays_by_itself(selected: Path, tmp_path: Path):
    recording = load(selected)
    for number, (first, count) in enumerate(uncovered_ranges(0, TICKS, recording.skipped)):
        made = cut(selected, first + 5, first + count, tmp_path / f"{number}.mcap")
        report = replay(load(made["output"]))
        assert (made["complete"], report.identical, report.ticks, report.stretches) == (True, True, count, 1)
    first, count = recording.skipped[0]
    across = cut(selected, first - SECOND, first + count + SECOND, tmp_path / "across.mcap")
    report = replay(load(across["output"]))
    assert (across["complete"], report.identical, report.ticks, report.skipped) == (True, True, 2 * SECOND, count)
    assert summarise(across["output"]).complete
    begun = cut(selected, first + 5, first + count + 5, tmp_path / "begun.mcap")
    assert (begun["begin"], begun["ticks"], begun["gaps"]) == (first + count, 5, [])
    with pytest.raises(RecordingError, match="left out by intention"):
        cut(selected, first + 5, first + 500, tmp_path / "nothing.mcap")


def test_a_picture_shows_both(whole: np.ndarray[Any, Any], selected: Path):
    recording = load(selected)
    band = read_bands(recording, ["x_position_um"], 0.0, np.inf, 20_000)["x_position_um"]
    assert np.all(np.diff(band.time_s) >= 0)
    column = whole[:, recording.columns.index("x_position_um")]
    for first, count in recording.skipped:
        inside = (band.time_s >= first / SECOND) & (band.time_s < (first + count) / SECOND)
        values = column[first : first + count]
        assert (band.low[inside].min(), band.high[inside].max()) == (values.min(), values.max())


@pytest.mark.parametrize("rule", [{"rotate_s": 6.0}, {"rotate_bytes": 1_500_000}])
def test_rotates_at_snapshots(whole: np.ndarray[Any, Any], tmp_path: Path, expected: list[int], rule: dict[str, Any]):
    totals = Selected(tmp_path / "run.mcap", around(*ON), **rule).whole()
    assert totals["complete"]
    assert len(totals["paths"]) > 2
    recording = load(totals["paths"])
    assert set(seconds_of(recording)) >= set(expected)
    report = replay(recording)
    assert (report.identical, report.gaps, report.ticks + report.skipped) == (True, [], TICKS)
    summary = summarise(totals["paths"])
    assert (summary.complete, summary.ticks_lost, summary.problems) == (True, 0, [])
    for path in totals["paths"]:
        part = load(path)
        assert part["tick"][0] == part.extents[0].first_tick  # begins with a second that is kept
        assert replay(part).identical
        assert summarise(path).complete


def test_what_a_killed_recorder_left_is_recovered(tmp_path: Path, expected: list[int]):
    run = Selected(tmp_path / "run.mcap", around(*ON))
    run.run_to(STEP + 2 * SECOND)
    output = tmp_path / "recovered.mcap"
    left = tmp_path / "left.mcap.part"
    left.write_bytes((tmp_path / "run.mcap.part").read_bytes())
    report = recover(left, output)
    assert report["gaps"] == []
    assert seconds_of(load(output))[:6] == [k for k in expected if k <= STEP // SECOND + 1]
    found = replay(load(output))
    assert (found.identical, found.stretches) == (True, 2)
    summary = summarise(output)
    assert (summary.result, summary.ticks_lost) == ("recovered", 0)
    assert summary.ticks_skipped == found.skipped > 0


@pytest.mark.parametrize(
    ("killed_at", "on"),
    [(5_500, ON), (STEP - 2_000, ON), (STEP + 8_000, ON), (15 * SECOND + 500, ("trip",))],  # last: behind an overview
)
def test_another_recorder_goes_on(tmp_path: Path, expected: list[int], killed_at: int, on: tuple[str, ...]):
    """It finds in the ring what the memory of the dead one held, and nothing is lost, whenever that was."""
    run = Selected(tmp_path / "run.mcap", around(*on), paced=True)
    run.run_to(killed_at)
    run.begin(sequence=2)
    run.run_to(TICKS)
    totals = run.session.finish("finished")
    assert (totals["ticks_lost"], totals["events_lost"]) == (0, 0)
    left = tmp_path / "left.mcap.part"
    left.write_bytes((tmp_path / "run.mcap.part").read_bytes())
    recover(left)
    files = [tmp_path / "left.mcap", tmp_path / "run-0002.mcap"]
    recording, report = load(files), replay(load(files))
    assert replay(load(files[1])).identical
    assert on != ON or set(seconds_of(recording)) >= set(expected)
    assert (report.identical, report.gaps, report.ticks + report.skipped) == (True, [], TICKS)
    assert sum(event["kind"] == "tripped" for event in recording.events) == 1
    assert summarise(files).ticks_lost == 0


def test_the_end_of_a_loop_that_failed_is_kept(tmp_path: Path):
    run = Selected(tmp_path / "run.mcap", around("trip"))
    run.run_to(12 * SECOND + 77)
    run.session.finish("failed")
    recording = load(tmp_path / "run.mcap")
    assert recording["tick"][-1] == 12 * SECOND + 76
    assert seconds_of(recording)[-3:] == [10, 11, 12]


def test_it_is_read_as_a_file_of_ones_own(selected: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(layout, "open_converted_copy", None)
    assert replay(load(selected)).identical


def test_another_tool_may_write_it_anew(selected: Path, tmp_path: Path):
    anew, own = (
        load(rewriting.write(tmp_path / "anew.mcap", rewriting.messages(selected), chunk_size=20_000)),
        load(selected),
    )
    assert (anew.skipped, len(anew)) == (own.skipped, len(own))
    np.testing.assert_array_equal(anew.overview["x_drive_v"].most, own.overview["x_drive_v"].most)
    report = replay(anew)
    assert (report.identical, report.gaps) == (True, [])


def test_a_damaged_overview_is_a_loss_and_said(selected: Path, tmp_path: Path):
    from rtloop.recording.file.reader import Reader

    with Reader(selected) as reader:
        entry = next(one for one in reader.entries if one.index and 5 in one.index.message_index_offsets)
    damaged = tmp_path / "damaged.mcap"
    data = bytearray(selected.read_bytes())
    data[entry.offset + entry.length - 20] ^= 1
    damaged.write_bytes(data)
    summary = summarise(damaged)
    assert (summary.complete, len(summary.problems)) == (False, 1)
    assert summary.ticks_lost > 0
    report = replay(load(damaged))
    assert not report.identical
    assert report.first_difference is None
    assert "not in the recording" in {entry["why"] for entry in report.not_verified}


def test_conditions_hold_where_they_say():
    columns = ["tick", *(f"c{k}" for k in range(6)), "periods_missed", "v"]
    rows = np.zeros((100, len(columns)))
    rows[:, 0] = np.arange(1000, 1100)
    rows[:, -1] = np.linspace(-5.0, 4.9, 100)
    rows[7, -1] = np.nan
    rows[40, -2] = 2.0
    events = [(1050, "set_mode"), (1060, "tripped"), (1070, "stop"), (1080, "lateness_over")]
    cases = {
        "trip": (1060, 1060),
        "mode": (1050, 1050),
        "command": (1050, 1070),
        "late": (1040, 1040),
        "v>4.75": (1098, 1099),
        " abs( v ) >= 4.95 ": (1000, 1000),
        "v == 0": (1050, 1050),
        "v < -4.85": (1000, 1001),
        "v <= -4.9e0": (1000, 1001),
        "v != v": None,
    }
    for text, expected in cases.items():
        if expected is None:
            with pytest.raises(ValueError, match="no condition"):
                parse_comparison(text)
            continue
        (hit,) = Conditions([text], columns).find_hits(rows, events)
        assert ((hit.first, hit.last), hit.condition) == (expected, text)
    assert Conditions(["v > 100", "v != 1e300"], columns).find_hits(rows[7:8], []) == []  # NaN is nowhere
    assert signal_problem("vv > 1", columns) == "'vv > 1': no signal 'vv'; did you mean v?; there are " + ", ".join(
        columns
    )
    for wrong in ("", "v", "v >", "abs(v > 1", "v > 1 > 2", "trips", "v > nan"):
        with pytest.raises(ValueError, match="no condition"):
            parse_comparison(wrong)


def test_a_replacement_keeps_what_follows_as_long_as_after_an_event(tmp_path: Path):
    """Whatever happened before: the dead recorder may have been within a stretch."""
    run = Selected(tmp_path / "run.mcap", around("x_drive_v > 100", before_s=0.5, after_s=3.0), paced=True)
    run.run_to(25_000)
    reached = run.loop.block.load(Word.FLUSHED_TICKS)
    run.begin(sequence=2)
    run.run_to(9 * SECOND)
    run.session.finish("finished")
    kept = load(tmp_path / "run-0002.mcap")
    assert seconds_of(kept) == list(range(reached // SECOND, (reached + 3 * SECOND) // SECOND + 1))
    assert replay(kept).identical


def test_the_mean_over_an_interval_is_that_of_the_numbers_in_it():
    rows = np.zeros((6, 3))
    rows[:, 0] = np.arange(6)
    rows[:, 1] = [4.0, np.nan, 8.0, np.nan, np.nan, np.nan]
    rows[:, 2] = [1.0, 2.0, 6.0, 5.0, np.nan, 7.0]
    decimation = Decimation(columns=3, every=3)
    decimation.add_rows(rows)
    first, second = decimation.take_intervals()
    np.testing.assert_array_equal(first, [[0.0, 2.0, 1.0], [4.0, 8.0, 6.0], [1.0, 6.0, 3.0]])
    np.testing.assert_array_equal(second, [[3.0, 5.0, 4.0], [np.nan] * 3, [5.0, 7.0, 6.0]])
