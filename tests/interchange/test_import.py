"""`rtloop import`: its output, its messages, and the use of an imported recording by the other commands."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from rtloop.design.identification import axis_recording
from rtloop.interchange.isolated_reader import read_table
from rtloop.interchange.reading import read_in_process
from rtloop.interchange.sampling import grows_evenly
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import load
from tests.command_line import answer, run
from tests.interchange.controldesk import read_v5, write_controldesk

DOCUMENT = Path(__file__).parents[2] / "docs/data.md"
COUNT = 3000
TIME = np.arange(COUNT) * 1e-4
VOLTS = np.sin(2 * np.pi * 50 * TIME)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder of the commands. Files are read in this process, which is faster."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rtloop.interchange.isolated_reader.read_table", read_in_process)
    return tmp_path


@pytest.fixture
def scan(folder: Path) -> Path:
    """A MAT file of t (s), drive (mV), position (nm) and temperature."""
    savemat(folder / "scan.mat", {"t": TIME, "drive_mV": 1e3 * VOLTS, "pos_nm": 500 * VOLTS, "T": VOLTS + 21})
    return folder / "scan.mat"


def test_without_a_mapping_the_columns_are_listed_with_a_suggestion(scan: Path):
    result = run("import", scan)
    assert result.exit_code == 2
    assert "3,000 rows, 10000 Hz by t [s]" in result.stdout
    assert re.search(r"^drive_mV +mV +-1000 +1000$", result.stdout, re.MULTILINE)
    assert "--map 'x_drive_v=drive_mV [mV]' \\\n    --map 'x_position_um=pos_nm [nm]'" in result.stdout
    assert not scan.with_suffix(".mcap").exists()
    report = answer("import", scan, code=2)
    assert [column["name"] for column in report["columns"]] == ["t", "drive_mV", "pos_nm", "T"]


def test_a_recording_of_it_is_one_that_the_other_commands_take(scan: Path, folder: Path):
    report = answer("import", scan, "--map", "drive_v=drive_mV", "--map", "x_position_um=pos_nm", "--map", "T")
    assert (report["ticks"], report["rate_hz"], report["time"]) == (COUNT, 10_000.0, "t [s]")
    assert report["notes"] == ["the time 't' has no known unit; s is assumed"]
    recording = load(folder / "scan.mcap")
    assert recording.columns == ("tick", "deadline_ns", "x_drive_v", "x_position_um", "T")
    assert np.array_equal(recording["x_drive_v"], 1e3 * VOLTS / 1e3)
    assert np.array_equal(recording["x_position_um"], 500 * VOLTS / 1e3)
    assert np.array_equal(recording["deadline_ns"], np.arange(COUNT) * 100_000.0)
    assert (recording.header["law"], recording.header["axes"]) == (None, ["x"])
    assert recording.header["imported"]["mapping"] == {
        "x_drive_v": "drive_mV [mV]", "x_position_um": "pos_nm [nm]", "T": "T"
    }  # fmt: skip
    assert recording.problems == []
    summary = answer("info", "scan.mcap")
    assert (summary["ticks_logged"], summary["ticks_lost"], summary["complete"]) == (COUNT, 0, True)
    (axis,) = summary["axes"]
    assert (axis["name"], axis["rms_error_um"], axis["max_abs_drive_v"]) == ("x", None, pytest.approx(1.0))
    assert [signal_range["name"] for signal_range in summary["ranges"]] == ["x_drive_v", "x_position_um", "T"]
    assert "from scan.mat" in run("info", "scan.mcap").stdout
    assert run("plot", "scan.mcap").exit_code == run("plot", "scan.mcap", "--html").exit_code == 0
    assert answer("cut", "scan.mcap", "--from", 0.1, "--until", 0.2, "--out", "cut.mcap")["ticks"] == 1000
    assert answer("info", "cut.mcap")["complete"]
    assert answer("export", "scan.mcap", "--to", "npz")["ticks"] == COUNT
    assert answer("recover", "scan.mcap", "--out", "again.mcap")["ticks"] == COUNT


def test_a_clipped_position_without_readings_is_named_in_its_own_unit(folder: Path):
    clipped_nm = np.minimum(500 * VOLTS, 400)
    savemat(folder / "clipped.mat", {"t": TIME, "drive_V": VOLTS, "pos_nm": clipped_nm})
    run("import", "clipped.mat", "--map", "x_drive_v=drive_V", "--map", "x_position_um=pos_nm")
    result = run("identify", "hysteresis", "clipped.mcap")
    assert result.exit_code == 1, result.output
    first = int(np.argmax(clipped_nm == 400))
    assert f"saturated: the recorded position stays at 0.4 µm from tick {first} on" in result.stderr


@pytest.mark.parametrize("options", [[], ["--resimulate"], ["--config", "paper.toml"]])
def test_a_replay_of_an_import_is_refused_in_one_line(options: list[str], scan: Path):
    run("import", scan, "--all")
    result = run("replay", "scan.mcap", *options)
    assert result.exit_code == 66
    assert "nothing to replay; the recording holds signals imported from scan.mat, and no law" in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_response_of_an_unknown_loop_is_refused(scan: Path):
    run("import", scan, "--map", "x_drive_v=drive_mV", "--map", "x_position_um=pos_nm")
    result = run("identify", "response", "scan.mcap")
    assert result.exit_code == 1
    assert "an imported recording has no configuration of its closed loop" in result.stderr


@pytest.mark.parametrize("axis", [(), ("--axis", "x")])
def test_an_identification_from_a_recording_without_axes_says_how_to_import_it(axis: tuple[str, ...], scan: Path):
    run("import", scan, "--all")
    result = run("identify", "hysteresis", "scan.mcap", *axis)
    assert result.exit_code == 66
    assert "scan.mcap: the recording has no axis; import drive and position again" in result.stderr


def test_a_recording_that_vanishes_during_an_identification_is_one_message(scan: Path, monkeypatch: pytest.MonkeyPatch):
    run("import", scan, "--map", "x_drive_v=drive_mV", "--map", "x_position_um=pos_nm")
    monkeypatch.setattr(axis_recording, "require_usable", lambda *_: Path("scan.mcap").unlink())
    with pytest.raises(RecordingError, match=r"scan\.mcap: No such file"):
        axis_recording.read_axis_recording(Path("scan.mcap"))


def test_all_columns_under_their_own_names(scan: Path):
    names = [signal["name"] for signal in answer("import", scan, "--all", "--map", "x_drive_v=drive_mV")["signals"]]
    assert names == ["x_drive_v", "pos_nm", "T"]
    assert load("scan.mcap").units["pos_nm"] == "nm"
    assert run("plot", "scan.mcap").exit_code == 0


@pytest.mark.parametrize("option", [["--time", "c0"], ["--rate", "1000"]])
def test_as_many_columns_as_an_import_allows_can_be_read(option: list[str], folder: Path):
    """With --rate all 2,000 columns become signals beside tick and deadline_ns."""
    names = [f"c{number}" for number in range(2000)]
    rows = "\n".join(",".join([f"{row / 1000}"] * 2000) for row in range(20))
    (folder / "wide.csv").write_text(",".join(names) + "\n" + rows + "\n")
    answer("import", "wide.csv", "--all", *option)
    assert answer("info", "wide.mcap")["duration_s"] == pytest.approx(0.02)
    assert load("wide.mcap")["c1999"][19] == 0.019


def test_jitter_and_missing_samples_are_reported_and_kept(folder: Path):
    random = np.random.default_rng(1)
    times = np.delete(TIME + random.uniform(-5e-6, 5e-6, COUNT) + 1e-5, np.arange(1000, 1004))
    savemat(folder / "scan.mat", {"time": times, "u": np.delete(VOLTS, np.arange(1000, 1004))})
    notes = answer("import", "scan.mat", "--map", "x_drive_v=u [V]", "--time", "time [s]")["notes"]
    match = re.fullmatch(
        r"sample times jitter: the periods deviate by ([\d.]+) µs rms, ([\d.]+) µs at most, from the median of .*",
        notes[0],
    )
    assert match
    # The deviation is the difference of two offsets, each uniform over 10 µs.
    assert float(match[1]) == pytest.approx(10 / 6**0.5, rel=0.05)
    assert 9 < float(match[2]) <= 10.1
    assert re.match(r"about 4 samples missing, in 1 gap, the first after 0.09", notes[1])
    recording = load("scan.mcap")
    assert np.array_equal(recording["deadline_ns"], np.rint(times * 1e9))
    assert recording.header["imported"]["notes"] == notes
    assert "jitter" in run("info", "scan.mcap").stdout


def test_a_file_that_is_not_there_ends_as_with_every_command(folder: Path):
    result = run("import", "absent.csv")
    assert (result.exit_code, result.stderr) == (66, "rtloop: absent.csv: No such file or directory\n")


def test_a_column_that_counts_is_not_offered_as_a_position(folder: Path):
    """The columns have no units: a clock in seconds since 1970 and a counter must not be suggested."""
    rows = "".join(f"{1_700_000_000 + k},{k},{k % 3},{k % 5}\n" for k in range(100))
    (folder / "scan.csv").write_text("stamp,count,out,gap\n" + rows)
    offered = run("import", "scan.csv").stdout.partition("for example:")[2]
    assert "--map 'x_drive_v=out [V]'" in offered
    assert "--map 'x_position_um=gap [µm]'" in offered


def test_a_column_with_infinite_values_is_no_clock():
    """Nor does it give a warning, which pytest turns into an error."""
    assert grows_evenly(np.arange(9.0))
    for values in ([0, np.inf, np.inf], [-np.inf, 1, np.inf], [0, 1, np.inf], [0, np.nan, 2]):
        assert not grows_evenly(np.array(values))


def test_a_given_rate_replaces_an_unusable_time(folder: Path):
    savemat(folder / "scan.mat", {"time": np.round(TIME, 3), "u": VOLTS})
    result = run("import", "scan.mat", "--all")
    assert result.exit_code == 65
    assert "time 'time' does not grow from row 1 (0 s) to row 2 (0 s)" in result.stderr
    assert "--rate 9996.67  even samples, with times rounded to 0.001 s" in result.stderr
    report = answer("import", "scan.mat", "--all", "--rate", 44_100)
    assert report["rate_hz"] == 44_100
    assert [signal["name"] for signal in report["signals"]] == ["u"]
    assert np.array_equal(load("scan.mcap")["deadline_ns"], np.rint(np.arange(COUNT) / 44_100 * 1e9))


def test_an_impossible_rate_asks_for_the_unit(folder: Path):
    savemat(folder / "scan.mat", {"time": np.arange(9.0) * 5000, "u": VOLTS[:9]})
    message = "the times 'time' in s give a rate of 0.0002 Hz; allowed: 0.001 to 1e+06 Hz"
    assert message in run("import", "scan.mat", "--all").stderr


def test_a_time_before_the_start_is_counted_from_its_first_sample(folder: Path):
    savemat(folder / "scan.mat", {"time_ms": 1e3 * (TIME - 0.05), "u": VOLTS})
    report = answer("import", "scan.mat", "--map", "x_drive_v=u", "--time", "time_ms")
    assert (report["rate_hz"], report["time"]) == (10_000.0, "time_ms [ms]")
    assert "the file's time begins at -50 ms; this becomes 0 in the recording" in report["notes"]
    assert np.array_equal(load("scan.mcap")["deadline_ns"], np.arange(COUNT) * 100_000.0)


@pytest.mark.parametrize(
    ("mapping", "description", "begin_ns", "period_ns"),
    [
        ("count * 100 µs", "count * 100 µs", 0, 100_000),
        ("clock [ms] * 2", "clock [ms] * 2", 0, 200_000),
        ("clock [ms] * 2 + 0.5 s", "clock [ms] * 2 + 0.5 s", 500_000_000, 200_000),
        ("clock * 0.002", "clock [s] * 0.002", 0, 200_000),
        ("clock [ms]", "clock [ms]", 0, 100_000),
    ],
)
def test_a_time_is_converted_as_its_mapping_says(
    mapping: str, description: str, begin_ns: int, period_ns: int, folder: Path
):
    savemat(folder / "scan.mat", {"count": np.arange(float(COUNT)), "clock": 1e3 * TIME, "u": VOLTS})
    report = answer("import", "scan.mat", "--map", "x_drive_v=u [V]", "--time", mapping)
    assert (report["time"], report["rate_hz"]) == (description, 1e9 / period_ns)
    assert np.array_equal(load("scan.mcap")["deadline_ns"], begin_ns + np.arange(COUNT) * float(period_ns))
    assumed = ["the time 'clock' has no known unit; s is assumed"] if mapping == "clock * 0.002" else []
    assert report["notes"] == assumed


def test_an_option_replaces_the_signal_of_a_mapping_file_under_its_short_name(scan: Path, folder: Path):
    (folder / "lab.toml").write_text('[signals]\ndrive_v = "drive_mV"\nx_position_um = "pos_nm"\n')
    report = answer("import", scan, "--mapping", "lab.toml", "--map", "x_drive_v=T [V]")
    assert {signal["name"]: signal["from"] for signal in report["signals"]} == {
        "x_position_um": "pos_nm [nm]", "x_drive_v": "T [V]"
    }  # fmt: skip


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--map", "x_position_um=drive_mV"], 1, "x_position_um from column 'drive_mV': mV cannot be converted to µm"),
        (["--map", "x_drive_v=voltage"], 1, "no column 'voltage'; the columns of the file include "),
        (
            ["--map", "drive_v=drive_mV", "--map", "x_drive_v=T [V]"],
            1,
            "drive_v and x_drive_v are two mappings of the signal x_drive_v",
        ),
        (
            ["--all", "--time", "t + 1 ms"],
            1,
            "time from column 't': ms cannot be converted to a number without a unit; write the unit in",
        ),
        (["--map", "tick=t"], 1, "tick is computed from the times and cannot be mapped"),
        (["--map", "mode=T"], 1, "mode: 21; allowed: a whole number from 0 to 3"),
        (["--all", "--time", "T"], 1, "time 'T' does not grow"),
        (["--all", "--time", "t [ns]"], 1, "time 't' does not grow from row 1 (0 ns) to row 2 (0.0001 ns)"),
        (["--all", "--time", "pos_nm"], 1, "time 'pos_nm': nm cannot be converted to s"),
        (["--all", "--group", "slow"], 1, "no group 'slow'; there are '3,000 rows'"),
        (["--all", "--mapping", "absent.toml"], 66, "absent.toml: No such file"),
        (["--all", "--rate", "0"], 2, "0.0 is not in the range"),
        (["--all", "--rate", "10", "--time", "t"], 2, "--time and --rate: both are given; allowed: one of them"),
    ],
)
def test_an_impossible_import_is_one_message_and_writes_no_file(
    options: list[str], code: int, message: str, scan: Path
):
    result = run("import", scan, *options)
    assert result.exit_code == code
    assert message in result.stderr
    assert [file.name for file in scan.parent.iterdir()] == ["scan.mat"]


def test_an_output_that_exists_stays_as_it_is(scan: Path, folder: Path):
    (folder / "scan.mcap").write_bytes(b"precious")
    result = run("import", scan, "--all")
    assert result.exit_code == 73
    assert (
        "scan.mcap exists already; a recording is never overwritten; use --out FILE to write another file"
        in result.stderr
    )
    assert (folder / "scan.mcap").read_bytes() == b"precious"
    assert {file.name for file in folder.iterdir()} == {"scan.mat", "scan.mcap"}


def test_the_commands_of_the_document_work(folder: Path, monkeypatch: pytest.MonkeyPatch):
    """The commands of docs/data.md, with its mapping, import a file in ControlDesk's layout and export it again."""
    monkeypatch.setattr("rtloop.interchange.isolated_reader.read_table", read_table)
    text = DOCUMENT.read_text()
    (folder / "map.toml").write_text(re.search(r"```toml\n(.*?)```", text, re.DOTALL)[1])  # type: ignore[index]
    signals = {
        '"Model Root"/Piezo/Out1': (VOLTS, ""),
        "Model Root/Sensor/In1": (VOLTS / 5, "V"),
        "Temperature": (np.full(COUNT, 21.5), "°C"),
    }
    write_controldesk(folder / "scan_0412.mat", TIME, signals)
    commands = [line for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
    assert len(commands) == 4
    for command in commands:
        result = run(*command.removeprefix("rtloop ").split())
        assert result.exit_code == 0, result.output
    assert (folder / "scan_0412.png").stat().st_size > 10_000
    time_s, back, units = read_v5(folder / "scan_back.mat")
    assert np.allclose(time_s, TIME, rtol=0, atol=1e-12)
    assert np.array_equal(back["x_drive_v"], 20 * VOLTS)
    assert np.array_equal(back["x_position_um"], VOLTS / 5 * 2.5 - 3)
    assert units == {"tick": "1", "deadline_ns": "ns", "x_drive_v": "V", "x_position_um": "µm", "Temperature": "°C"}
    assert loadmat(folder / "scan_back.mat", simplify_cells=True)["scan_back"]["X"]["Name"] == "Time"
