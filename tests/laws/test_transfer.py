"""The controller C(z) of one axis, of any order, against scipy; its states after a limited command."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from rtloop.laws.conformance import Bench
from rtloop.laws.shipped.options import TransferControllerOptions
from rtloop.laws.shipped.transfer import LANES, TransferController
from tests.kernel.harness import PERIOD_S

REAL = (-30.0, -170.0, -420.0, -900.0, -2100.0, -5200.0)
PAIRS = (-60 + 500j, -90 + 1300j, -150 + 3100j, -400 + 6000j)


def zpk(order: int) -> tuple[list[complex], list[complex], float]:
    """Return order − 1 zeros, `order` poles with at most four pairs, and a gain."""
    pairs = min(order // 3, len(PAIRS))
    poles: list[complex] = [*PAIRS[:pairs], *(pole.conjugate() for pole in PAIRS[:pairs]), *REAL[: order - 2 * pairs]]
    assert len(poles) == order
    zeros = [pole * 1.21 for pole in poles if pole.imag == 0 or order > 4][: order - 1]
    if sum(zero.imag for zero in zeros):
        zeros = [-250.0 * (number + 1) for number in range(order - 1)]
    return list(zeros), poles, 40.0


def make_bench(order: int, tracking_s: float = 0.0) -> Bench:
    """Return the bench of a controller of this order, discretised by the bilinear transform."""
    zeros, poles, gain = zpk(order)
    pairs = {name: [[root.real, root.imag] for root in map(complex, roots)] for name, roots in
             (("zeros", zeros), ("poles", poles))}  # fmt: skip
    options = TransferControllerOptions.model_validate(
        {"form": "zpk", "gain": gain, **pairs, "method": "tustin", "tracking_s": tracking_s}
    )
    return Bench(TransferController(options, PERIOD_S, None), compiled=False)


@pytest.mark.parametrize("order", [1, 2, 3, 5, 8, 9, 12, 14])
def test_commands_of_any_order_are_those_of_its_bilinear_transform(order: int) -> None:
    errors_um = np.random.default_rng(order).normal(size=400)
    bench = make_bench(order)
    control, commands_um = bench._control[0], []
    for error_um in errors_um:
        control.error_um = error_um
        control.command_um = control.applied_um = bench._commands(control)
        commands_um.append(control.applied_um)
        bench._call("update", control)
    sections = signal.zpk2sos(*signal.bilinear_zpk(*zpk(order), 1 / PERIOD_S))
    expected = signal.sosfilt(sections, errors_um)
    np.testing.assert_allclose(commands_um, expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("order", [5, 8, 12, 14])
def test_states_follow_a_limited_command_at_once_where_they_may(order: int) -> None:
    """x̃ = x + m (v_applied − v) explains the applied command, c x̃ + d e; and x⁺ = A x̃ + b e."""
    bench, random = make_bench(order), np.random.default_rng(order)
    law, n = bench.coefficients[0], int(bench.coefficients["order"][0])
    states = np.arange(n)
    a = np.array(law["coupling"][:n, :n])
    a[states, states] += law["own"][:n]
    a[states, states ^ LANES] += law["partner"][:n]
    control = bench._control[0]
    for _ in range(30):
        control.error_um = random.normal()
        control.command_um = bench._commands(control)
        control.applied_um = random.normal()
        x = bench.state["controller"][0, :n] + law["tracking"][:n] * (control.applied_um - control.command_um)
        assert law["c"][:n] @ x + law["d"] * control.error_um == pytest.approx(control.applied_um, abs=1e-8)
        bench._call("update", control)
        np.testing.assert_allclose(bench.state["controller"][0, :n], a @ x + law["b"][:n] * control.error_um, atol=1e-9)
