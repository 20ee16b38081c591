"""Exported numbers are exact: independent libraries, and rtloop's import, read the recorded bytes."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import loadmat

from rtloop.errors import RtloopError
from rtloop.interchange import to_mat
from rtloop.interchange.columns import ColumnSelection
from rtloop.interchange.export import EXPORT_SUFFIXES, export
from rtloop.interchange.importing import import_data
from rtloop.interchange.reading import read_in_process
from rtloop.recording.load import Recording, load
from rtloop.recording.views.selection import Selection
from rtloop.recording.views.summary import summarise
from tests.interchange.controldesk import read_v5
from tests.recording.hand_made_loop import COLUMNS, make_rows, write_recording

COUNT = 4_000
ODD = (-0.0, 5e-324, -np.inf, 1.7976931348623157e308, 1 / 3, np.nan)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A recording in virtual time, where unmeasured times are NaN, with the doubles of ODD."""
    rows = make_rows(COUNT, paced=False)
    rows[100 : 100 + len(ODD), COLUMNS.index("x_error_um")] = ODD
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    return load(write_recording(path, rows, paced=False))


def export_recording(recording: Recording, to: str, folder: Path, selection: Selection | None = None) -> Path:
    """Export a recording, or a selection of it, to the file `back` of a folder. Returns its path."""
    return Path(
        export(recording.paths[0], to, folder / f"back{EXPORT_SUFFIXES[to]}", None, selection or Selection())["output"]
    )


def import_file(path: Path) -> Recording:
    """Import a file with the default selection of columns. Returns the new recording."""
    report = import_data(path, ColumnSelection(), path.with_suffix(".mcap"), table=read_in_process(path))
    return load(report["output"])


@pytest.mark.parametrize("to", EXPORT_SUFFIXES)
def test_import_of_export_is_the_recording(to: str, recording: Recording, tmp_path: Path):
    back = import_file(export_recording(recording, to, tmp_path))
    assert set(back) == set(recording)
    assert [name for name in recording if back[name].tobytes() != recording[name].tobytes()] == []
    assert back.problems == []
    assert (back.header["rate_hz"], back.header["axes"]) == (10_000.0, ["x"])
    assert back.units == recording.units


def test_mat_is_what_a_script_for_controldesk_reads(recording: Recording, tmp_path: Path):
    time_s, signals, units = read_v5(export_recording(recording, "mat", tmp_path))
    assert np.array_equal(time_s, recording.time_s)
    assert list(signals) == list(COLUMNS)
    assert [name for name in signals if signals[name].tobytes() != recording[name].tobytes()] == []
    assert units == recording.units


def test_a_recording_too_large_for_a_mat_file_is_refused_with_the_remedy(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    numbers = 8 * COUNT * (len(COLUMNS) + 1)
    monkeypatch.setattr(to_mat, "LARGEST_BYTES", numbers)  # the texts exceed this limit
    with pytest.raises(RtloopError, match=r"back\.mat: .* allowed in a MAT file: 2 GiB\. Use --to hdf5"):
        export_recording(recording, "mat", tmp_path)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(to_mat, "LARGEST_BYTES", 2 * numbers)
    assert export_recording(recording, "mat", tmp_path).stat().st_size > numbers


def test_mat_names_its_origin(recording: Recording, tmp_path: Path):
    struct = loadmat(export_recording(recording, "mat", tmp_path), simplify_cells=True)["back"]
    assert struct["Description"]["General"] == "test, recorded by rtloop at 10000 Hz"
    assert json.loads(struct["Info"]["Header"])["rate_hz"] == 10_000.0
    assert json.loads(struct["Info"]["Events"]) == recording.events


@pytest.mark.parametrize(
    ("stem", "variable"),
    [("run", "run"), ("2024-03 scan", "rec_2024_03_scan"), ("ä" * 3, "rec____"), ("a" * 80, "a" * 63)],
)
def test_the_matlab_variable_follows_the_file_name(stem: str, variable: str):
    assert to_mat.matlab_variable(Path(f"{stem}.mat")) == variable


def test_hdf5_has_a_dataset_a_signal(recording: Recording, tmp_path: Path):
    with h5py.File(export_recording(recording, "hdf5", tmp_path)) as file:
        assert set(file) == {*COLUMNS, "header_json", "events_json"}
        assert all(file[name][()].tobytes() == recording[name].tobytes() for name in COLUMNS)
        assert file["x_drive_v"].attrs["unit"] == "V"
        assert json.loads(file["events_json"][()]) == recording.events


@pytest.mark.parametrize("to", EXPORT_SUFFIXES)
def test_an_export_selects_time_signals_and_every_nth_tick(to: str, recording: Recording, tmp_path: Path):
    selection = Selection(("x_*_v", "mode"), 0.1, 0.3, 7)
    table = read_in_process(export_recording(recording, to, tmp_path, selection))
    selected = slice(1000, 3001, 7)
    expected = ["tick", "deadline_ns", "mode", "x_adc_v", "x_demand_v", "x_drive_v"]
    assert sorted(set(table.columns) - {"Time"}) == sorted(expected)
    assert all(table.columns[name].tobytes() == recording[name][selected].tobytes() for name in expected)


def test_an_impossible_selection_writes_no_file(recording: Recording, tmp_path: Path):
    with pytest.raises(RtloopError, match=r"no signal 'y_\*'; allowed: tick, deadline_ns, "):
        export_recording(recording, "csv", tmp_path, Selection(("y_*",)))
    for to in EXPORT_SUFFIXES:
        with pytest.raises(RtloopError, match="holds no tick from 7 s to 8 s"):
            export_recording(recording, to, tmp_path, Selection((), 7.0, 8.0))
    assert list(tmp_path.iterdir()) == []


def test_every_tenth_tick_comes_back_as_a_slower_recording(recording: Recording, tmp_path: Path):
    back = import_file(export_recording(recording, "npz", tmp_path, Selection(every=10)))
    assert back.header["rate_hz"] == 1000.0
    assert np.array_equal(back["tick"], np.arange(COUNT // 10))
    assert np.array_equal(back["deadline_ns"], recording["deadline_ns"][::10])
    assert "the recording gets new ticks from 0" in back.header["imported"]["notes"][-1]


def test_lost_ticks_stay_lost(tmp_path: Path):
    ticks = np.delete(np.arange(500.0, 4000.0), np.arange(700, 720))
    np.savez(tmp_path / "run.npz", tick=ticks, deadline_ns=ticks * 1e5, x_drive_v=ticks)
    back = import_file(tmp_path / "run.npz")
    assert np.array_equal(back["tick"], ticks)
    assert (summarise(back.paths).ticks_lost, back.problems) == (20, [])
    assert back.header["imported"]["notes"] == ["about 20 samples missing, in 1 gap, the first after 0.1199 s"]


def test_frames(recording: Recording, tmp_path: Path):
    frame = recording.to_pandas(["x_*", "mode"], 0.1, 0.2, 2)
    assert frame.index.name == "time_s"
    assert np.array_equal(frame.index, recording.time_s[1000:2001:2])
    assert frame["x_drive_v"].to_numpy().tobytes() == recording["x_drive_v"][1000:2001:2].tobytes()
    assert (frame.attrs["units"]["x_drive_v"], frame.attrs["events"]) == ("V", recording.events)
    data = recording.to_xarray()
    assert set(data.data_vars) == set(COLUMNS)
    assert data["x_position_um"].values.tobytes() == recording["x_position_um"].tobytes()
    assert data["x_position_um"].attrs == {"units": "µm", "long_name": "x: measured position x"}
    assert json.loads(data.attrs["events"]) == recording.events
    assert data.sel(time_s=slice(0.1, 0.2)).sizes["time_s"] == 1001


def test_a_kept_column_of_ticks_replaces_neither_ticks_nor_deadlines(recording: Recording, tmp_path: Path):
    path = export_recording(recording, "npz", tmp_path)
    selection = ColumnSelection(keep=("tick", "deadline_ns", "x_drive_v"), rate_hz=1_000.0)
    back = load(import_data(path, selection, tmp_path / "kept.mcap", table=read_in_process(path))["output"])
    assert np.array_equal(back["deadline_ns"], 1e6 * np.arange(COUNT))
    assert back["tick_2"].tobytes() == recording["tick"].tobytes()
    assert back["deadline_ns_2"].tobytes() == recording["deadline_ns"].tobytes()
