"""What a user can get wrong about a backend, by the command line: one message each, exit 69 or 78, no traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.drivers.base import Wiring
from rtloop.drivers.shm import ShmDriver, ShmOptions
from rtloop.hil import board
from rtloop.hil.board import BoardMemory
from tests.drivers.comedi_board import new_board, stub_library
from tests.drivers.test_comedi_contract import comedi
from tests.one_axis import one_axis, wired

ROOT = Path(__file__).resolve().parents[2]
CONFIG = """
[loop]
rate_hz = 1000
mode = "raw"
[driver]
kind = "{kind}"
{options}
{channel}
{axis}
"""
HARDWARE, CONFIGURATION = 69, 78


@contextmanager
def untouched(path: Path) -> Iterator[None]:
    yield


@contextmanager
def absent(path: Path) -> Iterator[None]:
    path.unlink()
    yield


@contextmanager
def text_file(path: Path) -> Iterator[None]:
    path.write_text("no hardware")
    yield


@contextmanager
def comedi_in_use(path: Path) -> Iterator[None]:
    driver = comedi(path)
    driver.open()
    yield
    driver.close()


@contextmanager
def shm_in_use(path: Path) -> Iterator[None]:
    driver = ShmDriver(ShmOptions(file=str(path)), {"x": Wiring("adc0", "dac0")}, 1000.0)
    driver.open()
    yield
    driver.close()


@contextmanager
def shm_without_channels(path: Path) -> Iterator[None]:
    memory_of(path).facts["channels"] = 0
    yield


@contextmanager
def shm_switched_off(path: Path) -> Iterator[None]:
    memory_of(path).facts["magic"] = 0
    yield


def memory_of(path: Path) -> BoardMemory:
    with path.open("r+b") as file:
        return BoardMemory(file.fileno())


def idle_board(path: Path) -> Path:
    """The memory of a board of one channel, as it stands there while nobody moves it."""
    path.write_bytes(bytes(board.file_bytes()))
    facts = memory_of(path).facts
    facts["magic"], facts["version"], facts["channels"] = board.MAGIC, board.VERSION, 1
    return path


@dataclass(frozen=True)
class Case:
    """`message` stands in what is said, in which {device} is the hardware's path."""

    kind: str
    message: str
    code: int = HARDWARE
    hardware: Callable[..., object] = untouched
    options: dict[str, str] = field(default_factory=dict)
    channels: tuple[str, str] = ("ai0", "ao0")


def shm(message: str, code: int = HARDWARE, **more: object) -> Case:
    return Case("shm", message, code, **{"channels": ("adc0", "dac0"), **more})  # type: ignore[arg-type]


CASES = {
    "comedi: no library": Case("comedi", "libabsent.so: cannot open shared object file: No such file or directory; "
                               "install libcomedi0", options={"library": '"libabsent.so"'}),
    "comedi: no device": Case("comedi", "{device}: No such file or directory; is the board's kernel module loaded?",
                              hardware=absent),
    "comedi: not a device": Case("comedi", "{device}: Inappropriate ioctl for device; this is no comedi device",
                                 hardware=text_file),
    "comedi: in use": Case("comedi", "{device}: subdevice 0: another program uses it", hardware=comedi_in_use),
    "comedi: channel": Case("comedi", "{device}: ao9 is not a channel of this board; it has ao0 … ao3",
                            channels=("ai0", "ao9")),
    "comedi: range": Case("comedi", "{device}: ai0 has no range [-1.0, 1.0] V; it has [-10, 10], [-5, 5], [0, 5]",
                          options={"input_range_v": "[-1.0, 1.0]"}),
    "comedi: subdevice": Case("comedi", "input_subdevice: 1 has no analogue inputs; there are 0",
                              options={"input_subdevice": "1"}),
    "comedi: name": Case("comedi", "driver.channels.x.input: 'adc0'; allowed are ai0, ai1, …", CONFIGURATION,
                         channels=("adc0", "ao0")),
    "comedi: range upside down": Case("comedi", "input_range_v: [10, -10]; allowed is the lower end before the higher",
                                      CONFIGURATION, options={"input_range_v": "[10, -10]"}),
    "comedi: key": Case("comedi", "driver.devise: unknown key; did you mean device?", CONFIGURATION,
                        options={"devise": '"/dev/comedi1"'}),
    "shm: no board": shm("{device}: No such file or directory; start the board with `rtloop hil serve CONFIG`",
                         hardware=absent),
    "shm: not a board": shm("{device}: not a board's memory", hardware=text_file),
    "shm: board ended": shm("{device}: no board is running; start it with `rtloop hil serve CONFIG`",
                            hardware=shm_switched_off),
    "shm: in use": shm("{device}: another controller drives this board", hardware=shm_in_use),
    "shm: too few channels": shm("{device}: 0 channels, 1 are needed", hardware=shm_without_channels),
    "shm: channel": shm("driver.channels.x: 'adc7' is not a channel of this driver; it has adc0", CONFIGURATION,
                        channels=("adc7", "dac0")),
    "shm: rate": shm("driver.board_rate_hz: 2000000.0: ", CONFIGURATION, options={"board_rate_hz": "2e6"}),
    "no such kind": Case("comedy", "driver.kind: 'comedy' is not a known driver; there are ", CONFIGURATION),
}  # fmt: skip


def written(folder: Path, case: Case) -> tuple[Path, Path]:
    """The configuration and its hardware."""
    device = folder / "device"
    options = dict(case.options)
    if case.kind == "shm":
        idle_board(device)
        options["file"] = f'"{device}"'
    else:
        new_board(device)
        options = {"device": f'"{device}"', "library": f'"{stub_library()}"', **options}
    lines = "\n".join(f"{key} = {value}" for key, value in options.items())
    config = folder / "lab.toml"
    text = CONFIG.format(kind=case.kind, options=lines, channel=wired(*case.channels), axis=one_axis())
    config.write_text(text)
    return config, device


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_one_clear_message(tmp_path, case, monkeypatch):
    """`check` finds what the configuration alone shows; what the hardware shows is found by what opens it."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    config, device = written(tmp_path, case)
    with case.hardware(device):
        checked, opened = (CliRunner().invoke(main, [command, str(config)]) for command in ("check", "park"))
    assert checked.exit_code == (0 if case.code == HARDWARE else CONFIGURATION)
    assert opened.exit_code == case.code, opened.output
    said = [opened.stderr] if case.code == HARDWARE else [opened.stderr, checked.stderr]
    for text in said:
        assert case.message.format(device=device) in text
        assert text.startswith("rtloop: ")
        assert len(text.splitlines()) <= 2
        assert "Traceback" not in text


def test_limits_of_the_law_are_judged_by_check_and_do_not_keep_the_outputs_from_being_parked(tmp_path, monkeypatch):
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    config, _ = written(tmp_path, Case("comedi", "", options={"output_range_v": "[-5, 5]"}))
    checked, parked = (CliRunner().invoke(main, [command, str(config)]) for command in ("check", "park"))
    assert checked.exit_code == CONFIGURATION
    assert "axis.x.limits.drive_v: 10.0 is outside the driver's" in checked.stderr
    assert parked.exit_code == HARDWARE
    assert "ao0 has no range [-5.0, 5.0] V" in parked.stderr


@pytest.mark.parametrize("name", ["comedi: in use", "shm: in use"])
def test_a_run_says_the_same(tmp_path, name):
    case = CASES[name]
    config, device = written(tmp_path, case)
    with case.hardware(device):
        done = run(config)
    assert done.returncode == HARDWARE
    assert done.stderr.strip() == f"rtloop: {case.message.format(device=device)}"


@pytest.mark.parametrize("kind", ["comedi", "shm"])
def test_no_permission(tmp_path, kind):
    """For root too, once it has left its privilege to read what it may not."""
    case = shm("") if kind == "shm" else Case(kind, "")
    config, device = written(tmp_path, case)
    device.chmod(0)
    without = ("setpriv", "--bounding-set=-dac_override,-dac_read_search") if os.getuid() == 0 else ()
    done = run(config, *without)
    assert done.returncode == HARDWARE
    assert f"rtloop: {device}: Permission denied; " in done.stderr
    assert "Traceback" not in done.stderr


def run(config: Path, *before: str) -> subprocess.CompletedProcess[str]:
    command = [
        *before,
        sys.executable,
        "-m",
        "rtloop",
        "run",
        str(config),
        "--duration",
        "1",
        "--out",
        str(config.parent),
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=250, check=False)
