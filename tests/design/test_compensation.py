"""Output and bound ξ of the inverse compensation, against compositions of plays and plays stepped one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.hil.stages.hysteresis import RESIDUAL_WEIGHTS_UM_PER_V, THRESHOLDS_V
from rtloop.hysteresis.compensation import compensated_output, residual_operator
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import model_output
from tests.design.rigs import COMMAND_UM, EQ_4, draw_rig

INVERSE = EQ_4.remove_dead_band().inverse()
RESIDUAL_RIG = PlayModel(np.array(THRESHOLDS_V), np.array(RESIDUAL_WEIGHTS_UM_PER_V))


@st.composite
def play_models(draw) -> PlayModel:
    """Draw a play model whose loading curve increases, with or without a dead band."""
    slopes = draw(st.lists(st.floats(0.2, 8.0), min_size=1, max_size=8))
    gaps = draw(st.lists(st.floats(0.05, 2.0), min_size=len(slopes), max_size=len(slopes)))
    first_threshold = draw(st.sampled_from([0.0, gaps[0]]))
    return PlayModel(np.cumsum([first_threshold, *gaps[1:]]), np.diff(slopes, prepend=0.0))


@settings(deadline=None)
@given(play_models(), play_models(), st.lists(st.floats(-1, 1), min_size=1, max_size=40))
def test_the_composition_is_the_operator_and_stays_within_its_bound(actuator, compensator, commands) -> None:
    inverse, v = compensator.remove_dead_band().inverse(), COMMAND_UM * np.array(commands)
    residual = residual_operator(actuator, inverse, COMMAND_UM)
    y = compensated_output(actuator, inverse, v)
    size = max(1.0, float(np.abs(y).max()))
    assert np.allclose(y, model_output(residual.operator, v), atol=1e-7 * size)
    for gain in (residual.gain, residual.best_gain, 1.0):
        assert np.abs(y - gain * v).max() <= residual.bound_um(gain) + 1e-7 * size
    assert residual.bound_um(residual.best_gain) <= residual.bound_um(residual.gain) + 1e-9 * size


@settings(deadline=None)
@given(play_models(), play_models())
def test_the_bound_is_reached(actuator, compensator) -> None:
    inverse = compensator.remove_dead_band().inverse()
    residual = residual_operator(actuator, inverse, COMMAND_UM)
    for gain in (residual.gain, residual.best_gain, 1.0):
        v = residual.worst_commands_um(gain)
        assert np.abs(v).max() <= COMMAND_UM * (1 + 1e-12)
        error_um = compensated_output(actuator, inverse, v)[-1] - gain * v[-1]
        assert abs(error_um) == pytest.approx(residual.bound_um(gain), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("seed", range(301, 311))
def test_the_bound_holds_on_drawn_rigs_stepped_one_by_one(seed: int) -> None:
    rig, random = draw_rig(seed), np.random.default_rng(seed)
    residual = residual_operator(PlayModel(rig.thresholds, rig.d0 * rig.weights), INVERSE, COMMAND_UM)
    bound = residual.bound_um(residual.gain)
    for name, v in {
        "sine": COMMAND_UM * np.sin(np.linspace(0, 5 * np.pi, 4001)),
        "random": random.uniform(-COMMAND_UM, COMMAND_UM, 4000),
        "worst": residual.worst_commands_um(residual.gain),
    }.items():
        error_um = np.abs(rig.static_um(model_output(INVERSE, v)) - residual.gain * v).max()
        print(f"seed {seed}: ξ {bound:.3f} µm, {name} reaches {100 * error_um / bound:.1f} % of ξ")
        assert error_um <= bound * (1 + 1e-9)


def test_eq_3_as_printed_is_no_bound_where_weights_have_both_signs() -> None:
    """A sine of 40 µm on the paper's rig leaves 1.86 µm; |∫ r p(r) dr| is 1.52 µm and ξ is 2.28 µm."""
    residual = residual_operator(RESIDUAL_RIG, INVERSE, COMMAND_UM)
    v = COMMAND_UM * np.sin(np.linspace(0, 5 * np.pi, 5001))
    error_um = np.abs(compensated_output(RESIDUAL_RIG, INVERSE, v) - residual.gain * v).max()
    assert residual.printed_bound_um == pytest.approx(1.523, abs=2e-3)
    assert error_um == pytest.approx(1.856, abs=2e-3)
    assert residual.bound_um(residual.gain) == pytest.approx(2.284, abs=2e-3)
    assert residual.printed_bound_um < error_um <= residual.bound_um(residual.gain) <= residual.safe_bound_um


def test_eq_3_is_the_bound_where_all_weights_have_one_sign() -> None:
    actuator = PlayModel(np.array([0.0, 1.0, 3.0]), np.array([1.0, 0.5, 0.7]))
    residual = residual_operator(actuator, PlayModel(np.zeros(1), np.ones(1)), 10.0)
    assert residual.gain == pytest.approx(2.2)
    assert residual.printed_bound_um == pytest.approx(0.5 * 1 + 0.7 * 3)
    assert residual.bound_um(residual.gain) == pytest.approx(residual.printed_bound_um)


def test_an_exact_inverse_leaves_nothing() -> None:
    actuator = EQ_4.remove_dead_band()
    residual = residual_operator(actuator, actuator.inverse(), COMMAND_UM)
    assert residual.gain == pytest.approx(1.0)
    assert residual.bound_um(1.0) < 1e-12


def test_the_dead_band_alone_leaves_what_the_model_of_eq_4_says() -> None:
    """A 40 µm sine from rest leaves 0.747 µm, because the inverse omits the dead band of r_0 = 0.095 V."""
    v = COMMAND_UM * np.sin(np.linspace(0, 5 * np.pi, 20_001))
    assert np.abs(compensated_output(EQ_4, INVERSE, v) - v).max() == pytest.approx(0.747, abs=1e-3)


@pytest.mark.parametrize(
    ("compensator", "command_um", "message"),
    [
        (
            PlayModel(np.array([0.0, 1.0]), np.array([1.0, -1.5])),
            40.0,
            "compensator: the first threshold is 0 µm, and the loading curve has the slopes .*; "
            "allowed: a first threshold of 0 µm, and slopes above 0",
        ),
        (INVERSE, -1, "command_um: -1"),
    ],
)
def test_refusals(compensator: PlayModel, command_um: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        residual_operator(EQ_4, compensator, command_um)
