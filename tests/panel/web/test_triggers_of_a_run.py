"""The panel's triggers find each pulse of one tick in a running loop at its tick, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.soak.panel_triggers import play_pulses

pytestmark = pytest.mark.system

PULSES = 150
"""Pulses of this test; `make soak NAME=panel-triggers` has 10,000."""


def test_every_pulse_of_one_tick_is_found_at_its_tick(tmp_path: Path):
    results = play_pulses(tmp_path, PULSES)
    for name, result in results.items():
        assert result.pulses == PULSES, name
        assert (result.missed, result.made_up, result.furthest_ticks, result.lost_ticks) == (0, 0, 0, 0), name
