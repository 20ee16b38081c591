"""Sums over all ticks of a loop, against the same of the rows that it wrote."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from rtloop.configuration.axis import LimitsOptions
from rtloop.service.api.metrics import QualityCollector
from rtloop.service.measuring.quality import Quality
from tests.recording.hand_made_loop import AXES, COLUMNS, HandMadeLoop, make_rows

TICKS = 12_000
MODE, FLAGS, LATENESS, MISSED = map(COLUMNS.index, ("mode", "flags", "lateness_us", "periods_missed"))
ERROR, DRIVE = map(COLUMNS.index, ("x_error_um", "x_drive_v"))
CLOSED, OVERRUN, DRIVE_LIMITED, SLEW_LIMITED, POSITION, STALE = 3, 1, 4, 8, 1 << 10, 1 << 13


class Looked:
    """A loop made by hand, and what was summed up of it."""

    def __init__(self) -> None:
        self.quality = Quality()
        self.begin()

    def begin(self) -> None:
        """Another loop."""
        self.loop = HandMadeLoop(rate_hz=100.0)  # whose ring is as small as can be
        plan = SimpleNamespace(columns=COLUMNS, axes=tuple(AXES))
        self.supervisor: Any = SimpleNamespace(block=self.loop.block, ticks=1, prepared=SimpleNamespace(plan=plan))

    def run(self, rows: np.ndarray) -> None:
        self.loop.run(rows)
        self.quality.update(self.supervisor)

    @property
    def samples(self) -> dict[tuple[str, ...], float]:
        registry = CollectorRegistry()
        registry.register(QualityCollector(self.quality))
        families = text_string_to_metric_families(generate_latest(registry).decode())
        return {
            (one.name.removeprefix("rtloop_"), *one.labels.values()): one.value
            for family in families
            for one in family.samples
        }


@pytest.fixture
def looked() -> Looked:
    return Looked()


def rows_of_a_day() -> np.ndarray:
    """In and out of closed loop, at limits, late, tripped twice, and once without a number."""
    random, rows = np.random.default_rng(2), make_rows(TICKS)
    rows[3_000:4_000, MODE] = 0
    rows[5_000, ERROR] = np.nan
    rows[6_000, DRIVE] = np.inf
    rows[:, LATENESS] = random.exponential(40.0, TICKS)
    rows[7_000, LATENESS], rows[7_001, LATENESS], rows[7_002, LATENESS] = np.nan, 2e5, 50.0
    rows[7_001, MISSED] = 20
    rows[random.random(TICKS) < 0.1, FLAGS] += OVERRUN
    rows[random.random(TICKS) < 0.2, FLAGS] += DRIVE_LIMITED
    rows[random.random(TICKS) < 0.3, FLAGS] += SLEW_LIMITED
    rows[8_000:8_500, FLAGS] += POSITION
    rows[8_100:8_500, FLAGS] += STALE
    rows[9_000:9_100, FLAGS] += POSITION
    return rows


def test_they_are_those_of_the_rows(looked: Looked):
    rows = rows_of_a_day()
    for part in np.array_split(rows, 31):
        looked.run(part)
    found, flags = looked.samples, rows[:, FLAGS].astype(int)
    closed = rows[(rows[:, MODE] == CLOSED) & np.isfinite(rows[:, ERROR])]
    drives = rows[np.isfinite(rows[:, DRIVE]), DRIVE]
    late = rows[np.isfinite(rows[:, LATENESS]), LATENESS]
    assert found["ticks_summed_total",] == TICKS
    assert found["ticks_unseen_total",] == 0
    assert found["closed_loop_ticks_total", "x"] == len(closed) == TICKS - 1_001
    assert found["error_square_um2_total", "x"] == pytest.approx(np.sum(closed[:, ERROR] ** 2), rel=1e-12)
    assert found["drive_square_v2_total", "x"] == pytest.approx(np.sum(drives**2), rel=1e-12)
    assert found["error_peak_um", "x"] == np.abs(closed[:, ERROR]).max()
    assert (found["drive_peak_v", "x", "lowest"], found["drive_peak_v", "x", "highest"]) == (drives.min(), drives.max())
    assert found["tick_overruns_total",] == np.count_nonzero(flags & OVERRUN)
    assert found["ticks_limited_total", "drive"] == np.count_nonzero(flags & DRIVE_LIMITED)
    assert found["ticks_limited_total", "slew"] == np.count_nonzero(flags & SLEW_LIMITED)
    assert found["ticks_limited_total", "command"] == 0
    assert found["tick_periods_missed_total",] == 20
    assert (found["trips_total", "position"], found["trips_total", "stale"], found["trips_total", "law"]) == (2, 1, 0)
    for end_s, end_us in (("1e-06", 1.0), ("5e-05", 50.0), ("0.1", 1e5), ("+Inf", np.inf)):
        assert found["tick_lateness_seconds_bucket", end_s] == np.count_nonzero(late <= end_us), end_s
    assert found["tick_lateness_seconds_count",] == len(late) == TICKS - 1
    assert found["tick_lateness_seconds_sum",] == pytest.approx(1e-6 * late.sum(), rel=1e-12)


def test_ticks_that_were_overwritten_are_said(looked: Looked):
    looked.run(make_rows(100))
    looked.run(make_rows(9_000, first=100))
    found, slots = looked.samples, len(looked.loop.block.ring("ticks").slots)
    assert found["ticks_unseen_total",] == 9_000 - slots > 0
    assert found["ticks_summed_total",] == 100 + slots


def test_a_look_does_not_run_after_the_loop(looked: Looked, monkeypatch: pytest.MonkeyPatch):
    """Ticks come in while others are summed up: the largest values of a minute are to be those of a minute."""
    add, ticks = looked.quality._add, iter(range(100, 200))

    def while_it_runs(rows: np.ndarray, axes: tuple[str, ...]) -> None:
        add(rows, axes)
        looked.loop.run(make_rows(1, first=next(ticks)))

    monkeypatch.setattr(looked.quality, "_add", while_it_runs)
    looked.run(make_rows(100))
    assert looked.samples["ticks_summed_total",] == 100
    assert len(looked.quality.axes["x"].peaks) == 1


def test_they_go_on_in_the_next_loop(looked: Looked):
    tripped = make_rows(500)
    tripped[400:, FLAGS] = POSITION
    looked.run(tripped)
    looked.begin()
    looked.run(tripped)
    assert looked.samples["ticks_summed_total",] == 1_000
    assert looked.samples["trips_total", "position"] == 2


def test_without_a_loop_there_is_nothing(looked: Looked):
    looked.quality.update(None)
    assert looked.samples["ticks_summed_total",] == 0
    assert ("error_peak_um", "x") not in looked.samples


@pytest.mark.parametrize(
    ("share", "column", "value", "found"),
    [
        (0.6, "x_demand_v", 10.1, "saturated"),
        (0.4, "x_demand_v", 10.1, "controlled"),
        (0.6, "x_demand_v", -0.1, "saturated"),
        (0.6, "x_demand_v", 0.0, "controlled"),
        (0.6, "x_command_um", -42.1, "saturated"),
        (0.6, "x_command_um", -42.0, "controlled"),
        (0.6, "x_error_um", -0.3, "not settled"),
        (0.4, "x_error_um", -0.3, "controlled"),
        (0.6, "x_error_um", 0.2, "controlled"),
    ],
)
def test_an_axis_at_its_limits_or_beside_its_reference_is_not_controlled(
    looked: Looked, share: float, column: str, value: float, found: str
):
    """An amplifier without a negative side, 10 V, 42 µm, and a band of 0.2 µm."""
    limits = LimitsOptions(drive_v=10.0, drive_min_v=0.0, command_um=42.0, settled_within_um=0.2)
    rows = make_rows(1000)
    for name in ("x_demand_v", "x_command_um", "x_error_um"):
        rows[:, COLUMNS.index(name)] = 0.1
    rows[: round(1000 * share), COLUMNS.index(column)] = value
    looked.loop.run(rows)
    looked.quality.update(looked.supervisor, [limits] * len(AXES))
    assert looked.quality.axes["x"].condition == found
    rows[:, MODE] = 1
    looked.loop.run(rows)
    looked.quality.update(looked.supervisor, [limits] * len(AXES))
    assert looked.quality.axes["x"].condition is None
