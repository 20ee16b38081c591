"""The shipped laws pass the conformance suite, with the options of their examples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtloop.configuration.coefficients import make_controller
from rtloop.configuration.file import load
from rtloop.laws.conformance import Bench, LawConformance
from rtloop.laws.registry import BUILT_IN
from rtloop.laws.shipped.coupled import Coupled
from rtloop.laws.shipped.options import CoupledOptions, PrandtlIshlinskiiOptions
from rtloop.laws.shipped.pid import Pid, PidOptions
from rtloop.laws.shipped.prandtl_ishlinskii import PrandtlIshlinskii
from rtloop.laws.shipped.repetitive import Repetitive, RepetitiveOptions
from tests.kernel.harness import EQ_4, EXACT, PERIOD_S

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
EXAMPLES = {path.stem.replace("-", "_"): path for path in sorted((DEPLOY / "laws").glob("*.toml"))}


def example(path: Path):
    """Return the controller of a configuration's first axis."""
    return make_controller(load(path).axes[0], PERIOD_S)


def state_space() -> Coupled:
    """Return a controller of three axes, from random matrices."""
    random = np.random.default_rng(4)
    a = np.diag([0.0, -3.0, -40.0, -700.0, -5.0]) + np.triu(random.normal(size=(5, 5)), 1)
    matrices = {"a": a, "b": 10 * random.normal(size=(5, 3)), "c": random.normal(size=(3, 5)), "d": np.eye(3) * 0.1}
    decoupling = np.eye(3) + 0.1 * random.normal(size=(3, 3))
    options = {name: matrix.tolist() for name, matrix in {**matrices, "decoupling": decoupling}.items()}
    return Coupled(CoupledOptions.model_validate({"axes": ["x", "y", "z"], **options}), PERIOD_S, (None, None, None))


def test_every_controller_that_is_shipped_has_an_example():
    assert {*EXAMPLES, "transfer", "prandtl_ishlinskii"} == set(BUILT_IN)
    assert all(load(path).axes[0].controller.law.kind == kind for kind, path in EXAMPLES.items())


class TestTransfer(LawConformance):
    law = example(DEPLOY / "paper.toml")


class TestPid(LawConformance):
    law = example(EXAMPLES["pid"])


class TestPidWithAllItsTerms(LawConformance):
    law = Pid(PidOptions(kp=0.5, ki_per_s=150.0, kd_s=1e-5, filter_s=2e-4), PERIOD_S, None)


class TestIntegralResonant(LawConformance):
    law = example(EXAMPLES["integral_resonant"])


class TestPositivePosition(LawConformance):
    law = example(EXAMPLES["positive_position"])


class TestRepetitive(LawConformance):
    law = example(EXAMPLES["repetitive"])
    saturated_ticks = 1500


class TestCoupled(LawConformance):
    law = example(EXAMPLES["coupled"])


class TestCoupledFromAStateSpace(LawConformance):
    """Three axes, five states of which one integrates, a direct part, a decoupling."""

    law = state_space()


class TestPrandtlIshlinskii(LawConformance):
    law = PrandtlIshlinskii(PrandtlIshlinskiiOptions.model_validate(EQ_4), PERIOD_S, None)


class TestPrandtlIshlinskiiWithADeadBand(LawConformance):
    law = PrandtlIshlinskii(PrandtlIshlinskiiOptions.model_validate(EXACT), PERIOD_S, None)


def resonance(omega: float, damping: float, s: np.ndarray) -> np.ndarray:
    """Return the response of a resonance with static gain 1."""
    return omega**2 / (s**2 + 2 * damping * omega * s + omega**2)


def reference_responses(hz: np.ndarray) -> dict[str, np.ndarray]:
    """Return responses from error to command by the continuous-time equations; the position is the negative error."""
    s = 2j * np.pi * hz
    lag = 400.0 / (s + 400.0 * 3.0)
    return {
        "pid": 150.0 / s + 1e-5 * s / (1 + 2e-4 * s),
        "integral_resonant": lag * (200.0 / s - 1),
        "positive_position": 200.0 / s - 0.1 * resonance(2 * np.pi * 595.5, 0.5, s),
    }


@pytest.mark.parametrize("kind", ["pid", "integral_resonant", "positive_position"])
def test_its_linear_part_is_that_of_its_equation(kind):
    """The two agree far below the rate, within the phase of 1.5 ticks of delay."""
    hz = np.geomspace(0.1, 100.0, 50)
    from rtloop.laws.linearise import linear_part

    linear = linear_part(example(EXAMPLES[kind]))
    response = linear.system.response(np.exp(2j * np.pi * hz * PERIOD_S))
    expected = reference_responses(hz)[kind]
    assert np.max(np.abs(response - expected) / np.abs(expected)) < 2 * np.pi * 100.0 * 1.5 * PERIOD_S


def test_the_linear_part_of_c_of_z_is_found_by_running_it():
    from rtloop.laws.linearise import linearise_at_rest

    law = example(DEPLOY / "paper.toml")
    z = np.exp(2j * np.pi * np.geomspace(1.0, 4900.0, 200) * PERIOD_S)
    np.testing.assert_allclose(linearise_at_rest(law).system.response(z), law.discrete.system.response(z), rtol=1e-6)


@pytest.mark.parametrize(("lead_ticks", "smooth_ticks"), [(0, 0), (2, 3)])
def test_the_repetitive_controller_follows_its_formula(lead_ticks, smooth_ticks):
    """ê_k = e_k + g Σ_j q_j u_{k − N + L + j}, u_k = e_k + g Σ_j q_j u_{k − N + j}, q a triangle of sum 1.

    The command is the sum of ki T ê.

    Each tenth command is limited by 0.1 µm: the integral continues from the limited command, and the memory stores 0.
    """
    repeat, gain, ki_per_s = 20, 0.8, 150.0
    options = RepetitiveOptions(
        ki_per_s=ki_per_s, repeat_s=repeat * PERIOD_S, gain=gain, lead_ticks=lead_ticks, smooth_ticks=smooth_ticks
    )
    bench = Bench(Repetitive(options, PERIOD_S, None), compiled=False)
    control, commands_um = bench._control[0], []
    errors_um = np.random.default_rng(3).normal(size=5 * repeat)
    limited_um = np.where(np.arange(errors_um.size) % 10 == 9, 0.1, 0.0)
    for error_um, less_um in zip(errors_um, limited_um, strict=True):
        control.error_um = error_um
        commands_um.append(bench._commands(control))
        control.command_um, control.applied_um = commands_um[-1], commands_um[-1] - less_um
        bench._call("update", control)
    width = smooth_ticks + 1
    triangle = {j: (width - abs(j)) / width**2 for j in range(-smooth_ticks, width)}
    memory_um, expected_um = {}, [0.0]
    for k, error_um in enumerate(errors_um):
        led_um, repeated_um = (
            gain * sum(q * memory_um.get(k - repeat + lead + j, 0.0) for j, q in triangle.items())
            for lead in (lead_ticks, 0)
        )
        memory_um[k] = error_um + repeated_um if limited_um[k] == 0 else 0.0
        expected_um.append(expected_um[-1] + ki_per_s * PERIOD_S * (error_um + led_um) - limited_um[k])
    np.testing.assert_allclose(commands_um, expected_um[:-1], rtol=1e-9, atol=1e-12)
