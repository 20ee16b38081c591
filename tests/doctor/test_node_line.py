"""The line to a node, broken in turn on a host of files: each finding names the command that mends it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rtloop.configuration.file import parse
from rtloop.doctor.examine import check_conditions
from rtloop.doctor.node_conditions import check_line
from rtloop.doctor.node_line import NetworkLine, SerialLine, find_line, find_network_line
from rtloop.doctor.remedy import apply_remedies
from rtloop.engine.plan import Pacing
from tests.doctor.hosts import host
from tests.stage_text import one_axis

PACING = Pacing(10_000.0, cpu=3)
NET = "sys/class/net/eth1"
INTERRUPTS = """           CPU0       CPU1       CPU2       CPU3
  9:          0          0          0          0   IO-APIC    9-fasteoi   acpi
 24:        100          0          0          0  IR-PCI-MSI-0000:01:00.0  0-edge      eth1-rx-0
 25:          0        200          0          0  IR-PCI-MSI-0000:01:00.0  1-edge      eth1, other
 26:          0          0          0          0  IR-PCI-MSI-0000:02:00.0  0-edge      eth10-rx-0
NMI:          0          0          0          0   Non-maskable interrupts
"""
WIRED = {
    f"{NET}/operstate": "up\n",
    f"{NET}/speed": "1000\n",
    f"{NET}/duplex": "full\n",
    "proc/interrupts": INTERRUPTS,
    "proc/irq/24/smp_affinity_list": "0-2\n",
    "proc/irq/25/smp_affinity_list": "1\n",
    "proc/irq/26/smp_affinity_list": "0-3\n",
}
ETH1 = NetworkLine("192.168.10.2", "eth1", 0, False, False)
BROKEN = {
    "no route": ({}, NetworkLine("192.168.10.2"), "node's network", "ip address add"),
    "wireless": ({f"{NET}/wireless/x": ""}, ETH1, "node's network", "by a cable"),
    "down": ({f"{NET}/operstate": "down\n"}, ETH1, "node's network", "sudo ip link set eth1 up"),
    "slow": ({f"{NET}/speed": "10\n"}, ETH1, "node's cable", "sudo ethtool -s eth1 autoneg on"),
    "half duplex": ({f"{NET}/duplex": "half\n"}, ETH1, "node's cable", "sudo ethtool -s eth1 autoneg on"),
    "coalescing": (
        {}, NetworkLine("192.168.10.2", "eth1", 125, False, False), "interrupt coalescing",
        "sudo ethtool -C eth1 adaptive-rx off rx-usecs 0",
    ),
    "adaptive": (
        {}, NetworkLine("192.168.10.2", "eth1", 0, True, False), "interrupt coalescing",
        "sudo ethtool -C eth1 adaptive-rx off rx-usecs 0",
    ),
    "joined": (
        {}, NetworkLine("192.168.10.2", "eth1", 0, False, True), "large receive offload",
        "sudo ethtool -K eth1 lro off",
    ),
    "interrupts": (
        {"proc/irq/24/smp_affinity_list": "0-3\n"}, ETH1, "card's interrupts",
        "echo 0-2 | sudo tee /proc/irq/24/smp_affinity_list",
    ),
}  # fmt: skip


def bad_findings(findings) -> list[tuple[str, str]]:
    """Return conditions and remedies of the bad findings."""
    return [(finding.condition, finding.fix) for finding in findings if finding.good is False]


def test_a_key_and_a_good_cable_have_six_good_findings(tmp_path):
    findings = check_line(ETH1, host(tmp_path, WIRED), PACING)
    assert [finding.good for finding in findings] == [True] * 6


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_condition_alone_is_bad_and_names_its_command(case, tmp_path):
    files, line, condition, command = BROKEN[case]
    ((name, fix),) = bad_findings(check_line(line, host(tmp_path, WIRED | files), PACING))
    assert name == condition
    assert command in fix


def test_what_a_card_does_not_tell_is_unknown(tmp_path):
    findings = check_line(NetworkLine("192.168.10.2", "eth1"), host(tmp_path), PACING)
    assert [finding.good for finding in findings] == [True, True, None, None, None, None]


def test_a_missing_key_is_bad_on_every_line(tmp_path):
    for line in (replace(ETH1, key_fault="none"), replace(SERIAL, key_fault="none")):
        ((name, fix),) = bad_findings(check_line(line, host(tmp_path, WIRED), PACING))
        assert name == "node's key"
        assert "openssl rand -hex 16" in fix


def test_interrupts_of_the_card_are_moved_on_request(tmp_path):
    files = WIRED | {"proc/irq/24/smp_affinity_list": "0-3\n"}
    broken_host = host(tmp_path, files)
    (write,) = apply_remedies(check_line(ETH1, broken_host, PACING), tmp_path)
    assert (write.condition, write.text, write.refused) == ("card's interrupts", "0-2", "")
    assert bad_findings(check_line(ETH1, broken_host, PACING)) == []


def test_nothing_is_judged_on_the_loopback_interface(tmp_path):
    for address in ("127.0.0.1", "localhost"):
        line = find_network_line(address, 5747, None)
        assert line.interface == "lo"
        assert [finding.good for finding in check_line(line, host(tmp_path), PACING)] == [True, True]


def test_an_address_that_does_not_exist_has_no_route(tmp_path):
    line = find_network_line("192.168.10.2", 5747, "203.0.113.1")  # no address of this computer
    assert bad_findings(check_line(line, host(tmp_path), PACING))[0][0] == "node's network"


SERIAL = SerialLine("/dev/ttyUSB0")
TIMER = "sys/bus/usb-serial/devices/ttyUSB0/latency_timer"
FLAGS = "sys/class/tty/ttyUSB0/flags"


@pytest.mark.parametrize(
    ("files", "states", "command"),
    [
        ({TIMER: "1\n", FLAGS: "0x2000\n"}, [True, True], ""),
        ({TIMER: "16\n"}, [False, None], f"echo 1 | sudo tee /{TIMER}"),
        ({FLAGS: "0x90000040\n"}, [None, False], "sudo setserial /dev/ttyUSB0 low_latency"),
        ({}, [None, None], ""),
    ],
)
def test_a_terminal_must_hand_bytes_on_at_once(files, states, command, tmp_path):
    findings = check_line(SERIAL, host(tmp_path, files), PACING)
    assert [finding.good for finding in findings[1:]] == states
    assert "".join(fix for _, fix in bad_findings(findings)) == command


HEAD = """
[loop]
rate_hz = 1000
[driver]
{driver}
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
"""


@pytest.mark.parametrize(
    ("driver", "line"),
    [
        ('kind = "sim"', None),
        (
            'kind = "serial"\ndevice = "/dev/none-such"',
            SerialLine(
                "/dev/none-such",
                "driver.key: none, so everybody who may open the serial line, such as the group dialout, can drive the "
                "node; make a key (docs/drivers.md, A key)",
            ),
        ),
    ],
)
def test_the_line_is_that_of_the_configuration(driver, line, tmp_path):
    assert find_line(parse(HEAD.format(driver=driver) + one_axis(), "line", tmp_path, "line.toml")) == line


def test_the_findings_stand_behind_those_of_the_host(tmp_path):
    findings = check_conditions(host(tmp_path, WIRED), PACING, ETH1)
    assert [finding.condition for finding in findings][-5:] == [
        "node's network", "node's cable", "interrupt coalescing", "large receive offload", "card's interrupts",
    ]  # fmt: skip
