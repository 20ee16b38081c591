"""Messages to users: the line of a key, numbers in full, no line or column of a text that the user did not write."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from rtloop.configuration.toml_lines import key_lines, numbered
from tests.command_line import run
from tests.recording.hand_made_loop import make_rows, write_recording
from tests.recording.real_loop import TWO_AXES, record

PAPER = Path(__file__).resolve().parents[1] / "deploy" / "paper.toml"
TEXT = """# a comment with key = 1
[loop]
rate_hz = 10000
"mode" = 'raw'

[driver.channels.x]
um_per_v = 10.0

[[axis]]
name = "x"
[axis.limits]
drive_v = 10.0
[[axis]]
margins.gain = 2.0
name = 'y'
[axis.limits]
drive_v = 9.0
[axis.feedforward]
thresholds_v = [
    0.0,
    1.0,
]
[[schedule]]
at_tick = 5
[[schedule]]
at_tick = 6
"""


def test_every_key_has_its_line() -> None:
    lines = key_lines(TEXT)
    expected = {
        "loop": 2, "loop.rate_hz": 3, "loop.mode": 4, "driver.channels.x.um_per_v": 7, "axis.x": 9, "axis.x.name": 10,
        "axis.x.limits.drive_v": 12, "axis.y": 13, "axis.y.margins.gain": 14, "axis.y.limits": 16,
        "axis.y.limits.drive_v": 17, "axis.y.feedforward.thresholds_v": 19, "schedule.0.at_tick": 24,
        "schedule.1.at_tick": 26,
    }  # fmt: skip
    assert {key: lines.get(key) for key in expected} == expected


def test_a_fault_has_the_line_of_the_key_or_of_its_section(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text(TEXT)
    faults = ["axis.y.feedforward.thresholds_v.1: nan", "axis.y.limits.slew: unknown", "recording.x: 1", "all: wrong"]
    assert numbered(faults, str(file)) == [
        "line 19: axis.y.feedforward.thresholds_v.1: nan",
        "line 16: axis.y.limits.slew: unknown",
        "recording.x: 1",
        "all: wrong",
    ]
    assert numbered(faults, "no file") == faults


@pytest.mark.parametrize(
    ("old", "new", "at", "message"),
    [
        ("um_per_v = 10.0", "um_per_v = nan", "um_per_v = nan", "driver.channels.x.um_per_v: nan: must be a finite"),
        ("gain = 0.016", "gain = 16.0", "[axis.controller]", "axis.x.controller: the loop is unstable"),
    ],
    ids=["a key", "how sections fit"],
)
def test_check_prints_the_line_of_a_fault(tmp_path: Path, old: str, new: str, at: str, message: str) -> None:
    file = tmp_path / "own.toml"
    file.write_text(PAPER.read_text().replace(old, new, 1))
    line = file.read_text().splitlines().index(at) + 1
    result = run("check", file)
    assert result.exit_code == 78
    assert f"{file}: 1 fault\n  line {line}: {message}" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("tune", "x", "limits", "drive_v="), "'drive_v=' is no list of keys; allowed: `key = value, key = value`"),
        (("tune", "x", "limits", "{"), "'{' is no list of keys; allowed: `key = value, key = value`"),
    ],
)
def test_a_usage_error_quotes_the_argument(arguments: tuple[object, ...], message: str) -> None:
    result = run("ctl", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert "column" not in result.stderr


@pytest.mark.parametrize(
    ("axis", "file", "message"),
    [
        ("x", PAPER.with_name("own-stage.toml"), "no controller for axis 'x'; axis x has no [axis.controller]"),
        ("z", PAPER, "no controller for axis 'z'; the axes of this file are x"),
    ],
)
def test_a_configuration_without_the_controller_is_a_fault_of_it(axis: str, file: Path, message: str) -> None:
    result = run("ctl", "controller", axis, file)
    assert result.exit_code == 78
    assert message in result.stderr


@pytest.mark.parametrize(
    ("command", "content", "fault"),
    [
        ("waveform", "1.0\n\nabc\n", ", line 3: 'abc'; allowed: numbers"),
        (
            "learn",
            "1.0, 0.1\n2.0, 0.2\n",
            ": two numbers in every line, as in a learned table; allowed: one number in every line, the reference",
        ),
    ],
)
def test_a_file_of_wrong_numbers_is_a_usage_error(command: str, content: str, fault: str, tmp_path: Path) -> None:
    file = tmp_path / "numbers.txt"
    file.write_text(content)
    result = run("ctl", command, "x", file)
    assert result.exit_code == 2
    assert f"{file}{fault}" in result.stderr


def test_a_file_that_is_no_text_is_refused_in_a_sentence(tmp_path: Path) -> None:
    file = tmp_path / "wave.bin"
    file.write_bytes(b"1.0\n\xff\xfe2\n")
    for command in ("waveform", "learn"):
        result = run("ctl", command, "x", file)
        assert result.exit_code == 2, command
        assert f"{file}, line 2: '��2'; allowed: numbers" in result.stderr
    assert run("ctl", "retune", "x", "--swap", file).exit_code


def test_a_recording_of_several_axes_needs_the_option_axis(tmp_path: Path) -> None:
    (path,) = record(tmp_path / "run.mcap", TWO_AXES, 200)
    for arguments, fault in (
        ((), "several axes; select one of x, y"),
        (("--axis", "z"), "no axis 'z'; select one of x, y"),
    ):
        result = run("identify", "hysteresis", path, *arguments)
        assert result.exit_code == 66
        assert f"{path}: {fault} with --axis" in result.stderr


def test_a_narrow_terminal_cuts_no_number(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", make_rows(500))
    outputs = [
        subprocess.run(
            [sys.executable, "-m", "rtloop", "info", str(path)], capture_output=True, text=True,
            env=os.environ | {"COLUMNS": columns}, check=True,
        ).stdout
        for columns in ("40", "200")
    ]  # fmt: skip
    assert outputs[0] == outputs[1]
    assert "…" not in outputs[0].replace(" … ", "")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "rate_hz = 10000",
            "rate_hz = 1000,5",
            "line {n}, column 15: not valid TOML: .*a decimal number has a point: 1000.5",
        ),
        ('name = "x"', 'name = "x', "line {n}, column 10: not valid TOML: .*a quotation mark is missing"),
        ('kind = "sim"', "kind = sim", 'line {n}, column 8: not valid TOML: .*text has quotation marks: "sim"'),
        ("[axis.limits]", "[axis.limits", "line {n}, column 13: not valid TOML: .*a bracket is missing"),
        (
            "levels = [20.0, 0.0, -20.0, 0.0]",
            "levels = [20.0, 0.0, -20.0, 0.0",
            "line {n}: .*Unclosed.*a bracket is miss",
        ),
        ("drive_v = 10.0 ", "drive_v 10.0 ", "line {n}, column 9: not valid TOML: Expected '=' after a key"),
    ],
)
def test_a_slip_of_toml_is_shown_with_its_line_and_a_hint(old: str, new: str, message: str, tmp_path: Path) -> None:
    text, config = PAPER.read_text(encoding="utf-8"), tmp_path / "slip.toml"
    assert f"\n{old}" in text
    config.write_text(text.replace(f"\n{old}", f"\n{new}", 1))
    line = text[: text.index(f"\n{old}")].count("\n") + 2
    result = run("check", config)
    assert result.exit_code == 78
    heading, fault = result.stderr.splitlines()
    assert heading == f"rtloop: {config}: 1 fault"
    assert re.match(message.format(n=line), fault.strip()), fault
    assert f", in: {new.strip()}" in fault


@pytest.mark.parametrize(("text", "message"), [
    ("poles = [[-1, 0], [-2, 0]\nallow_unstable = true\n", "line 1: not valid TOML: Unclosed array; a bracket"),
    ("[loop]\nmodes = [\n  1,\n]\n\ngain =", "line 6: not valid TOML: Invalid value, in: gain ="),
    ("label = \"a # b\"\nrate_hz = 1,5\n", "line 2, column 12: not valid TOML: .*a decimal number has a point: 1.5"),
    ("a = 1\nrate_hz = inf nan\n", "line 2, column 15: not valid TOML: [^;]*, in: rate_hz = inf nan"),
])  # fmt: skip
def test_a_slip_of_toml_blames_no_line_that_is_right(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "slip.toml").write_text(text)
    result = run("check", tmp_path / "slip.toml")
    assert re.match(message, result.stderr.splitlines()[1].strip()), result.stderr


def test_a_file_of_another_kind_is_named_with_its_commands(tmp_path: Path) -> None:
    """Configuration, specification and recording, each in place of each other one."""
    (recording,), large = record(tmp_path / "run", TWO_AXES, 100), tmp_path / "large.mcap"
    large.write_bytes(recording.read_bytes().ljust(2 << 20))
    spec, folder = PAPER.parent / "paper-spec.toml", tmp_path
    for arguments, code, message in (
        (("check", recording), 66, "a recording, not a text file; `rtloop info`"),
        (("run", large), 66, "a recording, not a text file; `rtloop info`"),
        (("design", "synthesise", recording), 66, "a recording, not a text file; `rtloop info`"),
        (("info", PAPER), 66, "not a recording: a text in TOML; `rtloop check`"),
        (("identify", "hysteresis", spec), 66, "not a recording: a text in TOML; `rtloop check`"),
        (("check", spec), 78, "this file is a specification; give a configuration"),
        (("design", "shape", spec, "--out", folder / "out.toml"), 78, "this file is a specification"),
        (
            ("design", "verify", PAPER, "--spec", PAPER),
            78,
            "this file is a configuration; allowed: a specification",
        ),
        (("design", "robust", PAPER), 78, "this file is a configuration; allowed: a specification"),
    ):
        result = run(*arguments)
        assert result.exit_code == code, result.output
        assert message in result.stderr
        assert len(result.stderr.splitlines()) <= 2, result.stderr
