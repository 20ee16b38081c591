"""What is done with a recording: summary, load, export, plot."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rtloop.errors import MissingExtra, OutputError
from rtloop.interchange.export import export
from rtloop.recording.columns import signal_unit
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import load
from rtloop.recording.views.bands import read_bands
from rtloop.recording.views.histogram import TimeHistogram
from rtloop.recording.views.plot import plot
from rtloop.recording.views.summary import AxisSummary, summarise
from rtloop.signals import Flag, Mode
from tests.recording.hand_made_loop import COLUMNS, make_rows, write_recording

COUNT = 7_000
SPECIAL = (0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1.7976931348623157e308, 0.1)


@pytest.fixture(scope="module")
def rows() -> np.ndarray:
    rows = make_rows(COUNT)
    rows[:1000, COLUMNS.index("mode")] = Mode.OFF
    rows[:1000, COLUMNS.index("x_error_um")] = 1e6
    rows[17, COLUMNS.index("flags")] = Flag.OVERRUN | Flag.COMMAND_LIMITED
    rows[18, COLUMNS.index("periods_missed")] = 3
    rows[100, COLUMNS.index("lateness_us")] = 123_456.789
    rows[: len(SPECIAL), COLUMNS.index("x_true_position_um")] = SPECIAL
    return rows


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, rows: np.ndarray) -> Path:
    return write_recording(tmp_path_factory.mktemp("use") / "run.mcap", rows, ticks_expected=COUNT)


def test_summary_of_a_paced_run(path: Path, rows: np.ndarray):
    summary = summarise(path)
    column = dict(zip(COLUMNS, rows.T, strict=True))
    assert (summary.ticks_expected, summary.ticks_logged, summary.ticks_lost) == (COUNT, COUNT, 0)
    assert (summary.overruns, summary.periods_missed, summary.complete) == (1, 3, True)
    assert summary.duration_s == pytest.approx(0.7)
    assert summary.rate_hz == 10_000.0
    assert summary.achieved_rate_hz == pytest.approx(10_000.0)
    for name, found in (("lateness_us", summary.lateness_us), ("exec_us", summary.exec_us)):
        quantiles = np.quantile(column[name], [0.5, 0.99, 0.999], method="inverted_cdf")
        assert found is not None
        assert [found[key] for key in ("p50", "p99", "p999")] == pytest.approx(list(quantiles), abs=1e-9)
        assert found["max"] == column[name].max()
    axis = summary.axes[0]
    assert axis.name == "x"
    assert axis.rms_error_um == pytest.approx(np.sqrt(np.mean(column["x_error_um"][1000:] ** 2)))
    assert axis.max_abs_drive_v == np.abs(column["x_drive_v"]).max()
    assert summary.realtime is not None
    assert summary.realtime["kernel"] == "test"
    assert set(summary.phases) == {"read_us", "law_us", "write_us"}
    assert (summary.trips, summary.events) == ([], 8)
    assert summary.size_bytes == path.stat().st_size


def test_damage_is_no_lower_rate(path: Path, tmp_path: Path, rows: np.ndarray):
    """Ticks that cannot be read were executed all the same."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    damaged = tmp_path / "run.mcap"
    damaged.write_bytes(data)
    summary = summarise(damaged)
    assert summary.ticks_lost > 100
    assert summary.achieved_rate_hz == pytest.approx(10_000.0)


def test_summary_of_an_unpaced_run_has_no_times(tmp_path: Path):
    path = write_recording(tmp_path / "run.mcap", make_rows(500, paced=False), paced=False)
    summary = summarise(path)
    assert summary.lateness_us is None
    assert summary.exec_us is None
    assert summary.phases == {"read_us": None, "law_us": None, "write_us": None}


def test_summary_of_an_empty_run(tmp_path: Path):
    summary = summarise(write_recording(tmp_path / "run.mcap", make_rows(0)))
    assert (summary.ticks_logged, summary.duration_s, summary.complete) == (0, 0.0, True)
    assert summary.axes == [AxisSummary("x", None, 0.0)]


def test_large_times_keep_their_leading_digits():
    histogram = TimeHistogram()
    values = np.geomspace(1.0, 1e7, 5_000)
    histogram.add(values)
    exact = np.quantile(values, [0.1, 0.5, 0.999], method="inverted_cdf")
    assert histogram.quantiles_us(0.1, 0.5, 0.999) == pytest.approx(list(exact), rel=2**-12)


def test_load_gives_signals_by_name(path: Path, rows: np.ndarray):
    recording = load(path)
    assert recording["x_position_um"].tobytes() == rows[:, COLUMNS.index("x_position_um")].tobytes()
    assert recording["tick"] is recording["tick"]
    assert recording.time_s == pytest.approx(np.arange(COUNT) / 10_000.0)
    assert (len(recording), list(recording), "tick" in recording) == (COUNT, list(COLUMNS), True)
    assert recording.units["x_drive_v"] == "V"
    assert signal_unit("x_true_position_um") == "µm"
    assert recording.configuration.startswith("[loop]")
    assert recording.events[0]["kind"] == "set_mode"
    assert [one.tick for one in recording.snapshots()][1] == 1_000
    with pytest.raises(RecordingError, match="no signal 'y'; there are tick, "):
        recording["y"]
    with pytest.raises(ValueError, match="read-only"):
        recording["tick"][0] = 1.0


def test_load_refuses_files_of_different_runs(path: Path, tmp_path: Path):
    other = write_recording(tmp_path / "other.mcap", make_rows(10), name="other")
    with pytest.raises(RecordingError, match="not of the same run"):
        load([path, other])
    with pytest.raises(RecordingError, match="no such file"):
        load(tmp_path / "absent-*.mcap")


def _read_csv(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="") as file:
        names, *lines = csv.reader(file)
    return dict(zip(names, np.array([[float(value) for value in line] for line in lines]).T, strict=True))


def _read_parquet(path: Path) -> dict[str, np.ndarray]:
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(path)
    assert table.schema.field("x_drive_v").metadata == {b"unit": b"V"}
    return {name: table[name].to_numpy() for name in table.column_names}


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as arrays:
        return {name: arrays[name] for name in arrays if not name.endswith("_json")}


@pytest.mark.parametrize(("to", "read"), [("csv", _read_csv), ("parquet", _read_parquet), ("npz", _read_npz)])
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


def test_export_says_what_it_cannot(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(RecordingError, match="possible are csv, parquet, npz, mat, hdf5"):
        export(path, "xlsx", tmp_path / "run.xlsx")
    with pytest.raises(OutputError, match="No such file or directory"):
        export(path, "csv", tmp_path / "absent" / "run.csv")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtra, match=r"pip install 'rtloop\[parquet\]'") as caught:
        export(path, "parquet", tmp_path / "run.parquet")
    assert caught.value.exit_code == 78
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("paced", [True, False])
def test_plot_makes_a_picture(paced: bool, tmp_path: Path):
    path = write_recording(tmp_path / "run.mcap", make_rows(30_000, paced=paced), paced=paced)
    with Image.open(plot(path, tmp_path / "run.png")) as picture:
        assert picture.format == "PNG"
        assert picture.width > 1000
    with pytest.raises(RecordingError, match="no tick from"):
        plot(path, tmp_path / "run.png", start_s=100.0)


def test_decimation_keeps_every_peak(tmp_path: Path):
    rows = make_rows(30_000)
    rows[12_345, COLUMNS.index("x_error_um")] = 99.0
    rows[23_456, COLUMNS.index("x_error_um")] = -99.0
    recording = load(write_recording(tmp_path / "run.mcap", rows))
    band = read_bands(recording, ["x_error_um"], 0.0, np.inf, points=5_000)["x_error_um"]
    assert len(band.time_s) < 10_000
    assert (band.high.max(), band.low.min()) == (99.0, -99.0)
    assert band.time_s[band.high.argmax()] == pytest.approx(1.2345, abs=0.01)
    few = read_bands(recording, ["x_error_um"], 1.2, 1.3, points=5_000)["x_error_um"]
    assert np.array_equal(few.low, few.high)


def test_times_are_counted_to_the_nearest_nanosecond():
    histogram = TimeHistogram()
    histogram.add(np.array([0.0006, 0.0014, 0.0016, 7.0004999]))
    assert histogram.quantiles_us(0.25, 0.5, 0.75, 1.0) == [0.001, 0.001, 0.002, 7.0]
