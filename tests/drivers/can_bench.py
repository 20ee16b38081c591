"""Configurations and options for a simulated node on a CAN bus that stays within this machine."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

from rtloop.drivers.can.options import CanOptions
from tests.stage_text import one_axis

GROUP = "239.74.163.77"
DRIVER = """
[driver]
kind = "can"
interface = "udp_multicast"
channel = "{group}"
settings = {{ port = {port}, hop_limit = 0 }}
watchdog_ms = 1000
wait_s = 60
hold_ticks = {hold_ticks}
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
"""
LAW = """
[loop]
rate_hz = {rate_hz}
{axis}
[axis.interlocks]
sample_age_us = 1e7
[axis.reference]
kind = "sine"
amplitude = 5.0
offset = 10.0
frequency_hz = 2.0
[recording]
folder = "{folder}"
min_free_mib = 0.0
"""


def free_port() -> int:
    """Return a free port of UDP: buses on different ports are separate."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def configuration(folder: Path, port: int, rate_hz: float = 500.0, hold_ticks: int = 500, more: str = "") -> Path:
    """Write a configuration, with `more` lines at the end, and return its path; `hold_ticks` bridges a stall."""
    path = folder / "lab.toml"
    driver = DRIVER.format(group=GROUP, port=port, hold_ticks=hold_ticks)
    path.write_text(
        LAW.format(rate_hz=rate_hz, axis=one_axis(60.0, pole_rad_s=-0.5), folder=folder / "recordings") + driver + more
    )
    return path


def options_on(port: int, **more: Any) -> CanOptions:
    """Return options of a driver on the bus of UDP port `port`."""
    return CanOptions(interface="udp_multicast", channel=GROUP, settings={"port": port, "hop_limit": 0}, **more)
