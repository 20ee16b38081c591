"""Two campaigns compared on common rigs, with McNemar's test and intervals against scipy's distributions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rtloop.campaigns.campaign_file import load_campaign
from rtloop.campaigns.case import CaseRunner
from rtloop.campaigns.comparison import compare_campaigns, mcnemar, paired_difference
from rtloop.campaigns.store import open_store
from rtloop.campaigns.unit import Unit
from rtloop.errors import ConfigError
from tests.campaigns.campaign_files import ROOT, write_campaign


@pytest.mark.parametrize(("first", "second"), [(0, 0), (5, 5), (1, 12), (40, 20)])
def test_the_p_value_is_that_of_an_even_binomial(first, second):
    total, fewer = first + second, min(first, second)
    tail = sum(stats.binom.pmf(range(fewer + 1), total, 0.5))
    assert mcnemar(first, second) == pytest.approx(min(1.0, 2 * tail) if first != second else 1.0)


def test_intervals_of_a_median_cover_it():
    """The intervals are of 95 %: of 100 intervals, at least 88 contain the true median."""
    generator = np.random.default_rng(1)
    covered = 0
    for _ in range(100):
        first = generator.normal(5.0, 1.0, 60)
        difference = paired_difference(first, first + generator.exponential(1.0, 60))
        covered += difference.low <= np.log(2) <= difference.high
    assert 88 <= covered <= 100


def test_pairs_with_an_infinite_figure_are_left_out():
    difference = paired_difference(np.array([1.0, np.inf, 2.0, 3.0]), np.array([2.0, 1.0, 3.0, np.inf]))
    assert (difference.rigs, difference.median) == (2, 1.0)
    assert np.isnan(paired_difference(np.array([1.0]), np.array([2.0])).low)


def store_campaign(files, folder, rigs):
    """Run rigs of a campaign (campaign file, configuration) and store their results in a folder. Returns the folder."""
    runner = CaseRunner(load_campaign(files[0], configuration=files[1]))
    with open_store(folder, runner.campaign, runner.sample_values(0)) as results:
        results.add(Unit(1, 8), [runner.run(rig) for rig in rigs])
    return folder


def test_two_configurations_are_compared_on_the_rigs_that_both_have(tmp_path):
    campaign = write_campaign(tmp_path)
    paper = store_campaign((campaign, None), tmp_path / "paper", range(1, 9))
    robust = store_campaign((campaign, ROOT / "deploy/robust.toml"), tmp_path / "robust", range(3, 9))
    comparison = compare_campaigns(paper, robust)
    assert comparison.rigs == 6
    assert comparison.names == ("stage-paper", "stage-robust")
    assert comparison.yields[1].passed == 6
    assert comparison.only_first == 0
    assert comparison.only_second == 6 - comparison.yields[0].passed
    settling = comparison.figures["steps.settling_ms"]
    assert settling.rigs <= 6
    assert settling.median < 0
    assert compare_campaigns(paper, paper).figures["steps.settling_ms"].median == 0.0


def test_other_rigs_are_refused(tmp_path):
    campaign = write_campaign(tmp_path)
    first = store_campaign((campaign, None), tmp_path / "first", [1, 2])
    other_rigs = store_campaign((write_campaign(tmp_path, keys="rigs = 9"), None), tmp_path / "b", [3, 4])
    with pytest.raises(ConfigError, match="the two campaigns have no rig in common"):
        compare_campaigns(first, other_rigs)
    path = write_campaign(tmp_path)
    path.write_text(path.read_text().replace("seed = 5", "seed = 6"))
    seeded = store_campaign((path, None), tmp_path / "c", [1, 2])
    with pytest.raises(ConfigError, match=r"resonance_shift, .*: the rigs differ"):
        compare_campaigns(first, seeded)


def test_other_experiments_and_other_limits_are_refused(tmp_path):
    path = write_campaign(tmp_path)
    first = store_campaign((path, None), tmp_path / "first", [1, 2])
    path.write_text(path.read_text().replace('"steps.settling_ms" = 20.0', '"steps.settling_ms" = 10.0'))
    limits = store_campaign((path, None), tmp_path / "limits", [1, 2])
    path.write_text(path.read_text().replace("levels_um = [10.0]", "levels_um = [5.0]"))
    steps = store_campaign((path, None), tmp_path / "steps", [1, 2])
    with pytest.raises(ConfigError, match="limits: differ between the two campaigns"):
        compare_campaigns(first, limits)
    with pytest.raises(ConfigError, match="experiments: differ between the two campaigns"):
        compare_campaigns(limits, steps)
