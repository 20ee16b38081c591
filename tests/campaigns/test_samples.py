"""Samples of campaigns: independent of batches, uniform by the Kolmogorov–Smirnov test of scipy, evenly spread."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rtloop.campaigns.samples import noise_seed, unit_samples

KEYS = ("driver.a", "driver.b", "driver.c")
SAMPLINGS = ("random", "latin_hypercube", "sobol")
ALL = (*SAMPLINGS, "saltelli")


@pytest.mark.parametrize("sampling", ALL)
def test_samples_do_not_depend_on_batch_or_order(sampling):
    together = unit_samples(sampling, KEYS, 0, 100, 100, 3)
    one_by_one = [unit_samples(sampling, KEYS, number, 1, 100, 3)[0] for number in reversed(range(100))]
    assert np.array_equal(together, one_by_one[::-1])


@pytest.mark.parametrize("sampling", ["random", "sobol", "saltelli"])
def test_more_rigs_leave_the_first_as_they_are(sampling):
    assert np.array_equal(unit_samples(sampling, KEYS, 0, 50, 50, 3), unit_samples(sampling, KEYS, 0, 50, 100, 3))


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_a_further_key_leaves_the_others_as_they_are(sampling):
    fewer, more = (unit_samples(sampling, keys, 0, 64, 64, 3) for keys in (KEYS, (*KEYS, "driver.d")))
    assert np.array_equal(fewer, more[:, :3])


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_another_seed_draws_others(sampling):
    first, second = (unit_samples(sampling, KEYS, 0, 64, 64, seed) for seed in (3, 4))
    assert not np.any(np.all(first == second, axis=0))


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_samples_are_uniform_and_independent(sampling):
    samples = unit_samples(sampling, KEYS, 0, 2000, 2000, 3)
    assert np.all((samples > 0) & (samples < 1))
    for column in samples.T:
        assert stats.kstest(column, "uniform").pvalue > 0.01
    assert np.abs(np.corrcoef(samples.T) - np.eye(3)).max() < 0.06


@pytest.mark.parametrize("sampling", ["latin_hypercube", "sobol"])
def test_each_part_of_the_interval_has_one_sample(sampling):
    samples = unit_samples(sampling, KEYS, 0, 256, 256, 3)
    for column in samples.T:
        assert sorted((column * 256).astype(int)) == list(range(256))


def test_sobol_fills_squares_more_evenly_than_chance():
    samples = unit_samples("sobol", KEYS, 0, 256, 256, 3)
    counts = np.histogram2d(samples[:, 0], samples[:, 1], bins=8, range=[[0, 1], [0, 1]])[0]
    assert np.all(counts == 4)


def test_samples_beyond_the_last_are_refused():
    with pytest.raises(ValueError, match=r"samples of rigs 100 … 101; allowed in a campaign of 100 rigs: 1 … 100"):
        unit_samples("random", KEYS, 99, 2, 100, 3)


def test_no_two_rigs_share_a_seed():
    seeds = {noise_seed(3, rig) for rig in range(10_000)}
    assert len(seeds) == 10_000
    assert max(seeds) < 2**63
