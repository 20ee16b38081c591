"""The commands on a CAN bus as a user gives them: node and loop as processes, and what is said where none can be."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import rtloop as project
from tests.drivers.can_bench import ENVIRONMENT, configuration, free_port, rtloop

TIMEOUT_S = 120


def said(*arguments: str | Path) -> tuple[int, str, str]:
    process = rtloop(*arguments)
    out, err = process.communicate(timeout=TIMEOUT_S)
    assert "Traceback" not in err, err
    return process.returncode, out, err


@pytest.mark.parametrize("first", ["node", "loop"])
def test_a_run_over_the_bus_loses_nothing_and_replays(tmp_path, first):
    config = configuration(tmp_path, free_port())
    commands = {"node": ("hil", "serve", config, "--can"), "loop": ("run", config, "--duration", "1", "--json")}
    second = "loop" if first == "node" else "node"
    processes = {first: rtloop(*commands[first])}
    if first == "node":
        assert processes["node"].stderr is not None
        assert "node on CAN bus udp_multicast" in processes["node"].stderr.readline()
    processes[second] = rtloop(*commands[second])
    out, err = processes["loop"].communicate(timeout=TIMEOUT_S)
    processes["node"].send_signal(signal.SIGINT)
    _, told = processes["node"].communicate(timeout=TIMEOUT_S)
    assert processes["loop"].returncode == 0, err + told
    assert processes["node"].returncode == 0, told
    assert "0 drive frames ignored" in told
    summary = json.loads(out)
    assert (summary["ticks_logged"], summary["ticks_lost"]) == (500, 0)
    recording = project.load(summary["recording"])
    for name in ("can_lost_samples", "can_reordered_samples", "can_duplicated_samples", "can_invalid_frames"):
        assert recording[name][-1] == 0, name
    assert 0 < recording["sample_age_us"].min() < recording["sample_age_us"].max() < math.inf
    assert recording["x_drive_v"][-1] > 1.0
    code, out, err = said("replay", summary["recording"], "--json")
    assert (code, json.loads(out)["identical"]) == (0, True), err


BAD = {
    "the rate": ("rate_hz = 500.0", "rate_hz = 5000", r"loop\.rate_hz: 5000 is above the 4761\.9 Hz of driver 'can'"),
    "interface": ('"udp_multicast"', '"carrier_pigeon"', "interface: 'carrier_pigeon'; python-can has .*socketcan"),
    "data rate": ("wait_s = 60", "data_bitrate = 5000000", "data_bitrate: 5000000; allowed with fd = true only"),
    "description": ("wait_s = 60", 'dbc = "/nowhere.dbc"', r"driver\.dbc: /nowhere\.dbc: No such file"),
    "a channel": ('"adc0"', '"adc7"', "'adc7' is not a channel of this driver; it has adc0"),
    "hold": ("hold_ticks = 500", "hold_ticks = -1", "hold_ticks: -1"),
}


@pytest.mark.parametrize("fault", BAD)
def test_what_a_configuration_may_not_say(tmp_path, fault):
    from rtloop.configuration.file import load
    from rtloop.configuration.prepare import prepare
    from rtloop.errors import ConfigError

    old, new, message = BAD[fault]
    config = configuration(tmp_path, free_port())
    config.write_text(config.read_text().replace(old, new, 1))
    with pytest.raises(ConfigError, match=message):
        prepare(load(config))


def test_a_rate_above_the_bus_is_refused_by_the_command(tmp_path):
    code, _, err = said("check", configuration(tmp_path, free_port(), rate_hz=4800.0))
    assert (code, "4800 is above the 4761.9 Hz of driver 'can'" in err) == (78, True)


@pytest.mark.parametrize(
    ("old", "new", "command"),
    [
        ('channel = "239.74.163.77"', 'channel = "no group"', ("hil", "serve", "--can")),
        ('interface = "udp_multicast"', 'interface = "socketcan"', ("run", "--duration", "1")),
    ],
)
def test_a_bus_that_is_not_there(tmp_path, old, new, command):
    """One message, exit 69."""
    config = configuration(tmp_path, free_port())
    config.write_text(config.read_text().replace(old, new))
    code, _, err = said(*command, config)
    assert code == 69, err
    assert err.count("rtloop: CAN bus") == 1, err


def test_no_node_is_said_with_what_to_do(tmp_path):
    config = configuration(tmp_path, free_port())
    config.write_text(config.read_text().replace("wait_s = 60", "wait_s = 0.2"))
    code, _, err = said("run", config, "--duration", "1")
    assert code == 69
    assert "no node has answered within 0.2 s; for a simulated one: `rtloop hil serve CONFIG --can`" in err


def test_the_node_of_another_kind(tmp_path):
    config = configuration(tmp_path, free_port())
    code, _, err = said("hil", "serve", config)
    assert (code, "with --can the node of kind 'can'" in err) == (78, True)


def test_a_missing_extra_is_named(tmp_path):
    program = "import sys; sys.modules['cantools'] = None; from rtloop.cli import main; main()"
    command = [sys.executable, "-c", program, "check", str(configuration(tmp_path, free_port()))]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.returncode == 78, done.stderr
    assert "pip install 'rtloop[can]'" in done.stderr
    assert "Traceback" not in done.stderr
