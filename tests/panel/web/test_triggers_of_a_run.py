"""Pulses of one tick in a running loop: each is found at its tick, and no others."""

from __future__ import annotations

from pathlib import Path

from tests.soak.panel_triggers import caught

PULSES = 150
"""`make soak NAME=panel-triggers` has 10,000."""


def test_every_pulse_of_one_tick_is_found_at_its_tick(tmp_path: Path):
    found = caught(tmp_path, PULSES)
    for name, one in found.items():
        assert one.pulses == PULSES, name
        assert (one.missed, one.made_up, one.furthest_ticks, one.lost_ticks) == (0, 0, 0, 0), name
