"""TDMS and MF4 by their own libraries, HDF5, NetCDF and MAT by theirs: every number is equal to the written one."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from asammdf import MDF, Signal
from mcap.writer import Writer
from nptdms import ChannelObject, GroupObject, RootObject, TdmsWriter
from scipy.io import netcdf_file, savemat

from rtloop.errors import MissingExtra
from rtloop.interchange.binding import Binding, bind
from rtloop.interchange.columns import ColumnSelection
from rtloop.interchange.formats.table import AmbiguousData, UnreadableData
from rtloop.interchange.reading import read_in_process
from tests.command_line import run

ROWS, RATE = 200, 10_000.0
T = np.arange(ROWS) / RATE
U = np.round(2 * np.sin(2 * np.pi * 100 * T), 3)
X = np.round(1.5 * U - 0.375, 3)


def read(path: Path, **answers: Any) -> Binding:
    """Return the reading of a file, by the answers to its questions."""
    selection = ColumnSelection(all=True, **answers)
    return bind(read_in_process(path, selection.hints), path, selection)


def has(binding: Binding, name: str, unit: str | None, values: Any) -> bool:
    """Whether a column has a unit and, exactly, these values."""
    return binding.units[name] == unit and np.array_equal(binding.table.columns[name], values, equal_nan=True)


def waveform(group: str, name: str, values: Any, increment: float = 1e-4, **properties: Any) -> ChannelObject:
    return ChannelObject(
        group,
        name,
        values,
        {"wf_increment": increment, "wf_start_offset": 0.0, "wf_samples": len(values), **properties},
    )


def scaled(unit: str, slope: float, intercept: float) -> dict[str, Any]:
    """Return the properties of a linear scale, as LabVIEW writes them."""
    return {
        "NI_Number_Of_Scales": 1,
        "NI_Scale[0]_Scale_Type": "Linear",
        "NI_Scale[0]_Linear_Slope": slope,
        "NI_Scale[0]_Linear_Y_Intercept": intercept,
        "NI_Scale[0]_Linear_Input_Source": 0xFFFFFFFF,
        "unit_string": unit,
    }


@pytest.fixture
def tdms(tmp_path: Path) -> Path:
    """A TDMS file with scaled codes, two rates, strings, times and empty groups."""
    codes = np.rint((U - 0.5) / 1e-3).astype(np.int16)
    start = np.datetime64("2024-03-04T12:00:00")
    stamps = start + (np.arange(ROWS) * 100_000).astype("timedelta64[ns]").astype("timedelta64[us]")
    with TdmsWriter(tmp_path / "scan.tdms") as writer:
        writer.write_segment(
            [
                RootObject({"author": "me"}),
                GroupObject("fast"),
                GroupObject("nothing"),
                waveform("fast", "drive", codes, **scaled("V", 1e-3, 0.5)),
                waveform("fast", "position", X, unit_string="um"),
                waveform("slow", "temperature", X[::10], 1e-3, unit_string="degC"),
                ChannelObject("notes", "remark", ["a", "b"]),
                ChannelObject("stamped", "when", stamps),
                ChannelObject("stamped", "value", U),
                ChannelObject("fast", "silent", np.zeros(0)),
            ]
        )
        writer.write_segment([waveform("fast", "drive", codes), waveform("fast", "position", X)])
    return tmp_path / "scan.tdms"


def test_tdms_is_scaled_and_has_its_rates_as_groups(tdms: Path):
    fast = read(tdms)
    assert has(fast, "drive", "V", np.tile(np.rint((U - 0.5) / 1e-3) * 1e-3 + 0.5, 2))
    assert has(fast, "position", "um", np.tile(X, 2))
    assert fast.require_time().rate_hz == RATE
    assert "slow (1000 Hz)" in fast.table.about["other groups"]
    assert "notes/remark (text" in fast.table.about["left out"]
    assert "fast/silent (empty)" in fast.table.about["left out"]
    slow = read(tdms, group="slow (1000 Hz)")
    assert has(slow, "temperature", "degC", X[::10])
    assert slow.require_time().rate_hz == 1000.0
    stamped = read(tdms, group="stamped")
    assert has(stamped, "value", None, U)
    assert stamped.require_time().rate_hz == RATE


def test_mf4_is_converted_and_has_a_group_for_each_master(tmp_path: Path):
    codes = np.rint(U / 1e-3).astype(np.int16)
    linear = {"a": 1e-3, "b": 0.5}
    invalid = np.arange(ROWS) == 7
    gap = np.delete(T, slice(50, 60))
    with MDF(version="4.10") as file:
        drive = Signal(codes, T, unit="V", name="drive", conversion=linear)
        place = Signal(X, T, unit="um", name="place", invalidation_bits=invalid)
        word = Signal(np.array([b"on"] * ROWS), T, name="word", encoding="utf-8")
        file.append([drive, place, word], acq_name="fast")
        file.append([Signal(X[::10], T[::10], unit="degC", name="temperature")], acq_name="slow")
        file.append([Signal(np.zeros(0), np.zeros(0), name="silent")], acq_name="nothing")
        file.append([Signal(np.arange(ROWS - 10.0), gap, name="count", unit="V")], acq_name="gaps")
        file.save(tmp_path / "scan.mf4")
    fast = read(tmp_path / "scan.mf4")
    assert has(fast, "drive", "V", codes * 1e-3 + 0.5)
    assert has(fast, "place", "um", np.where(invalid, np.nan, X))
    assert "place: 1 missing, as the file states" in fast.notes
    assert fast.require_time().rate_hz == RATE
    assert "word" in fast.table.about["left out"]
    assert "empty" in fast.table.about["left out"]
    slow = read(tmp_path / "scan.mf4", group="slow")
    assert has(slow, "temperature", "degC", X[::10])
    assert slow.require_time().rate_hz == 1000.0
    gaps = read(tmp_path / "scan.mf4", group="gaps").require_time()
    assert np.array_equal(gaps.deadline_ns, np.rint(gap * 1e9))
    assert "about 10 samples missing, in 1 gap" in gaps.notes[0]


@pytest.mark.parametrize(("module", "name", "magic"), [("nptdms", "tdms", b"TDSm"), ("asammdf", "mf4", b"MDF     ")])
def test_a_missing_extra_is_one_sentence(
    module: str, name: str, magic: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "scan").write_bytes(magic + bytes(100))
    with pytest.raises(UnreadableData, match="damaged"):
        read(tmp_path / "scan")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtra, match=rf"pip install 'rtloop\[{name}\]'"):
        read(tmp_path / "scan")


CODES = np.rint((U - 0.5) / 1e-3).astype(np.int16)
PACKED = CODES.copy()
PACKED[[3, 9]] = -32768, 32767
UNPACKED = PACKED * 1e-3 + 0.5
UNPACKED[[3, 9]] = np.nan
CF = {"units": "V", "scale_factor": 1e-3, "add_offset": 0.5, "_FillValue": np.int16(-32768)}


LIMITS = {
    "a": {"valid_range": np.array([-30000, 30000], "i2")},
    "b": {"valid_max": np.int16(30000)},
    "c": {"missing_value": np.array([32767], "i2")},
}


def test_hdf5_is_unpacked_by_the_cf_conventions(tmp_path: Path):
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        for name, limits in LIMITS.items():
            file.create_dataset(name, data=PACKED).attrs.update(CF | limits)
        file.create_dataset("time", data=T).attrs["units"] = "seconds since 2024-03-04 12:00:00"
        marker = file.create_dataset("duration", data=np.array([[0xDD000000, 2, 1, 1, 1, 1]], "u4"))
        marker.attrs.update(MATLAB_class=np.bytes_("duration"), MATLAB_object_decode=np.int32(3))
    binding = read(tmp_path / "scan.h5")
    assert all(has(binding, name, "V", UNPACKED) for name in LIMITS)
    assert binding.require_time().rate_hz == RATE
    assert binding.table.about["left out"] == "duration (a MATLAB object, duration)"
    assert "a: scale_factor 0.001, add_offset 0.5, 2 missing, as the file states" in binding.notes


def test_netcdf_3_is_unpacked_too(tmp_path: Path):
    with netcdf_file(tmp_path / "scan.nc", "w") as file:
        file.createDimension("time", ROWS)
        file.createVariable("time", "d", ("time",))[:] = T
        file.variables["time"].units = "s"
        for name, limits in LIMITS.items():
            variable = file.createVariable(name, "h", ("time",))
            variable[:] = PACKED
            for key, value in (CF | limits).items():
                setattr(variable, key, np.array([value]) if isinstance(value, float) else value)
    binding = read(tmp_path / "scan.nc")
    assert all(has(binding, name, "V", UNPACKED) for name in LIMITS)
    assert binding.require_time().rate_hz == RATE


@pytest.mark.parametrize("names", [("XInc", "YInc", "YOrg"), ("xincrement", "yincrement", "yorigin")])
def test_a_scope_in_hdf5_has_its_axes_at_the_group(names: tuple[str, ...], tmp_path: Path):
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        group = file.create_group("Waveforms/Channel 1")
        group.attrs.update(dict(zip(names, (1e-4, 1e-3, 0.5), strict=True)) | {"YUnits": np.bytes_("V")})
        group["Channel 1 Data"] = CODES
    binding = read(tmp_path / "scan.h5")
    assert has(binding, "Channel 1 Data", "V", CODES * 1e-3 + 0.5)
    assert binding.require_time().rate_hz == RATE


def test_a_mat_file_is_known_by_its_content(tmp_path: Path):
    with h5py.File(tmp_path / "bare.mat", "w") as file:
        file["t"], file["u"] = T, U
    assert has(read(tmp_path / "bare.mat"), "u", None, U)
    np.savetxt(tmp_path / "ascii.mat", np.column_stack([T, U]))
    assert has(read(tmp_path / "ascii.mat", clock="column_1", time_unit="s"), "column_2", None, U)
    octave = "# Created by Octave 8\n"
    for name, values in (("t", T), ("u", U)):
        octave += f"# name: {name}\n# type: matrix\n# rows: {ROWS}\n# columns: 1\n"
        octave += "".join(f" {value!r}\n" for value in values.tolist()) + "\n\n"
    octave += "# name: fs\n# type: scalar\n10000\n\n\n# name: word\n# type: string\n# elements: 1\n# length: 2\non\n"
    (tmp_path / "octave.mat").write_text(octave)
    binding = read(tmp_path / "octave.mat")
    assert has(binding, "u", None, U)
    assert binding.require_time().rate_hz == RATE


def test_a_rate_stated_beside_the_data_is_the_clock(tmp_path: Path):
    savemat(tmp_path / "a.mat", {"u": U, "x": X, "Fs": RATE})
    binding = read(tmp_path / "a.mat")
    assert binding.require_time().rate_hz == RATE
    assert "Fs 10000.0" in binding.require_time().description
    np.savez(tmp_path / "a.npz", u=U, dt=1e-3)
    assert read(tmp_path / "a.npz").require_time().rate_hz == 1000.0


def test_labone_counts_ticks_of_its_clock(tmp_path: Path):
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        device = file.create_group("000/dev1234")
        device["clockbase/value"] = np.array([60_000_000.0])
        device["demods/0/sample/timestamp"] = (1 << 60) + 6000 * np.arange(ROWS, dtype="u8")
        device["demods/0/sample/x"] = U
    binding = read(tmp_path / "scan.h5")
    assert has(binding, "x", None, U)
    assert binding.require_time().rate_hz == RATE
    assert "counts ticks of 60000000 Hz" in binding.require_time().notes[0]


def test_a_stamp_of_ros_is_the_time_and_the_log_is_named(tmp_path: Path):
    stamps = 1_700_000_000_000_000_000 + 100_000 * np.arange(ROWS)
    late = np.random.default_rng(1).integers(0, 60_000, ROWS)
    with (tmp_path / "scan.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("x", "json", 0)
        for stamp, delay, u in zip(stamps.tolist(), late.tolist(), U.tolist(), strict=True):
            header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}}
            writer.add_message(channel, stamp + delay, json.dumps({"header": header, "u": u}).encode(), stamp)
        writer.finish()
    binding = read(tmp_path / "scan.mcap")
    assert binding.require_time().rate_hz == RATE
    assert "the times are header.stamp, of the measurement; --clock log_time_s for those of the log" in binding.notes
    assert "jitter" in " ".join(read(tmp_path / "scan.mcap", clock="log_time_s").require_time().notes)


def ask_matrix(path: Path) -> None:
    np.savez(path, data=np.column_stack([T, U, X]))


def ask_two_clocks(path: Path) -> None:
    np.savez(path, time=T, timestamp=2.5 * T, u=U)


def ask_rate(path: Path) -> None:
    np.savez(path, time=T, u=U, fs=5000.0)


def ask_whole_times(path: Path) -> None:
    savemat(path, {"t": np.arange(ROWS), "u": U}, appendmat=False)


@pytest.mark.parametrize(
    ("write", "options"),
    [
        (ask_matrix, ("--clock data_1 --time-unit s", "--rate HZ")),
        (ask_two_clocks, ("--clock 'time'", "--clock 'timestamp'")),
        (ask_rate, ("--clock 'time'", "--clock stated")),
        (ask_whole_times, ("--time-unit s", "--time-unit ms")),
    ],
)
def test_binary_files_with_two_readings_ask_too(write: Any, options: tuple[str, ...], tmp_path: Path):
    with (tmp_path / "scan").open("wb") as file:
        write(file)
    with pytest.raises(AmbiguousData) as caught:
        read(tmp_path / "scan")
    assert all(option in str(caught.value) for option in options), str(caught.value)


def test_a_question_ends_with_65_and_its_answer_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rtloop.interchange.isolated_reader.read_table", read_in_process)
    rows = "".join(f"{k},{u}\n" for k, u in enumerate(U))
    Path("scan.csv").write_text("time,u [V]\n" + rows)
    for mode in ([], ["--all"]):
        result = run("import", "scan.csv", *mode)
        assert result.exit_code == 65
        assert "--time-unit s   1 Hz" in result.stderr
        assert "--time-unit ms  1000 Hz" in result.stderr
    assert not Path("scan.mcap").exists()
    Path("map.toml").write_text('all = true\ntime_unit = "ms"\n')
    result = run("import", "scan.csv")
    assert result.exit_code == 0, result.stderr
    assert "at 1000 Hz" in result.stdout


def test_a_suggestion_never_contradicts_a_stated_unit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rtloop.interchange.isolated_reader.read_table", read_in_process)
    Path("scan.csv").write_text(
        "x-axis,1,2\nsecond,Volt,Volt\n" + "".join(f"{t},{u},{u}\n" for t, u in zip(T, U, strict=True))
    )
    text = run("import", "scan.csv").stdout.partition("for example:")[2]
    assert "'x_drive_v=1 [Volt]'" in text
    assert "'x_position_um=2 [Volt] * FACTOR µm/Volt'" in text
    result = run("import", "scan.csv", "--map", "x_drive_v=1 [Volt]", "--map", "x_position_um=2 [Volt] * 1.5 µm/Volt")
    assert result.exit_code == 0, result.stderr
