"""Commands on a CAN bus: node and loop as processes, and the message and exit code of each fault."""

from __future__ import annotations

import json
import math
import re
import signal
import sys
from pathlib import Path

import pytest

import rtloop as project
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.drivers.can.frames import DBC
from rtloop.drivers.can.node import serve
from rtloop.drivers.can.options import CanOptions
from rtloop.errors import ConfigError
from tests.command_line import answer, run
from tests.drivers.can_bench import configuration, free_port
from tests.drivers.processes import completed, rtloop

pytestmark = pytest.mark.system

TIMEOUT_S = 120


def run_command(*arguments: str | Path) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of a command."""
    result = completed(sys.executable, "-m", "rtloop", *arguments)
    assert "Traceback" not in result.stderr, result.stderr
    return result.returncode, result.stdout, result.stderr


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Return a configuration of a loop and a node on a free port."""
    return configuration(tmp_path, free_port())


def replace_text(config: Path, old: str, new: str) -> None:
    """Replace the first `old` in a configuration file."""
    config.write_text(config.read_text().replace(old, new, 1))


@pytest.mark.parametrize("first", ["node", "loop"])
def test_a_run_over_the_bus_loses_nothing_and_replays(config, first):
    commands = {"node": ("hil", "serve", config, "--can"), "loop": ("run", config, "--duration", "1", "--json")}
    processes = {}
    for name in sorted(commands, key=lambda name: name != first):
        processes[name] = rtloop(*commands[name])
        if name == first == "node":
            assert "node on CAN bus udp_multicast" in processes["node"].stderr.readline()
    out, err = processes["loop"].communicate(timeout=TIMEOUT_S)
    processes["node"].send_signal(signal.SIGINT)
    _, log = processes["node"].communicate(timeout=TIMEOUT_S)
    assert processes["loop"].returncode == 0, err + log
    assert processes["node"].returncode == 0, log
    assert "0 drive frames ignored" in log
    summary = json.loads(out)
    assert (summary["ticks_logged"], summary["ticks_lost"]) == (500, 0)
    recording = project.load(summary["recording"])
    for name in ("can_lost_samples", "can_reordered_samples", "can_duplicated_samples", "can_invalid_frames"):
        assert recording[name][-1] == 0, name
    assert 0 < recording["sample_age_us"].min() < recording["sample_age_us"].max() < math.inf
    assert recording["x_drive_v"][-1] > 1.0
    assert answer("replay", summary["recording"])["identical"] is True


FAULTS = {
    "the rate": (
        "rate_hz = 500.0",
        "rate_hz = 5000",
        r"loop\.rate_hz: 5000 Hz; allowed with driver 'can': at most 4761\.9 Hz",
    ),
    "interface": ('"udp_multicast"', '"carrier_pigeon"', "interface: 'carrier_pigeon'; allowed: .*socketcan"),
    "data rate": ("wait_s = 60", "data_bitrate = 5000000", "data_bitrate: 5000000 bit/s; allowed with fd = true only"),
    "description": ("wait_s = 60", 'dbc = "/nowhere.dbc"', r"driver\.dbc: /nowhere\.dbc: No such file"),
    "a channel": ('"adc0"', '"adc7"', "'adc7' is not a channel of this driver; allowed: adc0"),
    "hold": ("hold_ticks = 500", "hold_ticks = -1", "hold_ticks: -1"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_configuration_is_refused(config, fault):
    old, new, message = FAULTS[fault]
    replace_text(config, old, new)
    with pytest.raises(ConfigError, match=message):
        prepare(load(config))


OWN_DBC = {
    "another name in Drive1": (r"(BO_ 256 (.*\n)+?.*)Drive_0", r"\1Volt_0", "Drive1 has the signals Sequence, Volt_0"),
    "no Age in Sample1": (r"(BO_ 384 (.*\n)+?) SG_ Age.*\n", r"\1", "Sample1 has the signals Sequence, Sample_0"),
    "no Node": (r"BO_ 1024 (.*\n)+?\n", "", "has no message Node"),
    "no Identity in Node": (r" SG_ Identity .*\n", "", "Node has the signals Channels, Serving, Watchdog;"),
}


@pytest.mark.parametrize("case", OWN_DBC)
def test_a_dbc_with_other_signals_is_refused_by_name(config: Path, case: str):
    pattern, replacement, message = OWN_DBC[case]
    changed, count = re.subn(pattern, replacement, DBC.read_text(), count=1)
    assert count == 1
    dbc = config.with_name("own.dbc")
    dbc.write_text(changed)
    replace_text(config, "wait_s = 60", f'dbc = "{dbc}"')
    if "Node" not in case:
        with pytest.raises(ConfigError, match=rf"driver\.dbc: {dbc}: {message}"):
            prepare(load(config))
    options = load(config).driver_options
    assert isinstance(options, CanOptions)
    with pytest.raises(ValueError, match=f"^dbc: {dbc}: {message}"):
        serve(options, ["x"], lambda: True)


def test_a_rate_above_the_bus_is_refused_by_the_command(tmp_path):
    result = run("check", configuration(tmp_path, free_port(), rate_hz=4800.0))
    assert (result.exit_code, "4800 Hz; allowed with driver 'can': at most 4761.9 Hz" in result.stderr) == (78, True)


@pytest.mark.parametrize(
    ("old", "new", "command"),
    [
        ('channel = "239.74.163.77"', 'channel = "no group"', ("hil", "serve", "--can")),
        ('interface = "udp_multicast"', 'interface = "socketcan"', ("run", "--duration", "1")),
    ],
)
def test_a_missing_bus_gives_one_message_and_exit_69(config, old, new, command):
    replace_text(config, old, new)
    code, _, err = run_command(*command, config)
    assert code == 69, err
    assert err.count("rtloop: CAN bus") == 1, err


def test_without_a_node_the_message_names_the_command_that_starts_one(config):
    replace_text(config, "wait_s = 60", "wait_s = 0.2")
    code, _, err = run_command("run", config, "--duration", "1")
    assert code == 69
    advice = "switch the node on, or start a simulated node with `rtloop hil serve CONFIG --can`"
    assert f"no node has answered within 0.2 s; {advice}" in err


def test_a_node_of_another_kind_is_refused(config):
    code, _, err = run_command("hil", "serve", config)
    assert (code, "'can' for `rtloop hil serve --can`" in err) == (78, True)


def test_a_missing_extra_is_named(config):
    program = "import sys; sys.modules['cantools'] = None; from rtloop.cli import main; main()"
    result = completed(sys.executable, "-c", program, "check", config)
    assert result.returncode == 78, result.stderr
    assert "pip install 'rtloop[can]'" in result.stderr
    assert "Traceback" not in result.stderr
