"""Configurations of the fault suite: the paper's law, slower, with slew limits that bound every step of the outputs.

The loop runs with the slew limit of the ramps, so that `trip_slew_v_per_s` bounds every movement of an output.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PAPER = (ROOT / "deploy" / "paper.toml").read_text(encoding="utf-8")
LAW = PAPER[PAPER.index("[axis.feedforward]") : PAPER.index("# [axis.prefilter]")]
"""Tables of feedforward, controller and model of the paper's configuration."""
CONTROLLER = LAW[LAW.index("[axis.controller]") : LAW.index("# Eq (5)")]
BOARD_RATE_HZ = 4000.0
SLEW_V_PER_S = 500.0
WINDOW_S = 1e-3
HELD_UP_STEPS = 2
"""A delayed write may come together with the next one: a window of WINDOW_S may hold so many more steps."""

BOARD = """
[loop]
rate_hz = 4000
[driver]
kind = "shm"
file = "{folder}/board"
board_rate_hz = 8000
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
[driver.plant.sensor]
um_per_v = 10.0
noise_um = 0.010
resolution_um = 0.010
"""
CARD = """
[loop]
rate_hz = 2000
enable_input = "enable"
[driver]
kind = "plain_card"
file = "{folder}/card"
[driver.channels.x]
input = "in"
output = "out"
um_per_v = 10.0
"""
CARD_LAW = """
[axis.feedforward]
thresholds_v = [0.0]
weights_um_per_v = [4.3]
[axis.controller]
form = "zpk"
gain = 200.0
poles = [[0.0, 0.0]]
[axis.model]
form = "zpk"
gain = 200.0
poles = [[-200.0, 0.0]]
"""
# The board is a process beside others: a host that stalls it alone for less than 0.4 s must not trip the loop.
LIMITS = f"""
[axis.limits]
slew_v_per_s = {SLEW_V_PER_S}
trip_slew_v_per_s = {SLEW_V_PER_S}
[axis.interlocks]
position_um = 60.0
sample_age_us = 400000.0
tracking_error_um = 5.0
tracking_ticks = 2000
frozen_ticks = 2000
oscillation_swings = 8
[axis.reference]
kind = "sine"
amplitude = 8.0
offset = 20.0
frequency_hz = 5.0
[recording]
folder = "{{folder}}/recordings"
min_free_mib = 0.0
"""


PATIENCE_S = 20.0
"""Time-out after which the other processes of a patient bench count a stalled process as dead."""


class Bounds(NamedTuple):
    """Limits of a configuration on its output, in V: step from one write to the next, change within WINDOW_S."""

    rate_hz: float
    step_v: float
    window_v: float

    @staticmethod
    def from_text(text: str, resolution_v: float) -> Bounds:
        """Return the bounds of a configuration's text; a voltage may be off by half of `resolution_v`."""
        configuration = tomllib.loads(text)
        (axis,), rate_hz = configuration["axis"], float(configuration["loop"]["rate_hz"])
        limits = axis["limits"]
        assert limits["slew_v_per_s"] <= limits["trip_slew_v_per_s"], "the running loop may move faster than a ramp"
        step_v = limits["trip_slew_v_per_s"] / rate_hz
        steps = math.ceil(WINDOW_S * rate_hz) + HELD_UP_STEPS
        return Bounds(rate_hz, step_v + resolution_v, steps * step_v + resolution_v)


def on_a_board(folder: Path, *changes: tuple[str, str]) -> str:
    """Return the text of a configuration: the paper's law on a rig in a separate process; the drive is 2 V … 8 V."""
    return _apply_changes(BOARD + '[[axis]]\nname = "x"\n' + LAW + LIMITS, folder, changes)


def on_a_rig(folder: Path, *changes: tuple[str, str]) -> str:
    """Return the text of `on_a_board` with the rig in the loop's own process."""
    text = on_a_board(folder, *changes)
    begin, end = text.index("[driver]"), text.index("[driver.channels.x]")
    return f'{text[:begin]}[driver]\nkind = "sim"\n{text[end:]}'


def on_a_card(folder: Path, *changes: tuple[str, str]) -> str:
    """Return the text of a configuration: a first-order plant behind a third party's driver in plain Python."""
    return _apply_changes(CARD + '[[axis]]\nname = "x"\n' + CARD_LAW + LIMITS, folder, changes)


def patient(text: str) -> str:
    """Return `text` with time-outs of PATIENCE_S between service and loop, unless it states its own."""
    for table, key, value in (
        ("loop", "heartbeat_timeout_s", PATIENCE_S),
        ("service", "stall_ms", 1000.0 * PATIENCE_S),
    ):
        if key in tomllib.loads(text).get(table, {}):
            continue
        header, line = f"[{table}]\n", f"{key} = {value}\n"
        text = text.replace(header, header + line, 1) if header in text else f"{text}\n{header}{line}"
    return text


def _apply_changes(text: str, folder: Path, changes: tuple[tuple[str, str], ...]) -> str:
    """Return `text` with the folder filled in, and each `old` text, which occurs once, replaced by `new`."""
    text = text.replace("{folder}", str(folder))
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text
