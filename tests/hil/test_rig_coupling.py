"""Axes that move each other: y_i + Σ k_ij y_j drives the dynamics of axis i."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import signal

from rtloop.hil.options import DynamicsOptions, PlantOptions, RigOptions
from rtloop.hil.rig import advance, build_rig, sample

PERIOD_S = 1e-3
COUPLING = {"x": {"y": 0.2}, "y": {"x": -0.1}}
POLES = {"x": 300.0, "y": 150.0}


def rig(ideal: Any, **options: Any) -> RigOptions:
    """Return options of two coupled linear axes, whose positions follow their displacements with one pole each."""
    plants = {
        name: ideal(dynamics=DynamicsOptions(form="zpk", poles=[[-pole, 0.0]], gain=pole)).plant
        for name, pole in POLES.items()
    }
    return RigOptions(plants=plants, coupling=COUPLING, **options)


def run(options: RigOptions, drives_v: np.ndarray, axes: tuple[str, ...] = ("x", "y")) -> np.ndarray:
    """Return the true positions (ticks, axes) in µm for drives (ticks, axes) in V."""
    coefficients, state = build_rig(options, axes, PERIOD_S)
    positions_um = np.empty_like(drives_v)
    for k, drive_v in enumerate(drives_v):
        for i in range(len(axes)):
            sample(coefficients[i], state[i])
        positions_um[k] = state["true_position_um"]
        advance(coefficients, state, drive_v)
    return positions_um


def test_each_axis_follows_the_mixture_through_its_own_dynamics(ideal):
    drives_v = np.random.default_rng(3).uniform(-5, 5, (400, 2)).cumsum(axis=0) / 30
    positions_um = run(rig(ideal), drives_v)
    mixed = drives_v @ np.array([[1.0, 0.2], [-0.1, 1.0]]).T
    for i, pole in enumerate(POLES.values()):
        matrices = [np.array([[value]]) for value in (-pole, pole, 1.0, 0.0)]
        _, expected, _ = signal.dlsim(signal.cont2discrete(matrices, PERIOD_S, "zoh"), mixed[:, i])
        np.testing.assert_allclose(positions_um[:, i], np.ravel(expected), atol=1e-12)


def test_without_a_coupling_nothing_is_added(ideal):
    drives_v = np.zeros((50, 2))
    drives_v[:, 1] = 5.0
    assert np.all(run(rig(ideal).model_copy(update={"coupling": {}}), drives_v)[:, 0] == 0)


def test_a_history_moves_the_neighbour_too(ideal):
    """An actuator that its history left displaced also displaces the coupled axis, from the first sample on."""
    aged = PlantOptions.model_validate({"hysteresis": {"history_v": [10.0, -4.0]}, "dynamics": {"form": "paper"}})
    options = RigOptions(plants={"y": aged}, coupling={"x": {"y": 0.5}})
    positions_um = run(options, np.zeros((20, 2)))
    np.testing.assert_allclose(positions_um[:, 0], 0.5 * positions_um[0, 1], rtol=1e-9)
    assert positions_um[0, 1] != 0


@pytest.mark.parametrize(
    ("coupling", "axes", "message"),
    [
        ({"x": {"z": 0.1}}, ["x", "y"], "coupling.x: 'z' is not an axis; allowed: x, y"),
        ({"z": {"x": 0.1}}, ["x", "y"], "coupling.z: 'z' is not an axis; allowed: x, y"),
        ({"x": {"x": 0.1}}, ["x", "y"], "coupling.x.x: an axis cannot be coupled to itself"),
        (
            {"a0": {"a1": 0.1}},
            [f"a{i}" for i in range(17)],
            "coupling: the rig has 17 axes; allowed with coupling: at most 16",
        ),
    ],
)
def test_a_bad_coupling_is_refused(coupling, axes, message):
    with pytest.raises(ValueError, match=message):
        build_rig(RigOptions(coupling=coupling), axes, PERIOD_S)
