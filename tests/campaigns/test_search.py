"""The search for the worst rig and for a boundary, on planted functions whose solution is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rtloop.campaigns.campaign_file import load_campaign
from rtloop.campaigns.case import CaseResult, CaseRunner
from rtloop.campaigns.samples import unit_samples
from rtloop.campaigns.search import find_boundary, find_worst
from rtloop.errors import ConfigError
from tests.campaigns.campaign_files import write_campaign

SHIFT, DAMPING = "driver.plant.dynamics.resonance_shift", "driver.plant.dynamics.damping_factor"
BAND, WIDTH = 0.0637, 0.0004
"""Place and half width of a planted resonance, in parts of the nominal frequency: 0.4 % of the range."""


@pytest.fixture(scope="module")
def runner(tmp_path_factory):
    """The runner of a campaign of the paper's loop."""
    return CaseRunner(load_campaign(write_campaign(tmp_path_factory.mktemp("campaign"))))


def planted_height(values) -> float:
    """Return the height of a resonance that is high only in a narrow band of the shift, and at low damping."""
    return 1.0 / math.hypot((values[SHIFT] - BAND) / WIDTH, 1.0) / values[DAMPING]


def run_planted(rigs):
    """Return results of rigs, as (number, values), whose figure is the height of the planted resonance."""
    return [
        CaseResult(rig, values, {"steps.settling_ms": planted_height(values)}, {}, (), planted_height(values))
        for rig, values in rigs
    ]


TARGET = 1.5
"""Height that about one rig of 1,500 has."""


def sobol_rigs(runner, seed: int) -> int:
    """Return the number of rigs until a Sobol sequence meets the target."""
    shares = unit_samples("sobol", runner.keys, 0, 8192, 8192, seed)
    for count, row in enumerate(shares, start=1):
        values = {key: runner.quantile_value(key, share) for key, share in zip(runner.keys, row, strict=True)}
        if planted_height(values) >= TARGET:
            return count
    return 8192


def test_the_search_finds_a_narrow_band_with_fewer_rigs_than_sobols_sequence(runner, tmp_path):
    search_rigs, sequence_rigs = [], []
    for seed in range(20):
        seeded = CaseRunner(load_campaign(write_campaign(tmp_path).rename(tmp_path / f"{seed}.toml")))
        seeded.options = seeded.options.model_copy(update={"seed": seed})
        result = find_worst(seeded, run_planted, 4096, target=TARGET)
        assert result.figure >= TARGET
        search_rigs.append(result.rigs)
        sequence_rigs.append(sobol_rigs(runner, seed))
    assert np.median(search_rigs) < 0.5 * np.median(sequence_rigs), (search_rigs, sequence_rigs)


def test_the_search_tries_about_as_many_rigs_as_allowed(runner):
    result = find_worst(runner, run_planted, 200)
    assert 168 <= result.rigs <= 232
    assert result.worst.figures["steps.settling_ms"] == result.figure


def test_a_rig_that_tripped_is_the_worst_whatever_the_figure(runner):
    """The tripped rig has a small figure, as it trips early."""

    def evaluate(rigs):
        cases = run_planted(rigs)
        tripped = {case.rig for case in cases if case.values[SHIFT] > 0.04}
        return [
            replace(case, figures={"steps.settling_ms": 0.0}, trips={"steps": "tracking"}, ratio=math.inf)
            if case.rig in tripped
            else case
            for case in cases
        ]

    result = find_worst(runner, evaluate, 200, "steps.settling_ms")
    assert (result.worst.trips, result.figure) == ({"steps": "tracking"}, math.inf)


def test_the_boundary_is_where_the_verdict_changes(runner):
    """Beyond each boundary another limit is missed than farther out: the one that is missed at the boundary counts."""

    def missed(shift):
        if -0.0213 <= shift <= 0.0431:
            return ()
        return ("steps.settling_ms",) if -0.0214 <= shift <= 0.0432 else ("steps.overshoot_percent",)

    def evaluate(rigs):
        return [CaseResult(rig, values, {}, {}, missed(values[SHIFT]), 0.0) for rig, values in rigs]

    boundary = find_boundary(runner, SHIFT, evaluate)
    assert (boundary.low, boundary.high) == pytest.approx((-0.0213, 0.0431), abs=1e-7)
    assert boundary.low_cause == boundary.high_cause == "steps.settling_ms"


def test_an_end_without_a_failure_is_open_and_a_nominal_failure_is_said(runner):
    def passing(rigs):
        return [CaseResult(rig, values, {}, {}, (), 0.0) for rig, values in rigs]

    def failing(rigs):
        return [CaseResult(rig, values, {}, {}, ("steps.settling_ms",), 2.0) for rig, values in rigs]

    boundary = find_boundary(runner, SHIFT, passing)
    assert (boundary.low, boundary.high, boundary.rigs) == (None, None, 65)
    boundary = find_boundary(runner, SHIFT, failing)
    assert (boundary.low, boundary.high, boundary.low_cause) == (0.0, 0.0, "steps.settling_ms")


def test_a_real_search_returns_the_rig_that_it_ran(runner):
    result = find_worst(runner, lambda rigs: [runner.run(rig, values) for rig, values in rigs], 32, "steps.settling_ms")
    repeated = runner.run(result.worst.rig, result.worst.values)
    assert repeated == result.worst


@pytest.mark.parametrize(
    ("uncertain", "figure", "message"),
    [
        ('"driver.latency_ticks" = { choice = [0, 1] }', "steps.height", "figure: 'steps.height'; allowed: steps.over"),
        ('"driver.plant.hysteresis.truth" = { choice = ["nominal", "residual"] }', "", "a search needs numbers"),
    ],
)
def test_a_search_that_cannot_be_is_refused(tmp_path, uncertain, figure, message):
    runner = CaseRunner(load_campaign(write_campaign(tmp_path, uncertain=uncertain)))
    with pytest.raises(ConfigError) as raised:
        find_worst(runner, run_planted, 10, figure)
    assert message in str(raised.value)


def test_a_boundary_of_another_key_is_refused(runner):
    with pytest.raises(ConfigError, match=r"boundary: 'driver.seed'; allowed: driver.plant.dynamics.resonance_shift"):
        find_boundary(runner, "driver.seed", run_planted)


def test_a_side_on_which_the_range_does_not_lie_is_not_searched(tmp_path):
    def evaluate(rigs):
        return [CaseResult(rig, values, {}, {}, () if values[SHIFT] < 0.015 else ("x",), 0.0) for rig, values in rigs]

    campaign = write_campaign(tmp_path, uncertain=f'"{SHIFT}" = {{ uniform = [0.01, 0.02] }}')
    boundary = find_boundary(CaseRunner(load_campaign(campaign)), SHIFT, evaluate)
    assert boundary.low is None
    assert boundary.high == pytest.approx(0.015, abs=1e-6)


@pytest.mark.parametrize(
    ("key", "distribution", "message"),
    [
        ("driver.latency_ticks", "choice = [0, 3]", "allowed: keys with a range"),
        ("driver.plant.sensor.bandwidth_hz", "uniform = [2e3, 4e3]", "has no value in the configuration; set a value"),
    ],
)
def test_a_boundary_without_a_range_or_a_nominal_value_is_refused(tmp_path, key, distribution, message):
    runner = CaseRunner(load_campaign(write_campaign(tmp_path, uncertain=f'"{key}" = {{ {distribution} }}')))
    with pytest.raises(ConfigError, match=message):
        find_boundary(runner, key, run_planted)
