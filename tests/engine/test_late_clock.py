"""Simulated lateness: each tick wakes late by a number of a table, and the rig advances by the missed periods.

The oracles are xorshift in Python's integers, and python-control.
"""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from scipy.stats import chisquare

import rtloop
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.drivers.base import Wiring
from rtloop.drivers.sim import SimDriver
from rtloop.engine.clock import Clock
from rtloop.engine.in_process import run_in_process
from rtloop.engine.late_clock import virtual_clock
from rtloop.engine.memory import SharedBlock
from rtloop.engine.plan import Plan
from rtloop.errors import ConfigError
from rtloop.hil.options import RigOptions
from rtloop.hil.stages.noise import seed_word
from rtloop.recording.load import Recording
from rtloop.recording.replay.replay import replay
from rtloop.signals import Flag, trip_causes
from tests.engine.harness import AXIS, CONTROLLER, EXACT, IDEAL, make_plan, text
from tests.hil.xorshift import xorshift64
from tests.paper_dynamics import paper_dynamics
from tests.recording.real_loop import read_rows

Columns = dict[str, np.ndarray]
FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.POINTER(ctypes.c_double))
SINE = '[axis.reference]\nkind = "sine"\namplitude = 10.0\nfrequency_hz = 50.0\n'
MIXED_US = (0.0, 12.5, 50.0, 99.999, 100.0, 120.25, 250.0)
MOSTLY_EARLY_US = (*np.linspace(0, 60, 997).round(3).tolist(), 104.5, 230.0, 1234.5678)
TRIP_WHEN_LATE = "[axis.interlocks]\nlate_us = 40.0\nlate_ticks = 5\n"


def late_text(table_us: object, *parts: str, rate_hz: float = 10_000, seed: int = 1, latency: int = 0) -> str:
    """Return the configuration of a closed loop on an ideal rig whose ticks are late."""
    configuration = text(
        IDEAL, AXIS, EXACT, CONTROLLER, SINE, *parts, rate_hz=rate_hz, seed=seed, latency=latency
    )  # fmt: skip
    return configuration.replace("[driver]", f"simulated_lateness_us = {table_us}\n[driver]", 1)


def run_late(table_us: Sequence[float], ticks: int, *parts: str, **options: Any) -> tuple[Columns, np.ndarray]:
    """Run a late loop in this process; return its columns by name, and all records."""
    plan = make_plan(late_text(list(table_us), *parts, **options))
    rows = run_in_process(plan, plan.driver(), ticks)
    return dict(zip(plan.columns, rows.T, strict=True)), rows


def total_lateness_ns(columns: Columns, rate_hz: float) -> np.ndarray:
    """Return for each tick the time (ns) from the grid point after the previous deadline to its wake."""
    deadline_ns = columns["deadline_ns"]
    first_ns = np.floor(np.append(0, np.rint(deadline_ns[:-1] * rate_hz / 1e9) + 1) * (1e9 / rate_hz))
    return np.rint(columns["lateness_us"] * 1e3) + deadline_ns - first_ns


@pytest.mark.parametrize("seed", [1, 2**62 + 3])
def test_ticks_draw_from_the_table_by_xorshift(seed):
    """The oracle is Marsaglia's generator in Python's integers; the upper 32 bits choose the number."""
    table_us = [0.0, 3.0, 7.0, 7.5, 20.0, 41.0, 99.0]
    columns, _ = run_late(table_us, 500, seed=seed)
    words = islice(xorshift64(seed_word(seed, "lateness of ticks")), 500)
    expected_us = [table_us[((word >> 32) * len(table_us)) >> 32] for word in words]
    np.testing.assert_allclose(columns["lateness_us"], expected_us, rtol=1e-12)


def test_each_number_is_drawn_as_often_as_the_table_has_it():
    """Single numbers, and pairs of successive ticks, pass a chi-square test; the table has 30 twice."""
    table_us = [10.0, 20.0, 30.0, 30.0, 40.0, 0.0]
    lateness_us = np.rint(run_late(table_us, 60_000)[0]["lateness_us"]).astype(int) // 10
    shares = np.array([1, 1, 1, 2, 1]) / 6
    assert chisquare(np.bincount(lateness_us), 60_000 * shares).pvalue > 0.01
    pairs = np.bincount(lateness_us[:-1] * 5 + lateness_us[1:])
    assert chisquare(pairs, 59_999 * np.outer(shares, shares).ravel()).pvalue > 0.01


def test_another_seed_draws_others_and_the_order_of_ticks_is_no_pattern():
    first, same_seed, other_seed = (run_late(MIXED_US, 2000, seed=seed)[1] for seed in (1, 1, 2))
    assert first.tobytes() == same_seed.tobytes()
    assert first.tobytes() != other_seed.tobytes()


@pytest.mark.parametrize("rate_hz", [10_000.0, 3_000.0, 44_100.0, 70.0])
def test_deadlines_stay_on_the_grid(rate_hz):
    """Tick k is due after k and the missed periods; its lateness is below a period, its wake is as drawn."""
    period_us = 1e6 / rate_hz
    table_us = np.rint(np.array([0.0, 0.3, 0.999, 1.5, 2.2, 7.25]) * period_us * 1e3) / 1e3
    plan = make_plan(late_text(table_us.tolist(), rate_hz=10_000))
    plan = replace(plan, mode=0, pacing=replace(plan.pacing, rate_hz=rate_hz))
    rows = run_in_process(plan, plan.driver(), 3000)
    columns = dict(zip(plan.columns, rows.T, strict=True))
    index = np.arange(3000) + np.cumsum(columns["periods_missed"])
    np.testing.assert_array_equal(columns["deadline_ns"], np.floor(index * (1e9 / rate_hz)))
    assert np.array_equal(np.unique(columns["periods_missed"]), [0, 1, 2, 7])
    assert np.all((columns["lateness_us"] >= 0) & (columns["lateness_us"] < period_us))
    np.testing.assert_array_equal(np.unique(total_lateness_ns(columns, rate_hz)), np.rint(table_us * 1e3))


def test_the_largest_lateness_advances_the_rig_by_ten_thousand_periods():
    columns, _ = run_late([1e6], 5)
    assert columns["periods_missed"].tolist() == [10_000] * 5
    assert columns["lateness_us"].tolist() == [0.0] * 5
    np.testing.assert_array_equal(columns["deadline_ns"], np.arange(1, 6) * 1e9 + np.arange(5) * 1e5)


def simulate(plant: Any, inputs: Any) -> np.ndarray:
    """Return the response of a discrete plant at rest, computed by python-control."""
    return np.asarray(control.forced_response(plant, inputs=inputs).outputs)


def test_the_rig_advances_by_the_missed_periods_with_its_outputs_held():
    """python-control simulates eq (5) on every period, with the displacement held through the missed ones."""
    columns, _ = run_late(MIXED_US, 3000)
    missed = columns["periods_missed"].astype(int)
    assert missed.sum() > 1000
    index = np.arange(3000) + np.cumsum(missed)
    lengths = np.append(np.diff(index), 1)
    displacement_um = columns["x_hysteresis_um"]
    held_um = np.append(np.zeros(index[0]), np.repeat(np.append(displacement_um[1:], displacement_um[-1]), lengths))
    every_um = simulate(control.c2d(paper_dynamics(), 1e-4, "zoh"), held_um)
    assert np.ptp(every_um) > 10
    np.testing.assert_allclose(columns["x_true_position_um"], every_um[index], atol=1e-9 * np.ptp(every_um))


def test_a_tick_that_misses_nothing_leaves_the_rig_as_it_is():
    """Numbers below a period change only the column of lateness; zeros record 0 in place of NaN."""
    plan = make_plan(late_text([]))
    rows_without_table = run_in_process(plan, plan.driver(), 2000)
    lateness_column = plan.columns.index("lateness_us")
    assert np.all(np.isnan(rows_without_table[:, lateness_column]))
    for table_us, recorded_us in (([0.0], [0.0]), ([0, 40, 99.9], [0.0, 40.0, 99.9])):
        columns, rows = run_late(table_us, 2000)
        assert np.unique(np.round(columns["lateness_us"], 9)).tolist() == recorded_us
        other_columns = np.delete(np.arange(rows.shape[1]), lateness_column)
        assert rows[:, other_columns].tobytes() == rows_without_table[:, other_columns].tobytes()


def test_loopback_and_delayed_drives_are_held_through_missed_periods():
    """A loopback input reads the value written last; drives on their way to the actuator arrive in the meantime."""
    wiring = {"x": Wiring("adc0", "dac0")}
    options = RigOptions.model_validate(
        {"loopback": 2, "latency_ticks": 2, "plant": {"dac": {"bits": 0}, "sensor": {"noise_um": 0.0}}}
    )
    driver, plan = SimDriver(options, wiring, 10_000.0), make_plan(late_text([450.0]))
    facts, pointers, block = driver.facts, driver.open(), SharedBlock.create(plan.sizes)
    virtual = virtual_clock(plan, facts, block, pointers, 1 << 62)
    timing, inputs = (ctypes.c_double * 4)(), (ctypes.c_double * 6)()
    write = FUNCTION(pointers.write)
    assert write(pointers.context, (ctypes.c_double * 3)(2.5, 3.0, -4.0)) == 0
    assert not driver.rig[1]["hysteresis_um"][0]  # the latency still delays the drive
    assert wait(virtual.clock, timing) == (400_000.0, 450_000.0, 4.0)
    assert driver.rig[1]["dac_v"][0] == 2.5
    assert driver.rig[1]["hysteresis_um"][0] > 1.0
    assert FUNCTION(pointers.read)(pointers.context, inputs) == 0
    assert inputs[1:3] == [3.0, -4.0]
    assert driver.outputs_v() == [2.5, 3.0, -4.0]


def wait(clock: Clock, timing: ctypes.Array[ctypes.c_double]) -> tuple[float, float, float]:
    """Wait for a tick; return deadline and wake in ns, and missed periods."""
    assert FUNCTION(clock.wait)(clock.context, timing) == 0
    assert np.isnan(timing[3])
    return timing[0], timing[1], timing[2]


def end_of_first_run(values: np.ndarray, length: int) -> int:
    """Return the index at which `values` have been true `length` times in a row for the first time."""
    count = 0
    for index, value in enumerate(values):
        count = count + 1 if value else 0
        if count == length:
            return index
    raise AssertionError(f"no run of {length} true values")


def test_late_ticks_in_a_row_trip():
    columns, _ = run_late([10.0, 50.0, 250.0, 170.0, 20.0], 3000, TRIP_WHEN_LATE)
    flags = columns["flags"].astype(int)
    tripped = np.flatnonzero(flags & Flag.TRIP_LATE)
    assert tripped[0] == end_of_first_run(np.round(columns["lateness_us"], 6) > 40.0, 5) > 4
    assert trip_causes(int(np.bitwise_or.reduce(flags))) == ["late"]


@pytest.mark.parametrize("table_us", [[40.0], [140.0], [0.0, 20.0, 330.0]])
def test_ticks_that_are_late_by_less_do_not_trip(table_us):
    columns, _ = run_late(table_us, 1000, "[axis.interlocks]\nlate_us = 40.0\nlate_ticks = 1\n")
    assert not np.any(columns["flags"].astype(int) & Flag.TRIP_LATE)


@pytest.mark.parametrize(
    ("table_us", "fault"),
    [
        ("[1.0, -0.5]", "loop.simulated_lateness_us.1: -0.5: must be greater than or equal to 0"),
        ("[1000000.5]", "loop.simulated_lateness_us.0: 1000000.5: must be less than or equal to 1000000"),
        ("[1e9]", "loop.simulated_lateness_us.0: 1000000000.0: must be less than or equal to 1000000"),
        ("[nan]", "loop.simulated_lateness_us.0: nan: must be a finite number"),
        (str([1.0] * 4097), "loop.simulated_lateness_us: tuple should have at most 4096 items"),
        ("3.0", "loop.simulated_lateness_us: 3.0: must be a valid tuple"),
    ],
)
def test_numbers_that_are_not_allowed(table_us, fault):
    with pytest.raises(ConfigError) as raised:
        parse(late_text(table_us), "late", Path(), "late.toml")
    assert any(line.startswith(fault) for line in raised.value.faults), raised.value.faults


def test_4096_numbers_are_allowed():
    assert len(make_plan(late_text([1.0] * 4096)).pacing.simulated_lateness_us) == 4096


def test_other_drivers_than_the_simulated_rig_are_refused():
    board_text = late_text([1.0]).replace('kind = "sim"', 'kind = "shm"', 1).replace("latency_ticks = 0", "")
    with pytest.raises(ConfigError) as raised:
        prepare(parse(board_text, "late", Path(), "late.toml"))
    assert raised.value.faults == [
        "loop.simulated_lateness_us: set with driver.kind = 'shm'; allowed with the simulated rig only; "
        "set driver.kind = 'sim', or remove the key"
    ]
    plan: Plan = make_plan(late_text([1.0]))
    driver, block = plan.driver(), SharedBlock.create(plan.sizes)
    with pytest.raises(
        ValueError, match="simulated_lateness_us: set, but the driver is 'shm'; allowed: only with the driver 'sim'"
    ):
        virtual_clock(replace(plan, driver_kind="shm"), driver.facts, block, driver.open(), 1)


def command(*arguments: object, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run `rtloop` with `arguments`, require the exit code `code`, and return the finished process."""
    result = subprocess.run(
        [sys.executable, "-m", "rtloop", *map(str, arguments)], capture_output=True, text=True, timeout=200
    )
    assert result.returncode == code, result.stderr
    return result


def test_a_paced_run_is_refused(tmp_path):
    path = tmp_path / "late.toml"
    path.write_text(late_text([1.0]))
    result = command("run", path, "--duration", 0.1, "--out", tmp_path, code=78)
    message = "loop.simulated_lateness_us: set; allowed in virtual time only; add --unpaced, or remove the key"
    assert message in " ".join(result.stderr.split())
    assert not list(tmp_path.glob("*.mcap*"))


def record_late(folder: Path, table_us: tuple[float, ...], *parts: str, code: int = 0) -> Recording:
    """Record a second of a late loop by the command line, require the exit code `code`, and return the recording."""
    config = folder / "late.toml"
    config.write_text(late_text(list(table_us), *parts))
    result = command("run", config, "--unpaced", "--duration", 1, "--out", folder, "--json", code=code)
    summary = json.loads(result.stdout)
    assert summary["complete"]
    assert summary["ticks_logged"] == 10_000
    return rtloop.load(summary["recording"])


def test_recordings_are_equal_in_bytes_and_replay_identical(tmp_path):
    """The loop's own process and a loop in this process give the same records."""
    first, second = (record_late(tmp_path, MOSTLY_EARLY_US) for _ in range(2))
    rows, rows_again = (read_rows([*recording.paths]) for recording in (first, second))
    assert rows.tobytes() == rows_again.tobytes() == run_late(MOSTLY_EARLY_US, 10_000)[1].tobytes()
    # The time of an event that the recorder reads before its tick's record is extrapolated.
    assert len({str([{**event, "time_ns": 0} for event in recording.events]) for recording in (first, second)}) == 1
    assert "periods_missed" in [event["kind"] for event in first.events]
    assert np.unique(first["periods_missed"]).tolist() == [0, 1, 2, 12]
    report = replay(first)
    assert report.identical
    assert report.ticks == 10_000
    assert "identical" in command("replay", first.paths[0]).stdout


def test_a_trip_by_late_ticks_replays_identical(tmp_path):
    recording = record_late(tmp_path, (10.0, 50.0, 70.0), TRIP_WHEN_LATE, code=1)
    assert np.any(recording["flags"].astype(int) & Flag.TRIP_LATE)
    assert replay(recording).identical
