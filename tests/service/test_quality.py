"""Sums and peaks over all ticks of a loop; the oracle is NumPy over the rows that the loop wrote."""

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
from tests.engine.harness import LoopBench, prepare_text
from tests.recording.hand_made_loop import AXES, COLUMNS, HandMadeLoop, make_rows
from tests.recording.real_loop import ROOT, TWO_AXES

TICKS = 12_000
MODE, FLAGS, LATENESS, MISSED = map(COLUMNS.index, ("mode", "flags", "lateness_us", "periods_missed"))
ERROR, DRIVE = map(COLUMNS.index, ("x_error_um", "x_drive_v"))
CLOSED, OVERRUN, DRIVE_LIMITED, SLEW_LIMITED, POSITION, STALE = 3, 1, 4, 8, 1 << 10, 1 << 13


class QualityBench:
    """A loop made by hand, and the sums over its ticks."""

    def __init__(self) -> None:
        self.quality = Quality()
        self.replace_loop()

    def replace_loop(self) -> None:
        """Replace the loop by a new one, as after a restart."""
        self.loop = HandMadeLoop(rate_hz=100.0)  # with the smallest ring
        plan = SimpleNamespace(columns=COLUMNS, axes=tuple(AXES))
        self.supervisor: Any = SimpleNamespace(block=self.loop.block, ticks=1, prepared=SimpleNamespace(plan=plan))

    def run(self, rows: np.ndarray) -> None:
        """Execute the ticks `rows`, and update the sums."""
        self.loop.run(rows)
        self.quality.update(self.supervisor)

    @property
    def samples(self) -> dict[tuple[str, ...], float]:
        """Return the value of each metric, by its name without `rtloop_` and the values of its labels."""
        registry = CollectorRegistry()
        registry.register(QualityCollector(self.quality))
        families = text_string_to_metric_families(generate_latest(registry).decode())
        return {
            (sample.name.removeprefix("rtloop_"), *sample.labels.values()): sample.value
            for family in families
            for sample in family.samples
        }


@pytest.fixture
def bench() -> QualityBench:
    """Return a loop without ticks, and sums without ticks."""
    return QualityBench()


def mixed_rows() -> np.ndarray:
    """Return rows in and out of closed loop, at limits, late, tripped twice, and with values that are not finite."""
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


def test_they_are_those_of_the_rows(bench: QualityBench):
    rows = mixed_rows()
    for part in np.array_split(rows, 31):
        bench.run(part)
    sums, flags = bench.samples, rows[:, FLAGS].astype(int)
    closed = rows[(rows[:, MODE] == CLOSED) & np.isfinite(rows[:, ERROR])]
    drives = rows[np.isfinite(rows[:, DRIVE]), DRIVE]
    lateness_us = rows[np.isfinite(rows[:, LATENESS]), LATENESS]
    assert sums["ticks_summed_total",] == TICKS
    assert sums["ticks_unseen_total",] == 0
    assert sums["closed_loop_ticks_total", "x"] == len(closed) == TICKS - 1_001
    assert sums["error_square_um2_total", "x"] == pytest.approx(np.sum(closed[:, ERROR] ** 2), rel=1e-12)
    assert sums["drive_square_v2_total", "x"] == pytest.approx(np.sum(drives**2), rel=1e-12)
    assert sums["error_peak_um", "x"] == np.abs(closed[:, ERROR]).max()
    assert (sums["drive_peak_v", "x", "lowest"], sums["drive_peak_v", "x", "highest"]) == (drives.min(), drives.max())
    assert sums["tick_overruns_total",] == np.count_nonzero(flags & OVERRUN)
    assert sums["ticks_limited_total", "drive"] == np.count_nonzero(flags & DRIVE_LIMITED)
    assert sums["ticks_limited_total", "slew"] == np.count_nonzero(flags & SLEW_LIMITED)
    assert sums["ticks_limited_total", "command"] == 0
    assert sums["tick_periods_missed_total",] == 20
    assert (sums["trips_total", "position"], sums["trips_total", "stale"], sums["trips_total", "law"]) == (2, 1, 0)
    for end_s, end_us in (("1e-06", 1.0), ("5e-05", 50.0), ("0.1", 1e5), ("+Inf", np.inf)):
        assert sums["tick_lateness_seconds_bucket", end_s] == np.count_nonzero(lateness_us <= end_us), end_s
    assert sums["tick_lateness_seconds_count",] == len(lateness_us) == TICKS - 1
    assert sums["tick_lateness_seconds_sum",] == pytest.approx(1e-6 * lateness_us.sum(), rel=1e-12)


def test_ticks_that_were_overwritten_are_said(bench: QualityBench):
    bench.run(make_rows(100))
    bench.run(make_rows(9_000, first=100))
    sums, slots = bench.samples, len(bench.loop.block.ring("ticks").slots)
    assert sums["ticks_unseen_total",] == 9_000 - slots > 0
    assert sums["ticks_summed_total",] == 100 + slots


def test_a_look_does_not_run_after_the_loop(bench: QualityBench, monkeypatch: pytest.MonkeyPatch):
    """Ticks that arrive during an update wait for the next one, so that the peaks of a minute are of a minute."""
    add, ticks = bench.quality._add, iter(range(100, 200))

    def add_and_execute(rows: np.ndarray, axes: tuple[str, ...]) -> None:
        add(rows, axes)
        bench.loop.run(make_rows(1, first=next(ticks)))

    monkeypatch.setattr(bench.quality, "_add", add_and_execute)
    bench.run(make_rows(100))
    assert bench.samples["ticks_summed_total",] == 100
    assert len(bench.quality.axes["x"].peaks) == 1


def test_they_go_on_in_the_next_loop(bench: QualityBench):
    tripped = make_rows(500)
    tripped[400:, FLAGS] = POSITION
    bench.run(tripped)
    bench.replace_loop()
    tripped[:, FLAGS] = POSITION
    bench.run(tripped)
    assert bench.samples["ticks_summed_total",] == 1_000
    assert bench.samples["trips_total", "position"] == 2


def test_each_axis_has_sums_of_its_own_and_is_judged_by_its_own_limits():
    prepared, quality = prepare_text(TWO_AXES, ROOT / "deploy"), Quality()
    loop = LoopBench(prepared.plan)
    supervisor: Any = SimpleNamespace(block=loop.block, ticks=1, prepared=prepared)
    rows = [loop.run(1_000)]
    wide, narrow = (LimitsOptions(command_um=1e3, settled_within_um=within_um) for within_um in (1e3, 1e-9))
    for limits, conditions in (([wide, narrow], ["controlled", "not settled"]),
                               ([narrow, wide], ["not settled", "controlled"])):  # fmt: skip
        quality.update(supervisor, limits)
        assert [sums.condition for sums in quality.axes.values()] == conditions
        rows.append(loop.run(1_000))
    for name, sums in quality.axes.items():
        drive_v = np.concatenate(rows[:-1])[:, prepared.plan.columns.index(f"{name}_drive_v")]
        assert sums.drive_v2 == pytest.approx(np.sum(drive_v**2), rel=1e-12)
    quality.update(None)
    assert [sums.condition for sums in quality.axes.values()] == [None, None]


def test_without_a_loop_there_is_nothing(bench: QualityBench):
    bench.quality.update(None)
    assert bench.samples["ticks_summed_total",] == 0
    assert ("error_peak_um", "x") not in bench.samples


@pytest.mark.parametrize(
    ("share", "column", "value", "condition"),
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
    bench: QualityBench, share: float, column: str, value: float, condition: str
):
    """The limits are 0 to 10 V for the drive, 42 µm for the command, and 0.2 µm for a settled error."""
    limits = LimitsOptions(drive_v=10.0, drive_min_v=0.0, command_um=42.0, settled_within_um=0.2)
    rows = make_rows(1000)
    for name in ("x_demand_v", "x_command_um", "x_error_um"):
        rows[:, COLUMNS.index(name)] = 0.1
    rows[: round(1000 * share), COLUMNS.index(column)] = value
    bench.loop.run(rows)
    bench.quality.update(bench.supervisor, [limits] * len(AXES))
    assert bench.quality.axes["x"].condition == condition
    rows[:, MODE] = 1
    bench.loop.run(rows)
    bench.quality.update(bench.supervisor, [limits] * len(AXES))
    assert bench.quality.axes["x"].condition is None
