"""Summary, load, export and plot of a recording, against numpy on the rows that were written."""

from __future__ import annotations

import csv
import sys
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pyarrow.parquet
import pytest
from PIL import Image

from rtloop.errors import MissingExtra, OutputError
from rtloop.interchange.export import export
from rtloop.recording.columns import signal_unit
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import Recording, load
from rtloop.recording.views.bands import event_marks, read_bands
from rtloop.recording.views.histogram import TimeHistogram
from rtloop.recording.views.plot import draw_recording, plot
from rtloop.recording.views.summary import AxisSummary, SignalExtremes, summarise
from rtloop.signals import Flag, Mode
from tests.recording.hand_made_loop import COLUMNS, make_rows, write_recording
from tests.recording.tamper import flip_byte

COUNT = 7_000
SPECIAL = (0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1.7976931348623157e308, 0.1)


@pytest.fixture(scope="module")
def rows() -> np.ndarray:
    """Rows with ticks in mode off, flags, missed periods, a large lateness, and SPECIAL doubles."""
    rows = make_rows(COUNT)
    for name, ticks, value in (
        ("mode", slice(1000), Mode.OFF),
        ("x_error_um", slice(1000), 1e6),
        ("flags", 17, Flag.OVERRUN | Flag.COMMAND_LIMITED),
        ("periods_missed", 18, 3),
        ("lateness_us", 100, 123_456.789),
        ("x_true_position_um", slice(len(SPECIAL)), SPECIAL),
    ):
        rows[ticks, COLUMNS.index(name)] = value
    return rows


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, rows: np.ndarray) -> Path:
    """A recording that holds `rows`."""
    return write_recording(tmp_path_factory.mktemp("use") / "run.mcap", rows, ticks_expected=COUNT)


def test_the_summary_of_a_paced_run_has_the_figures_of_numpy(path: Path, rows: np.ndarray):
    summary = summarise(path)
    column = dict(zip(COLUMNS, rows.T, strict=True))
    assert (summary.ticks_expected, summary.ticks_logged, summary.ticks_lost) == (COUNT, COUNT, 0)
    assert (summary.overruns, summary.periods_missed, summary.complete) == (1, 3, True)
    figures = (summary.duration_s, summary.rate_hz, summary.achieved_rate_hz)
    assert figures == pytest.approx((0.7, 10_000.0, 10_000.0))
    for name, quantiles in (("lateness_us", summary.lateness_us), ("exec_us", summary.exec_us)):
        expected = np.quantile(column[name], [0.5, 0.99, 0.999], method="inverted_cdf")
        assert quantiles is not None
        assert [quantiles[key] for key in ("p50", "p99", "p999")] == pytest.approx(list(expected), abs=1e-9)
        assert quantiles["max"] == column[name].max()
    [axis] = summary.axes
    rms_um = np.sqrt(np.mean(column["x_error_um"][1000:] ** 2))
    assert (axis.name, axis.rms_error_um) == ("x", pytest.approx(rms_um))
    assert axis.max_abs_drive_v == np.abs(column["x_drive_v"]).max()
    assert summary.realtime is not None
    assert (summary.realtime["kernel"], set(summary.phases)) == ("test", {"read_us", "law_us", "write_us"})
    assert (summary.trips, summary.events, summary.size_bytes) == ([], 8, path.stat().st_size)


def test_unreadable_ticks_do_not_lower_the_achieved_rate(path: Path, tmp_path: Path):
    summary = summarise(flip_byte(path, target=tmp_path / "run.mcap"))
    assert summary.ticks_lost > 100
    assert summary.achieved_rate_hz == pytest.approx(10_000.0)


def test_the_summary_of_an_unpaced_run_has_no_times(tmp_path: Path):
    summary = summarise(write_recording(tmp_path / "run.mcap", make_rows(500, paced=False), paced=False))
    phases = {"read_us": None, "law_us": None, "write_us": None}
    assert (summary.lateness_us, summary.exec_us, summary.phases) == (None, None, phases)


def test_the_summary_of_an_empty_run_has_no_figures(tmp_path: Path):
    summary = summarise(write_recording(tmp_path / "run.mcap", make_rows(0)))
    assert (summary.ticks_logged, summary.duration_s, summary.complete) == (0, 0.0, True)
    assert summary.axes == [AxisSummary("x", None, 0.0)]


def test_large_times_keep_their_leading_digits():
    histogram, values = TimeHistogram(), np.geomspace(1.0, 1e7, 5_000)
    histogram.add(values)
    exact = np.quantile(values, [0.1, 0.5, 0.999], method="inverted_cdf")
    assert histogram.quantiles_us(0.1, 0.5, 0.999) == pytest.approx(list(exact), rel=2**-12)


def test_times_are_rounded_to_the_nearest_nanosecond():
    histogram = TimeHistogram()
    histogram.add(np.array([0.0006, 0.0014, 0.0016, 7.0004999]))
    assert histogram.quantiles_us(0.25, 0.5, 0.75, 1.0) == [0.001, 0.001, 0.002, 7.0]


def test_classes_of_times_end_at_1_2_and_5_in_each_decade():
    """Class n = 1, 2, … gets n times 1 ns below its bound, and the bound of the class before, if there is one."""
    bounds_us = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
    histogram = TimeHistogram()
    for number, bound_us in enumerate(bounds_us):
        histogram.add(np.full(number + 1, bound_us - 0.001))
        histogram.add(np.array([bound_us]))
    counts = [(entry["below_us"], entry["count"]) for entry in histogram.class_counts()]
    assert counts == [*((bound_us, number + 1 + (number > 0)) for number, bound_us in enumerate(bounds_us)), (None, 1)]


def test_extremes_of_a_signal_that_has_no_number_are_none():
    extremes = SignalExtremes({"a": "µm", "b": "V"})
    for values in ([np.nan, 2.0], [-3.0, np.nan]):
        extremes.add({"a": np.array(values), "b": np.full(2, np.nan)})
    assert [(entry.least, entry.largest) for entry in extremes.summary()] == [(-3.0, 2.0), (None, None)]


def test_load_gives_signals_by_name(path: Path, rows: np.ndarray):
    recording = load(path)
    assert recording["x_position_um"].tobytes() == rows[:, COLUMNS.index("x_position_um")].tobytes()
    assert recording["tick"] is recording["tick"]
    assert recording.time_s == pytest.approx(np.arange(COUNT) / 10_000.0)
    assert (len(recording), list(recording), "tick" in recording) == (COUNT, list(COLUMNS), True)
    assert (recording.units["x_drive_v"], signal_unit("x_true_position_um")) == ("V", "µm")
    assert recording.configuration.startswith("[loop]")
    assert (recording.events[0]["kind"], [*recording.snapshots()][1].tick) == ("set_mode", 1_000)
    with pytest.raises(RecordingError, match="no signal 'y'; allowed: tick, "):
        recording["y"]
    with pytest.raises(ValueError, match="read-only"):
        recording["tick"][0] = 1.0


def test_load_refuses_files_of_different_runs(path: Path, tmp_path: Path):
    other_path = write_recording(tmp_path / "other.mcap", make_rows(10), name="other")
    with pytest.raises(RecordingError, match="not of the same run"):
        load([path, other_path])
    with pytest.raises(RecordingError, match="no such file"):
        load(tmp_path / "absent-*.mcap")


def read_csv(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a file by name, as do the two functions below."""
    with path.open(newline="") as file:
        names, *lines = csv.reader(file)
    return dict(zip(names, np.array(lines, float).T, strict=True))


def read_parquet(path: Path) -> dict[str, np.ndarray]:
    table = pyarrow.parquet.read_table(path)
    assert table.schema.field("x_drive_v").metadata == {b"unit": b"V"}
    return {name: table[name].to_numpy() for name in table.column_names}


def read_npz(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as arrays:
        return {name: arrays[name] for name in arrays if not name.endswith("_json")}


def test_counts_have_no_decimal_point_in_csv(path: Path, rows: np.ndarray, tmp_path: Path):
    export(path, "csv", tmp_path / "run.csv")
    names, *lines = [line.split(",") for line in (tmp_path / "run.csv").read_text().splitlines()]
    assert len(lines) == COUNT
    for name in ("tick", "deadline_ns", "periods_missed", "flags", "mode", "driver_status"):
        column = COLUMNS.index(name)
        assert [line[names.index(name)] for line in lines] == [f"{value:.0f}" for value in rows[:, column]], name


def test_csv_without_pyarrow_has_the_same_numbers(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    export(path, "csv", tmp_path / "fast.csv")
    monkeypatch.setitem(sys.modules, "pyarrow.csv", None)
    export(path, "csv", tmp_path / "slow.csv")
    fast, slow = (
        [line.split(",") for line in (tmp_path / name).read_text().splitlines()] for name in ("fast.csv", "slow.csv")
    )
    assert fast[0] == slow[0]
    assert fast != slow, "pyarrow writes 0 where Python writes 0.0"
    numbers = [np.array(lines[1:], float) for lines in (fast, slow)]
    assert numbers[0].shape == (COUNT, len(COLUMNS))
    assert numbers[0].tobytes() == numbers[1].tobytes()


def test_a_loaded_recording_says_what_it_is(path: Path):
    recording = load(path)
    axes = ", ".join(recording.header["axes"])
    assert repr(recording) == f"<Recording {path.name}: axes {axes}, 10000 Hz, {len(COLUMNS)} signals>"


@pytest.mark.parametrize(("to", "read"), [("csv", read_csv), ("parquet", read_parquet), ("npz", read_npz)])
def test_export_is_exact(to: str, read, path: Path, rows: np.ndarray, tmp_path: Path):
    report = export(path, to, tmp_path / f"run.{to}")
    assert (report["ticks"], report["problems"]) == (COUNT, [])
    signals = read(Path(report["output"]))
    assert list(signals) == list(COLUMNS)
    for name, expected in zip(COLUMNS, rows.T, strict=True):
        assert np.ascontiguousarray(signals[name]).tobytes() == np.ascontiguousarray(expected).tobytes(), name
    with pytest.raises(OutputError, match="exists already"):
        export(path, to, tmp_path / f"run.{to}")
    assert [file.name for file in tmp_path.iterdir()] == [f"run.{to}"]


def test_a_refused_export_names_the_reason_and_leaves_no_file(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for to, folder, error, message in (
        ("xlsx", tmp_path, RecordingError, "allowed: csv, parquet, npz, mat, hdf5"),
        ("csv", tmp_path / "absent", OutputError, "No such file or directory"),
        ("parquet", tmp_path, MissingExtra, r"pip install 'rtloop\[parquet\]'"),
    ):
        with pytest.raises(error, match=message):
            export(path, to, folder / f"run.{to}")
    assert (MissingExtra.exit_code, list(tmp_path.iterdir())) == (78, [])


@pytest.mark.parametrize("paced", [True, False])
def test_plot_writes_a_picture(paced: bool, tmp_path: Path):
    path = write_recording(tmp_path / "run.mcap", make_rows(30_000, paced=paced), paced=paced)
    with Image.open(plot(path, tmp_path / "run.png")) as picture:
        assert (picture.format, picture.width > 1000) == ("PNG", True)
    svg_text = plot(path, tmp_path / "run.svg").read_text(encoding="utf-8")
    assert ("timing / µs" in svg_text) == paced
    assert "error / µm" in svg_text
    with pytest.raises(RecordingError, match="no tick from"):
        plot(path, tmp_path / "run.png", start_s=100.0)


def test_bands_keep_every_peak(tmp_path: Path):
    rows = make_rows(30_000)
    rows[[12_345, 23_456], COLUMNS.index("x_error_um")] = 99.0, -99.0
    recording = load(write_recording(tmp_path / "run.mcap", rows))
    band = read_bands(recording, ["x_error_um"], 0.0, np.inf, points=5_000)["x_error_um"]
    assert (len(band.time_s) < 10_000, band.high.max(), band.low.min()) == (True, 99.0, -99.0)
    assert band.time_s[band.high.argmax()] == pytest.approx(1.2345, abs=0.01)
    short_band = read_bands(recording, ["x_error_um"], 1.2, 1.3, points=5_000)["x_error_um"]
    assert np.array_equal(short_band.low, short_band.high)


@pytest.mark.parametrize("every", [0, -2])
def test_every_nth_tick_is_a_number_from_one_on(path: Path, every: int):
    for read in (load(path).to_pandas, load(path).to_xarray):
        with pytest.raises(RecordingError, match=f"^every: {every}; allowed: a whole number of ticks, 1 or more"):
            read(every=every)


@pytest.mark.parametrize(("peak_um", "scale"), [(17.0, "symlog"), (0.05, "linear")])
def test_a_peak_of_the_error_hides_no_ripple_in_a_picture(tmp_path: Path, peak_um: float, scale: str) -> None:
    rows = make_rows(COUNT)
    error = COLUMNS.index("x_error_um")
    rows[:, error] = 0.0098 * np.sin(np.arange(COUNT))
    rows[3000, error] = peak_um
    figure = draw_recording(load(write_recording(tmp_path / "ripple.mcap", rows)))
    (panel,) = (panel for panel in figure.axes if panel.get_ylabel().startswith("x error / µm"))
    assert panel.get_yscale() == scale
    figure.draw_without_rendering()
    boxes = [label.get_window_extent() for label in panel.get_yticklabels() if label.get_text()]
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    low, middle, high = panel.transData.transform([(0, -0.01), (0, 0.0), (0, 0.01)])[:, 1]
    assert (high - middle) / panel.bbox.height > 0.05
    assert middle - low == pytest.approx(high - middle, rel=1e-6)


def test_in_mode_raw_no_reference_in_volts_is_drawn_as_a_position(tmp_path: Path) -> None:
    """The reference of the mode raw is in V: it has no place beside the position, and no error."""
    rows = make_rows(COUNT)
    rows[:, COLUMNS.index("mode")] = Mode.RAW
    figure = draw_recording(load(write_recording(tmp_path / "raw.mcap", rows)))
    assert [panel.get_ylabel() for panel in figure.axes] == ["x / µm", "x drive / V", "timing / µs"]
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["position"]
    rows[: COUNT // 2, COLUMNS.index("mode")] = Mode.CLOSED_LOOP
    band = read_bands(load(write_recording(tmp_path / "both.mcap", rows)), ["x_error_um"], 0.0, np.inf, 10_000)
    assert np.array_equal(np.isnan(band["x_error_um"].low), np.arange(COUNT) >= COUNT // 2)


@pytest.mark.parametrize(
    ("configuration", "label"),
    [
        ('[[axis]]\nname = "x"\n[axis.prefilter]\ntaps = [1.0]\n', "x error\nbehind the pre-filter / µm"),
        ('[[axis]]\nname = "x"\n', "x error / µm"),
        *((text, "x error / µm") for text in ("no TOML", "axis = 3", 'axis = ["x"]', "[[axis]]\nprefilter = 1")),
    ],
)
def test_an_error_behind_a_pre_filter_is_called_so(tmp_path: Path, configuration: str, label: str) -> None:
    recording = load(write_recording(tmp_path / "run.mcap", make_rows(COUNT)))
    recording.header["configuration"] = configuration
    assert label in [panel.get_ylabel() for panel in draw_recording(recording).axes]


def test_an_episode_of_late_ticks_is_marked_with_its_number_of_missed_periods() -> None:
    kinds = ({"kind": "periods_missed", "what": {"periods": 3}}, {"kind": "lateness_over", "what": {"periods": 10}})
    recording = SimpleNamespace(events=[{"time_ns": 10**9, **kind} for kind in kinds])
    marks = event_marks(cast("Recording", recording), 0.0, 2.0)
    assert [mark.label for mark in marks] == ["periods missed", "lateness over: 10 periods missed"]


def test_labels_of_close_events_do_not_overlap_and_no_legend_covers_a_panel(tmp_path: Path) -> None:
    """60 events, one each 1.7 % of the time: the lines of text at 30° are as far apart as their letters are high."""
    figure = draw_recording(load(write_recording(tmp_path / "events.mcap", make_rows(60_000))))
    figure.draw_without_rendering()
    top = figure.axes[0]
    places = [top.get_xaxis_transform().transform(label.get_position())[0] for label in top.texts]
    distances = np.diff(places) * np.sin(np.radians(30.0))
    height = top.texts[0].get_fontsize() * figure.dpi / 72
    assert len(places) > 10
    assert distances.min() > height
    for panel in figure.axes:
        assert panel.get_legend().get_window_extent().x0 >= panel.bbox.x1
