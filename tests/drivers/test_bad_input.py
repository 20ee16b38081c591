"""Each fault of a driver's configuration or hardware gives one message on the command line and exit 69 or 78."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from click.testing import CliRunner, Result

from rtloop.cli import main
from rtloop.drivers.base import Driver, Wiring
from rtloop.drivers.shm import ShmDriver, ShmOptions
from rtloop.hil import board
from tests.drivers.comedi_board import new_board, stub_library
from tests.drivers.processes import board_memory, completed
from tests.drivers.test_comedi_contract import comedi
from tests.stage_text import one_axis, wired

pytestmark = pytest.mark.system

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


def write_other_content(path: Path) -> None:
    """Make the device a file that is no hardware."""
    path.write_text("no hardware")


def open_comedi(path: Path) -> Driver:
    """Return an open comedi driver, which occupies the board."""
    driver = comedi(path)
    driver.open()
    return driver


def open_shm(path: Path) -> Driver:
    """Return an open shm driver, which occupies the board."""
    driver = ShmDriver(ShmOptions(file=str(path)), {"x": Wiring("adc0", "dac0")}, 1000.0)
    driver.open()
    return driver


def remove_channels(path: Path) -> None:
    """Set the board's number of channels to 0."""
    board_memory(path).facts["channels"] = 0


def end_board(path: Path) -> None:
    """Leave the board's memory as after the board's end."""
    board_memory(path).facts["magic"] = 0


def idle_board(path: Path) -> Path:
    """Write the memory of a board with one channel that no process serves."""
    path.write_bytes(bytes(board.file_bytes()))
    facts = board_memory(path).facts
    facts["magic"], facts["version"], facts["channels"] = board.MAGIC, board.VERSION, 1
    return path


@dataclass(frozen=True)
class Case:
    """A fault of configuration or hardware; `message` is in the error text, {device} is the hardware's path."""

    kind: str
    message: str
    code: int = HARDWARE
    hardware: Callable[[Path], Driver | None] = lambda path: None
    """Function that prepares the hardware; it returns a driver that stays open, or None."""
    options: dict[str, str] = field(default_factory=dict)
    channels: tuple[str, str] = ("ai0", "ao0")


def shm(message: str, code: int = HARDWARE, **more: object) -> Case:
    """Return a case of kind shm with the board's first channels."""
    return Case("shm", message, code, **{"channels": ("adc0", "dac0"), **more})  # type: ignore[arg-type]


CASES = {
    "comedi: no library": Case("comedi", "libabsent.so: cannot open shared object file: No such file or directory; "
                               "install libcomedi0", options={"library": '"libabsent.so"'}),
    "comedi: another library": Case("comedi", "undefined symbol: comedi_open; install libcomedi0",
                                    options={"library": '"libm.so.6"'}),
    "comedi: no device": Case("comedi", "{device}: No such file or directory; load the board's kernel module",
                              hardware=Path.unlink),
    "comedi: not a device": Case("comedi", "{device}: Inappropriate ioctl for device; not a comedi device",
                                 hardware=write_other_content),
    "comedi: in use": Case("comedi", "{device}: subdevice 0: another program uses this subdevice; stop that program",
                           hardware=open_comedi),
    "comedi: channel": Case("comedi", "{device}: ao9 is not a channel of this board; allowed: ao0 … ao3",
                            channels=("ai0", "ao9")),
    "comedi: range": Case("comedi", "{device}: ai0 has no range [-1.0, 1.0] V; allowed: [-10, 10], [-5, 5], [0, 5]",
                          options={"input_range_v": "[-1.0, 1.0]"}),
    "comedi: subdevice": Case("comedi", "input_subdevice: 1 has no analogue inputs; allowed: 0",
                              options={"input_subdevice": "1"}),
    "comedi: name": Case("comedi", "driver.channels.x.input: 'adc0'; allowed: ai0, ai1, …", CONFIGURATION,
                         channels=("adc0", "ao0")),
    "comedi: range upside down": Case("comedi", "input_range_v: [10, -10] V; allowed: the lower end before the higher",
                                      CONFIGURATION, options={"input_range_v": "[10, -10]"}),
    "comedi: key": Case("comedi", "driver.devise: unknown key; did you mean device?", CONFIGURATION,
                        options={"devise": '"/dev/comedi1"'}),
    "shm: no board": shm("{device}: No such file or directory; start the board with `rtloop hil serve CONFIG`",
                         hardware=Path.unlink),
    "shm: not a board": shm("{device}: this file is not the memory of a board", hardware=write_other_content),
    "shm: board ended": shm("{device}: no board is running; start the board with `rtloop hil serve CONFIG`",
                            hardware=end_board),
    "shm: in use": shm("{device}: another controller drives this board; stop the other controller", hardware=open_shm),
    "shm: too few channels": shm("{device}: the board has 0 channels; allowed: at least 1", hardware=remove_channels),
    "shm: channel": shm("driver.channels.x: 'adc7' is not a channel of this driver; allowed: adc0", CONFIGURATION,
                        channels=("adc7", "dac0")),
    "shm: rate": shm("driver.board_rate_hz: 2000000.0: ", CONFIGURATION, options={"board_rate_hz": "2e6"}),
    "no such kind": Case("comedy", "driver.kind: 'comedy' is not a known driver; allowed: ", CONFIGURATION),
}  # fmt: skip


@pytest.fixture
def prepare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Case], tuple[Path, Path]]]:
    """Yield a function that writes a case's configuration and hardware and returns their paths."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    config, device, users = tmp_path / "lab.toml", tmp_path / "device", list[Driver]()

    def write(case: Case) -> tuple[Path, Path]:
        if case.kind == "shm":
            idle_board(device)
            options = {**case.options, "file": f'"{device}"'}
        else:
            new_board(device)
            options = {"device": f'"{device}"', "library": f'"{stub_library()}"', **case.options}
        lines = "\n".join(f"{key} = {value}" for key, value in options.items())
        config.write_text(CONFIG.format(kind=case.kind, options=lines, channel=wired(*case.channels), axis=one_axis()))
        if (user := case.hardware(device)) is not None:
            users.append(user)
        return config, device

    yield write
    for user in users:
        user.close()


def check_and_park(config: Path) -> list[Result]:
    """Return the results of `rtloop check` and `rtloop park`."""
    return [CliRunner().invoke(main, [command, str(config)]) for command in ("check", "park")]


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_fault_gives_one_clear_message(prepare, case):
    """`check` finds faults of the configuration; `park`, which opens the hardware, also finds those of the hardware."""
    config, device = prepare(case)
    checked, opened = check_and_park(config)
    assert checked.exit_code == (0 if case.code == HARDWARE else CONFIGURATION)
    assert opened.exit_code == case.code, opened.output
    for text in [opened.stderr] if case.code == HARDWARE else [opened.stderr, checked.stderr]:
        assert case.message.format(device=device) in text
        assert text.startswith("rtloop: ")
        assert len(text.splitlines()) <= 2
        assert "Traceback" not in text


def test_limits_of_the_law_are_judged_by_check_and_do_not_prevent_parking(prepare):
    config, _ = prepare(Case("comedi", "", options={"output_range_v": "[-5, 5]"}))
    checked, parked = check_and_park(config)
    assert checked.exit_code == CONFIGURATION
    assert "axis.x.limits.drive_v: 10.0 V; allowed: within the driver's" in checked.stderr
    assert parked.exit_code == HARDWARE
    assert "ao0 has no range [-5.0, 5.0] V" in parked.stderr


def run_loop(config: Path, *prefix: str) -> CompletedProcess[str]:
    """Run a loop for one second in a separate process, behind a command `prefix`, and return the result."""
    command = (sys.executable, "-m", "rtloop", "run", config, "--duration", "1", "--out", config.parent)
    return completed(*prefix, *command)


@pytest.mark.parametrize("name", ["comedi: in use", "shm: in use"])
def test_run_gives_the_same_message(prepare, name):
    config, device = prepare(CASES[name])
    result = run_loop(config)
    assert result.returncode == HARDWARE
    assert result.stderr.strip() == f"rtloop: {CASES[name].message.format(device=device)}"


@pytest.mark.parametrize("case", [Case("comedi", ""), shm("")], ids=["comedi", "shm"])
def test_missing_permission_is_named(prepare, case):
    """The test also holds for root, whose privilege to read any file is dropped."""
    config, device = prepare(case)
    device.chmod(0)
    prefix = ("setpriv", "--bounding-set=-dac_override,-dac_read_search") if os.getuid() == 0 else ()
    result = run_loop(config, *prefix)
    assert result.returncode == HARDWARE
    assert f"rtloop: {device}: Permission denied; " in result.stderr
    assert "Traceback" not in result.stderr
