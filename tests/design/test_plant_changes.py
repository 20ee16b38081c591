"""Changes of a plant, one at a time: one property changes and the others stay."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.analysis.perturbation import change_damping, change_gain, plant_changes, shift_resonance
from rtloop.linear.transfer import Transfer

PAIR = 2 * np.pi * 500.0 * (-0.02 + 1j * np.sqrt(1 - 0.02**2))
PLANT = Transfer.from_zpk([-2e4], [PAIR, PAIR.conjugate(), -9e3], 3e7)


def test_damping_changes_and_neither_the_frequency_nor_the_static_gain() -> None:
    changed = change_damping(PLANT, 50.0)
    pole = changed.poles[np.argmax(changed.poles.imag)]
    assert abs(pole) == pytest.approx(2 * np.pi * 500.0, rel=1e-12)
    assert -pole.real / abs(pole) == pytest.approx(0.03, rel=1e-12)
    assert changed.dc_gain == pytest.approx(PLANT.dc_gain, rel=1e-12)
    assert sorted(changed.poles.real)[0] == pytest.approx(-9e3)
    assert pole.conjugate() in changed.poles


def test_gain_changes_alone() -> None:
    changed = change_gain(PLANT, -25.0)
    assert changed.gain == pytest.approx(0.75 * PLANT.gain)
    np.testing.assert_array_equal(changed.poles, PLANT.poles)


def test_a_search_ends_at_half_the_frequency_and_before_damping_reaches_one() -> None:
    """The search range of the resonance is ±50 %; a damping ratio of 1 has no resonance."""
    changes = plant_changes(PLANT)
    assert list(changes) == ["resonance", "damping", "gain"]
    assert changes["resonance"][1:3] == (50.0, 50.0)
    assert changes["damping"].up == 900.0  # .02 · 10 = .2
    heavy = Transfer.from_zpk([], [1e3 * np.exp(2.2j), 1e3 * np.exp(-2.2j)], 1e6)
    limit = plant_changes(heavy)["damping"].up
    assert change_damping(heavy, limit).poles.imag.max() > 0
    with pytest.raises(ValueError, match="domain"):
        change_damping(heavy, limit + 1.0)
    assert list(plant_changes(Transfer.from_zpk([], [-1.0], 1.0))) == ["gain"]


def test_the_shift_moves_the_light_pair_alone() -> None:
    changed = shift_resonance(PLANT, -10.0)
    assert np.abs(changed.poles.imag).max() == pytest.approx(0.9 * PAIR.imag)
    assert -9e3 in changed.poles
    assert changed.dc_gain == pytest.approx(PLANT.dc_gain)
