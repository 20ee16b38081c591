"""`rtloop park` with the hardware note in every state after an upgrade, a removed plug-in or an exchanged board.

The memory of the boards, which outlives parking, shows every write to the outputs.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli.service import park
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.hil.board import LSB_V
from rtloop.supervision.hardware import configured_hardware, read_note, write_note
from tests.faults.configuration import BOARD_RATE_HZ, ROOT, SLEW_V_PER_S, on_a_board
from tests.service.fake_board import FakeBoard

START_V = 6.66
GOOD, UNAVAILABLE, REFUSED = 0, 69, 77
NOT_UNDERSTOOD = "the note of the hardware"
Note = dict[str, Any]


@dataclass(frozen=True)
class Lab:
    """Configuration of a board, path and valid content of the hardware note of a run on `board`, and a second board."""

    config: Path
    note: Path
    board: FakeBoard
    other_board: FakeBoard
    content: Note

    def park(self) -> tuple[int, str]:
        """Run `rtloop park`, check that it ends without a traceback, and return its exit code and output."""
        result = CliRunner().invoke(park, [str(self.config)])
        assert isinstance(result.exception, SystemExit | None), repr(result.exception)
        assert "Traceback" not in result.output
        return result.exit_code, result.output


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    """Return a lab with both boards at START_V; the file of the note does not exist yet."""
    run = tmp_path / "run"
    run.mkdir(mode=0o700)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(run))
    config = tmp_path / "lab.toml"
    config.write_text(on_a_board(tmp_path))
    options = {"file": str(tmp_path / "board"), "board_rate_hz": 8000.0}
    content = {
        "driver_kind": "shm",
        "driver_options": json.dumps(options),
        "wiring": {"x": ["adc0", "dac0"]},
        "rate_hz": BOARD_RATE_HZ,
        "trip_slew_v_per_s": SLEW_V_PER_S,
        "heartbeat_timeout_s": 1.0,
    }
    boards = FakeBoard(tmp_path / "board", START_V), FakeBoard(tmp_path / "other", START_V, channels=2)
    return Lab(config, run / "lab.hardware", *boards, content)


def assert_ramped(board: FakeBoard, slew_v_per_s: float = SLEW_V_PER_S, rate_hz: float = BOARD_RATE_HZ) -> None:
    """Check that all outputs are at 0 V, and that the first output went down in steps within the slew rate only."""
    assert board.outputs_v == [0.0] * board.channels
    steps = -np.diff(board.path_v)
    assert steps.min() >= -LSB_V / 2
    assert steps.max() <= slew_v_per_s / rate_hz + LSB_V


def replace_values(**values: Any) -> Callable[[Note], Note]:
    """Return an edit that replaces values of the note."""
    return lambda note: note | values


def replace_options(**values: Any) -> Callable[[Note], Note]:
    """Return an edit that replaces driver options in the note."""
    return lambda note: note | {"driver_options": json.dumps(json.loads(note["driver_options"]) | values)}


def replace_content(data: bytes) -> Callable[[Note], bytes]:
    """Return an edit that replaces the whole note by `data`."""
    return lambda note: data


def truncate(note: Note) -> bytes:
    """Return the first half of the note, as of a writer that died."""
    data = json.dumps(note).encode()
    return data[: len(data) // 2]


def remove_key(key: str) -> Callable[[Note], Note]:
    """Return an edit that removes a key, as in a note of another version."""
    return lambda note: {name: value for name, value in note.items() if name != key}


USABLE: dict[str, Callable[[Note], Note]] = {
    "as it is": replace_values(),
    "unknown key": replace_values(colour="blue"),
    "another slew": replace_values(trip_slew_v_per_s=300.0),
    "longest heartbeat": replace_values(heartbeat_timeout_s=1e99),
    "another driver": replace_values(driver_kind="sim", driver_options="{}"),
}
"""Edits that leave the note usable: parking follows the note, and the configured board ends at 0 V."""
UNUSABLE: dict[str, tuple[Callable[[Note], Note | bytes], str]] = {
    "empty": (replace_content(b""), "JSON"),
    "garbage": (replace_content(bytes(range(256))), "JSON"),
    "zeros": (replace_content(bytes(300)), "JSON"),
    "half": (truncate, "JSON"),
    "null": (replace_content(b"null"), "must be an object"),
    "a list": (replace_content(b"[1, 2]"), "must be an object"),
    "a number": (replace_content(b"7"), "must be an object"),
    "large": (replace_content(b'{"driver_kind": "' + b"x" * (3 << 20) + b'"}'), "JSON"),
    "nested deeply": (replace_content(b"[" * 100_000), "JSON"),
    "missing driver": (remove_key("driver_kind"), "driver_kind"),
    "missing wiring": (remove_key("wiring"), "wiring"),
    "missing slew": (remove_key("trip_slew_v_per_s"), "trip_slew_v_per_s"),
    "unknown driver": (replace_values(driver_kind="my_card"), "my_card"),
    "driver of no name": (replace_values(driver_kind=None), "driver_kind"),
    "driver whose plug-in is broken": (replace_values(driver_kind="broken"), "broken"),
    "unknown option": (replace_options(spin=3), "spin"),
    "option of another type": (replace_options(file=5), "file"),
    "options that are none": (replace_values(driver_options="not JSON"), "driver_options"),
    "options nested deeply": (replace_values(driver_options="[" * 100_000), "driver_options"),
    "options of another driver": (replace_values(driver_options='{"device": "/dev/comedi0"}'), "device"),
    "channel that the driver lacks": (replace_values(wiring={"x": ["adc0", "dac7"]}), "dac7"),
    "channels exchanged": (replace_values(wiring={"x": ["dac0", "adc0"]}), "dac0"),
    "no channels": (replace_values(wiring={}), "wiring"),
    "wiring of another shape": (replace_values(wiring={"x": "dac0"}), "wiring"),
    "slew of 0": (replace_values(trip_slew_v_per_s=0.0), "trip_slew_v_per_s"),
    "slew of -5": (replace_values(trip_slew_v_per_s=-5.0), "trip_slew_v_per_s"),
    "slew of NaN": (replace_values(trip_slew_v_per_s=float("nan")), "trip_slew_v_per_s"),
    "infinite slew": (replace_values(trip_slew_v_per_s=float("inf")), "trip_slew_v_per_s"),
    "slew of null": (replace_values(trip_slew_v_per_s=None), "trip_slew_v_per_s"),
    "slew that takes an hour": (replace_values(trip_slew_v_per_s=0.002), "trip_slew_v_per_s"),
    "rate of 0": (replace_values(rate_hz=0.0), "rate_hz"),
    "rate of -1": (replace_values(rate_hz=-1.0), "rate_hz"),
    "rate of 10^9": (replace_values(rate_hz=1e9), "rate_hz"),
    "rate of NaN": (replace_values(rate_hz=float("nan")), "rate_hz"),
    "heartbeat of -1": (replace_values(heartbeat_timeout_s=-1.0), "heartbeat_timeout_s"),
    "heartbeat of NaN": (replace_values(heartbeat_timeout_s=float("nan")), "heartbeat_timeout_s"),
}
"""Edits that make the note unusable, and the fault's name: the configured board is parked, a message has the name."""


@pytest.mark.parametrize("case", USABLE)
def test_a_note_that_is_understood_is_parked_by(lab: Lab, case: str):
    lab.note.write_text(json.dumps(USABLE[case](lab.content)))
    lab.note.chmod(0o600)
    code, message = lab.park()
    assert (code, NOT_UNDERSTOOD in message) == (GOOD, False), message
    assert_ramped(lab.board)


@pytest.mark.parametrize("case", UNUSABLE)
def test_a_note_that_is_not_understood_is_none_and_named(
    lab: Lab, case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    if case == "driver whose plug-in is broken":
        from rtloop.drivers import registry

        (tmp_path / "broken_plug_in.py").write_text("import a_library_that_was_removed\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.setitem(registry.BUILT_IN, "broken", "broken_plug_in:Card")
    damage, culprit = UNUSABLE[case]
    note = damage(lab.content)
    lab.note.write_bytes(note if isinstance(note, bytes) else json.dumps(note).encode())
    lab.note.chmod(0o600)
    code, message = lab.park()
    assert code == GOOD, message
    assert len(message.splitlines()) == 2
    sentence = message.splitlines()[1]
    assert NOT_UNDERSTOOD in sentence
    assert str(lab.note) in sentence
    assert culprit in sentence
    assert len(sentence) < 700
    assert_ramped(lab.board)


def test_a_slew_beyond_all_measure_is_one_step(lab: Lab):
    lab.note.write_text(json.dumps(lab.content | {"trip_slew_v_per_s": 1e12}))
    lab.note.chmod(0o600)
    assert lab.park()[0] == GOOD
    assert lab.board.outputs_v == [0.0]
    assert lab.board.path_v.min() >= 0.0


@pytest.mark.parametrize("rate_hz", [1.0, 1e-6])
def test_a_slow_rate_makes_neither_large_steps_nor_a_long_wait(lab: Lab, rate_hz: float):
    """Parking keeps the slew rate by steps at 100 Hz or faster, smaller than those of the slow loop."""
    lab.note.write_text(json.dumps(lab.content | {"rate_hz": rate_hz, "trip_slew_v_per_s": 50.0}))
    lab.note.chmod(0o600)
    assert lab.park()[0] == GOOD
    assert_ramped(lab.board, 50.0, 100.0)


def test_no_note_is_no_mishap(lab: Lab):
    code, message = lab.park()
    assert (code, NOT_UNDERSTOOD in message) == (GOOD, False)
    assert_ramped(lab.board)


@pytest.mark.parametrize("case", ["FIFO", "folder", "mode 666", "mode 660"])
def test_a_note_that_others_may_have_made_is_refused_and_the_configuration_parked(lab: Lab, case: str):
    if case == "FIFO":
        os.mkfifo(lab.note, 0o600)
    elif case == "folder":
        lab.note.mkdir(0o700)
    else:
        lab.note.write_text(json.dumps(lab.content))
        lab.note.chmod(int(case[-3:], 8))
    code, message = lab.park()
    assert code == REFUSED
    assert str(lab.note) in message
    assert_ramped(lab.board)


@pytest.mark.parametrize("target", ["note", "nothing", "itself"])
def test_a_note_that_is_a_link_is_refused_and_the_configuration_parked(lab: Lab, tmp_path: Path, target: str):
    place = {"note": tmp_path / "elsewhere", "nothing": tmp_path / "missing", "itself": lab.note}[target]
    (tmp_path / "elsewhere").write_text(json.dumps(lab.content))
    lab.note.symlink_to(place)
    code, message = lab.park()
    assert code == REFUSED
    assert f"{lab.note}: a symbolic link" in message
    assert_ramped(lab.board)


def write_note_with_options(lab: Lab, **options: Any) -> None:
    """Write the note of a run whose driver options differ from the configuration by `options`."""
    lab.note.write_text(json.dumps(replace_options(**options)(lab.content)))
    lab.note.chmod(0o600)


def test_another_file_of_the_same_driver_is_another_board(lab: Lab, tmp_path: Path):
    write_note_with_options(lab, file=str(tmp_path / "other"))
    code, message = lab.park()
    assert (code, message.count("6.660 V")) == (GOOD, 2)
    assert_ramped(lab.board)
    assert lab.other_board.outputs_v[0] == 0.0


def test_two_channels_of_another_board_are_ramped(lab: Lab, tmp_path: Path):
    wiring = {"x": ["adc0", "dac0"], "y": ["adc1", "dac1"]}
    write_note_with_options(lab, file=str(tmp_path / "other"))
    lab.note.write_text(json.dumps(json.loads(lab.note.read_text()) | {"wiring": wiring}))
    assert lab.park()[0] == GOOD
    assert_ramped(lab.other_board)
    assert_ramped(lab.board)


def test_a_noted_board_that_is_gone_is_said_after_the_other_was_parked(lab: Lab, tmp_path: Path):
    write_note_with_options(lab, file=str(tmp_path / "gone"))
    code, message = lab.park()
    assert code == UNAVAILABLE
    assert "gone" in message
    assert "6.660 V" in message
    assert_ramped(lab.board)


def test_a_configured_board_that_is_gone_is_said_after_the_noted_one_was_parked(lab: Lab, tmp_path: Path):
    write_note_with_options(lab)
    lab.config.write_text(lab.config.read_text().replace(f'"{tmp_path}/board"', f'"{tmp_path}/gone"'))
    code, message = lab.park()
    assert code == UNAVAILABLE
    assert "gone" in message
    assert "6.660 V" in message
    assert_ramped(lab.board)


def test_a_silent_node_is_said_after_the_other_board_was_parked(lab: Lab):
    pytest.importorskip("can")
    options = {"interface": "udp_multicast", "channel": "239.74.163.77", "wait_s": 0.2,
               "settings": {"port": free_port(), "hop_limit": 0}}  # fmt: skip
    lab.note.write_text(json.dumps(lab.content | {"driver_kind": "can", "driver_options": json.dumps(options)}))
    lab.note.chmod(0o600)
    code, message = lab.park()
    assert code == UNAVAILABLE
    assert "no node has answered" in message
    assert_ramped(lab.board)


def free_port() -> int:
    """Return a free UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def test_all_that_failed_is_said(lab: Lab, tmp_path: Path):
    write_note_with_options(lab, file=str(tmp_path / "gone"))
    lab.config.write_text(lab.config.read_text().replace(f'"{tmp_path}/board"', f'"{tmp_path}/gone too"'))
    code, message = lab.park()
    assert code == UNAVAILABLE
    assert f"{tmp_path}/gone:" in message
    assert f"{tmp_path}/gone too:" in message


def test_a_slew_that_is_too_slow_is_named_by_its_key_in_the_configuration(lab: Lab):
    slow = lab.config.read_text().replace(f"trip_slew_v_per_s = {SLEW_V_PER_S}", "trip_slew_v_per_s = 0.5")
    lab.config.write_text(slow)
    code, message = lab.park()
    assert code == 78
    assert "axis.x.limits.trip_slew_v_per_s: 0.5 V/s; the ramp of 10 V from the end" in message
    assert "driver." not in message


def test_a_slow_axis_with_a_short_way_keeps_no_other_axis_from_being_parked(tmp_path: Path):
    """Each axis ends its ramp in 5 s at its own slew rate: the configuration is valid, and so is its note."""
    slew, dynamics = "trip_slew_v_per_s = 1000.0", "[driver.plants.y.dynamics]"
    x, name, y = (ROOT / "deploy" / "two-axis.toml").read_text().partition('name = "y"')
    x = x.replace(dynamics, f"[driver.plants.y.dac]\nrange_v = 5.0\n{dynamics}").replace(slew, "trip_slew_v_per_s = 2")
    y = y.replace(slew, "trip_slew_v_per_s = 1.0").replace("drive_v = 10.0", "drive_v = 5.0")
    config = tmp_path / "lab.toml"
    config.write_text(x + name + y)
    prepare(load(config), paced=False)
    hardware = configured_hardware(config)
    write_note(tmp_path / "lab.hardware", hardware)
    note = read_note(tmp_path / "lab.hardware")
    assert note is not None
    assert note.trip_slew_v_per_s == hardware.trip_slew_v_per_s == 1.0


def test_neither_note_nor_configuration_is_understood(lab: Lab):
    lab.note.write_text("{")
    lab.note.chmod(0o600)
    lab.config.write_text("[[axis")
    code, message = lab.park()
    assert code == 78
    assert NOT_UNDERSTOOD in message
    assert str(lab.config) in message
