"""A recording around events: retained ticks are exact, an overview covers the others, and every span replays."""

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
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics.overview import uncovered_ranges
from rtloop.recording.load import Recording, load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.bands import read_bands
from rtloop.recording.views.summary import summarise
from tests.recording import rewriting
from tests.recording.around import (
    SECOND,
    STEP,
    TICKS,
    TRIP,
    SelectiveRun,
    around_settings,
    recorded_rows,
    retained_seconds,
)
from tests.recording.tamper import flip_byte

CONDITIONS = ("trip", "abs(x_drive_v) >= 6.5")
Rows = np.ndarray[Any, Any]


@pytest.fixture(scope="module")
def full_rows(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    """Rows (TICKS, columns) of the run, with every tick."""
    return recorded_rows(tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def selective_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the same run around the events of CONDITIONS."""
    run = SelectiveRun(tmp_path_factory.mktemp("selected") / "run.mcap", around_settings(*CONDITIONS))
    totals = run.end(TICKS)
    assert (totals["ticks_lost"], totals["complete"], totals["error"]) == (0, True, None)
    return run.path


@pytest.fixture(scope="module")
def expected_seconds(full_rows: Rows, selective_path: Path) -> list[int]:
    """Numbers of the seconds to retain, computed from the rows of every tick."""
    hits = full_rows[np.abs(full_rows[:, load(selective_path).columns.index("x_drive_v")]) >= 6.5, 0]
    assert np.any((hits > STEP) & (hits < STEP + SECOND))  # There are at least two spans.
    seconds = retained_seconds(np.append(hits, TRIP), TICKS // SECOND)
    assert 5 < len(seconds) < 15
    return seconds


def recorded_seconds(recording: Recording) -> list[int]:
    """Return the numbers of the seconds of which a recording holds ticks."""
    return np.unique(recording["tick"] // SECOND).astype(int).tolist()


def test_ticks_around_events_are_recorded_bit_for_bit(
    full_rows: Rows, selective_path: Path, expected_seconds: list[int]
):
    recording = load(selective_path)
    rows = np.concatenate(list(recording.blocks()))
    assert (recorded_seconds(recording), len(rows), recording.problems) == (
        expected_seconds,
        len(expected_seconds) * SECOND,
        [],
    )
    assert rows.tobytes() == np.ascontiguousarray(full_rows[rows[:, 0].astype(int)]).tobytes()
    span_begins = [(event["tick"], event["what"]["on"]) for event in recording.events if event["kind"] == "kept"]
    drive = np.abs(full_rows[:, recording.columns.index("x_drive_v")]) >= 6.5
    first_hits = [int(np.flatnonzero(drive)[0]), int(np.flatnonzero(drive[STEP:])[0]) + STEP]
    assert span_begins == [(tick, CONDITIONS[1]) for tick in first_hits]
    assert first_hits[0] < TRIP  # The trip therefore begins no span.


def test_the_overview_covers_every_omitted_second(full_rows: Rows, selective_path: Path, expected_seconds: list[int]):
    omitted = [k for k in range(TICKS // SECOND) if k not in expected_seconds]
    overview = load(selective_path).overview
    assert ((overview.tick // SECOND).tolist(), set(overview.ticks)) == (omitted, {SECOND})
    for name in ("x_position_um", "x_drive_v", "tick", "lateness_us", "flags"):
        column = load(selective_path).columns.index(name)
        for index, k in enumerate(omitted):
            values = full_rows[k * SECOND : (k + 1) * SECOND, column]
            figures = [part[index] for part in overview[name]]
            is_measured = not np.isnan(values).all()
            mean = pytest.approx(values.mean(), rel=1e-12, abs=1e-12, nan_ok=True)
            np.testing.assert_array_equal(figures[:2], [values.min(), values.max()] if is_measured else [np.nan] * 2)
            assert figures[2] == mean
    with pytest.raises(KeyError, match="no signal 'y'"):
        overview["y"]


def test_stock_tools_read_the_overview(selective_path: Path, expected_seconds: list[int]):
    with selective_path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = [row.decoded_message for row in reader.iter_decoded_messages(topics=["/overview"])]
        file.seek(0)
        times = [message.log_time for _, _, message in make_reader(file).iter_messages(topics=["/events"])]
    overview = load(selective_path).overview
    assert (times, len(messages)) == (sorted(times), TICKS // SECOND - len(expected_seconds))
    assert [message.tick_min for message in messages] == overview.tick.tolist()
    assert [message.x_error_um_max for message in messages] == overview["x_error_um"].most.tolist()


def test_every_span_replays_identical(selective_path: Path, expected_seconds: list[int]):
    report, summary = replay(load(selective_path)), summarise(selective_path)
    spans = 1 + np.count_nonzero(np.diff(expected_seconds) > 1)
    assert (report.identical, report.gaps, report.not_verified) == (True, [], [])
    assert (report.ticks, report.stretches) == (len(expected_seconds) * SECOND, spans)
    assert report.skipped == TICKS - report.ticks
    assert (summary.stretches, summary.ticks_skipped, summary.ticks_lost) == (spans, report.skipped, 0)
    assert (summary.complete, summary.duration_s) == (True, pytest.approx(TICKS / SECOND))


def test_every_span_can_be_cut_out_and_replays_alone(selective_path: Path, tmp_path: Path):
    recording = load(selective_path)
    for number, (first, count) in enumerate(uncovered_ranges(0, TICKS, recording.skipped)):
        span_cut = cut(selective_path, first + 5, first + count, tmp_path / f"{number}.mcap")
        report = replay(load(span_cut["output"]))
        assert (span_cut["complete"], report.identical, report.ticks, report.stretches) == (True, True, count, 1)
    first, count = recording.skipped[0]
    cut_across = cut(selective_path, first - SECOND, first + count + SECOND, tmp_path / "across.mcap")
    report = replay(load(cut_across["output"]))
    assert (cut_across["complete"], report.identical, report.ticks, report.skipped) == (True, True, 2 * SECOND, count)
    assert summarise(cut_across["output"]).complete
    late_cut = cut(selective_path, first + 5, first + count + 5, tmp_path / "begun.mcap")
    assert (late_cut["begin"], late_cut["ticks"], late_cut["gaps"]) == (first + count, 5, [])
    with pytest.raises(RecordingError, match="the requested ticks were omitted"):
        cut(selective_path, first + 5, first + 500, tmp_path / "none.mcap")


def test_a_picture_shows_the_extremes_of_omitted_ticks(full_rows: Rows, selective_path: Path):
    recording = load(selective_path)
    band = read_bands(recording, ["x_position_um"], 0.0, np.inf, 20_000)["x_position_um"]
    assert np.all(np.diff(band.time_s) >= 0)
    column = full_rows[:, recording.columns.index("x_position_um")]
    for first, count in recording.skipped:
        inside = (band.time_s >= first / SECOND) & (band.time_s < (first + count) / SECOND)
        values = column[first : first + count]
        assert (band.low[inside].min(), band.high[inside].max()) == (values.min(), values.max())


@pytest.mark.parametrize("rule", [{"rotate_s": 6.0}, {"rotate_bytes": 1_500_000}])
def test_rotated_files_begin_at_snapshots_and_hold_all_ticks(
    tmp_path: Path, expected_seconds: list[int], rule: dict[str, Any]
):
    totals = SelectiveRun(tmp_path / "run.mcap", around_settings(*CONDITIONS), **rule).end(TICKS)
    assert (totals["complete"], len(totals["paths"]) > 2) == (True, True)
    recording, summary = load(totals["paths"]), summarise(totals["paths"])
    assert set(recorded_seconds(recording)) >= set(expected_seconds)
    report = replay(recording)
    assert (report.identical, report.gaps, report.ticks + report.skipped) == (True, [], TICKS)
    assert (summary.complete, summary.ticks_lost, summary.problems) == (True, 0, [])
    for path in totals["paths"]:
        part = load(path)
        assert part["tick"][0] == part.extents[0].first_tick  # The file begins with a retained second.
        assert (replay(part).identical, summarise(path).complete) == (True, True)


def test_the_file_of_a_killed_recorder_is_recovered(tmp_path: Path, expected_seconds: list[int]):
    run = SelectiveRun(tmp_path / "run.mcap", around_settings(*CONDITIONS))
    run.run_to(STEP + 2 * SECOND)
    output = tmp_path / "recovered.mcap"
    assert recover(run.copy_part("left.mcap.part"), output)["gaps"] == []
    recording, summary = load(output), summarise(output)
    assert recorded_seconds(recording)[:6] == [k for k in expected_seconds if k <= STEP // SECOND + 1]
    report = replay(recording)
    assert (report.identical, report.stretches) == (True, 2)
    assert (summary.result, summary.ticks_lost) == ("recovered", 0)
    assert summary.ticks_skipped == report.skipped > 0


@pytest.mark.parametrize(
    ("killed_at", "on"),
    [
        *((tick, CONDITIONS) for tick in (5_500, STEP - 2_000, STEP + 8_000)),
        (15 * SECOND + 500, ("trip",)),  # after an overview
    ],
)
def test_a_replacement_recorder_loses_no_data(
    tmp_path: Path, expected_seconds: list[int], killed_at: int, on: tuple[str, ...]
):
    """The ring still holds the ticks that were in the buffer of the dead recorder."""
    run = SelectiveRun(tmp_path / "run.mcap", around_settings(*on), paced=True)
    run.run_to(killed_at)
    run.begin(sequence=2)
    totals = run.end(TICKS)
    assert (totals["ticks_lost"], totals["events_lost"]) == (0, 0)
    recover(run.copy_part("left.mcap.part"))
    files = [tmp_path / "left.mcap", tmp_path / "run-0002.mcap"]
    recording, report = load(files), replay(load(files))
    assert on != CONDITIONS or set(recorded_seconds(recording)) >= set(expected_seconds)
    assert (report.identical, report.gaps, report.ticks + report.skipped) == (True, [], TICKS)
    assert (replay(load(files[1])).identical, summarise(files).ticks_lost) == (True, 0)
    assert sum(event["kind"] == "tripped" for event in recording.events) == 1


def test_the_last_seconds_of_a_failed_loop_are_recorded(tmp_path: Path):
    run = SelectiveRun(tmp_path / "run.mcap", around_settings("trip"))
    run.run_to(12 * SECOND + 77)
    run.session.finish("failed")
    recording = load(tmp_path / "run.mcap")
    assert (recording["tick"][-1], recorded_seconds(recording)[-3:]) == (12 * SECOND + 76, [10, 11, 12])


def test_a_recording_around_events_is_read_without_conversion(selective_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(layout, "open_converted_copy", None)
    assert replay(load(selective_path)).identical


def test_a_recording_around_events_can_be_rewritten_by_another_tool(selective_path: Path, tmp_path: Path):
    path = rewriting.write(tmp_path / "rewritten.mcap", rewriting.messages(selective_path), chunk_size=20_000)
    rewritten, original = load(path), load(selective_path)
    assert (rewritten.skipped, len(rewritten)) == (original.skipped, len(original))
    np.testing.assert_array_equal(rewritten.overview["x_drive_v"].most, original.overview["x_drive_v"].most)
    report = replay(rewritten)
    assert (report.identical, report.gaps) == (True, [])


def test_a_damaged_overview_counts_as_a_loss(selective_path: Path, tmp_path: Path):
    with Reader(selective_path) as reader:
        entry = next(entry for entry in reader.entries if entry.index and 5 in entry.index.channels)
    damaged = flip_byte(selective_path, entry.offset + entry.length - 20, tmp_path / "damaged.mcap")
    summary, report = summarise(damaged), replay(load(damaged))
    assert (summary.complete, len(summary.problems), summary.ticks_lost > 0) == (False, 1, True)
    assert (report.identical, report.first_difference) == (False, None)
    assert "not in the recording" in {entry["why"] for entry in report.not_verified}


COLUMNS = ["tick", *(f"c{k}" for k in range(6)), "periods_missed", "v"]


@pytest.fixture
def rows() -> Rows:
    """Rows of ticks 1000 to 1099 with a rising `v`, a NaN and two missed periods."""
    rows = np.zeros((100, len(COLUMNS)))
    rows[:, 0], rows[:, -1] = np.arange(1000, 1100), np.linspace(-5.0, 4.9, 100)
    rows[7, -1], rows[40, -2] = np.nan, 2.0
    return rows


SPANS = {
    "trip": (1060, 1060),
    "mode": (1050, 1050),
    "command": (1050, 1070),
    "late": (1040, 1040),
    "v>4.75": (1098, 1099),
    " abs( v ) >= 4.95 ": (1000, 1000),
    "v == 0": (1050, 1050),
    "v < -4.85": (1000, 1001),
    "v <= -4.9e0": (1000, 1001),
}
"""First and last tick at which each condition holds."""


@pytest.mark.parametrize("texts", [*([text] for text in SPANS), [*SPANS]], ids=str)
def test_a_condition_holds_at_the_right_ticks(texts: list[str], rows: Rows):
    events = [(1050, "set_mode"), (1060, "tripped"), (1070, "stop"), (1080, "lateness_over")]
    hits = Conditions(texts, COLUMNS).find_hits(rows, events)
    assert {hit.condition: (hit.first, hit.last) for hit in hits} == {text: SPANS[text] for text in texts}
    assert [hit.first for hit in hits] == sorted(hit.first for hit in hits)


def test_no_comparison_holds_for_nan(rows: Rows):
    assert Conditions(["v > 100", "v != 1e300"], COLUMNS).find_hits(rows[7:8], []) == []


@pytest.mark.parametrize("text", ["", "v", "v >", "abs(v > 1", "v > 1 > 2", "trips", "v > nan", "v != v"])
def test_a_malformed_condition_is_refused(text: str):
    with pytest.raises(ValueError, match="not a condition"):
        parse_comparison(text)


def test_an_unknown_signal_of_a_condition_is_named():
    names = ", ".join(COLUMNS)
    assert signal_problem("vv > 1", COLUMNS) == f"'vv > 1': no signal 'vv'; did you mean v?; allowed: {names}"


def test_a_replacement_recorder_retains_as_many_ticks_as_after_an_event(tmp_path: Path):
    """The dead recorder may have been retaining ticks."""
    run = SelectiveRun(tmp_path / "run.mcap", around_settings("x_drive_v > 100", before_s=0.5, after_s=3.0), paced=True)
    run.run_to(25_000)
    flushed = run.loop.block.load(Word.FLUSHED_TICKS)
    run.begin(sequence=2)
    run.end(9 * SECOND)
    recording = load(tmp_path / "run-0002.mcap")
    assert recorded_seconds(recording) == list(range(flushed // SECOND, (flushed + 3 * SECOND) // SECOND + 1))
    assert replay(recording).identical


def test_a_long_overview_is_written_in_chunks_of_usual_size(tmp_path: Path):
    """All intervals wait until the end of the run, because an event may still come that retains their ticks."""
    settings = around_settings("x_drive_v > 100", before_s=20.0, every_s=0.001)
    run = SelectiveRun(tmp_path / "run.mcap", settings)
    totals = run.end(4 * SECOND)
    assert (totals["ticks_lost"], totals["complete"]) == (0, True)
    with run.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunks = summary.chunk_indexes
    assert sum(chunk.uncompressed_size for chunk in chunks) > 4 << 20
    assert max(chunk.uncompressed_size for chunk in chunks) < 1.2 * (1 << 20)
    with Reader(run.path) as reader:
        intervals = reader.overview[:, 0, :2]
        omitted = sum(count for _, count in reader.skipped_ranges)
    assert np.array_equal(intervals[1:, 0], intervals[:-1, 1] + 1)
    assert omitted + len(load(run.path)["tick"]) == 4 * SECOND


def test_an_overview_of_many_chunks_is_written_as_early_as_one_of_a_single_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    flushed = []
    for name in ("single", "many"):
        run = SelectiveRun(tmp_path / f"{name}.mcap", around_settings("x_drive_v > 100", before_s=0.5, every_s=0.5))
        run.run_to(16 * SECOND)
        flushed.append(run.loop.block.load(Word.FLUSHED_TICKS))
        run.end(17 * SECOND)
        monkeypatch.setattr("rtloop.recording.capture.segment_buffer.most_intervals", lambda _: 2)
    assert flushed[0] == flushed[1] > 10 * SECOND
    with Reader(tmp_path / "single.mcap") as single, Reader(tmp_path / "many.mcap") as many:
        assert np.array_equal(single.overview, many.overview, equal_nan=True)


def test_the_mean_of_an_interval_ignores_nan():
    rows = np.zeros((6, 3))
    rows[:, 0] = np.arange(6)
    rows[:, 1] = [4.0, np.nan, 8.0, np.nan, np.nan, np.nan]
    rows[:, 2] = [1.0, 2.0, 6.0, 5.0, np.nan, 7.0]
    decimation = Decimation(columns=3, every=3)
    decimation.add_rows(rows)
    first, second = decimation.take_intervals(10)
    np.testing.assert_array_equal(first, [[0.0, 2.0, 1.0], [4.0, 8.0, 6.0], [1.0, 6.0, 3.0]])
    np.testing.assert_array_equal(second, [[3.0, 5.0, 4.0], [np.nan] * 3, [5.0, 7.0, 6.0]])
