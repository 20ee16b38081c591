"""Linearisation refuses laws that are not smooth, or not finite, a small way from rest."""

from __future__ import annotations

import math
from typing import Any

import pytest

from rtloop.laws.contract import Controller
from rtloop.laws.linearise import STEP, linearise_at_rest
from rtloop.laws.options import ControllerOptions
from tests.kernel.harness import PERIOD_S


class JumpingIntegrator(Controller):
    """Integrator with a direct term, whose command is `jump_um` where the error is `at_um`."""

    coefficients = {"at_um": float, "jump_um": float}  # noqa: RUF012
    state = {"integral_um": float}  # noqa: RUF012
    at_um, jump_um = 0.0, 0.0

    def build(self) -> dict[str, Any]:
        return {"at_um": self.at_um, "jump_um": self.jump_um}

    def output(c: Any, s: Any, told: Any) -> float:
        if told.error_um == c.at_um:
            return c.jump_um
        return s.integral_um + 2.0 * told.error_um

    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += 0.1 * told.error_um


def make_law(at_um: float, jump_um: float) -> JumpingIntegrator:
    law = JumpingIntegrator(ControllerOptions(), PERIOD_S, None)
    law.at_um, law.jump_um = at_um, jump_um
    return law


@pytest.mark.parametrize("at_um", [STEP, STEP / 2])
def test_a_law_that_is_not_finite_near_its_rest_fails(at_um: float) -> None:
    with pytest.raises(ValueError, match="the law fails at rest: ValueError: the results are not finite"):
        linearise_at_rest(make_law(at_um, math.inf))


@pytest.mark.parametrize("at_um", [STEP, STEP / 2])
def test_a_law_that_jumps_near_its_rest_is_not_smooth(at_um: float) -> None:
    with pytest.raises(ValueError, match="not smooth at rest"):
        linearise_at_rest(make_law(at_um, 1.0))


def test_a_law_that_jumps_elsewhere_has_its_linear_part() -> None:
    """The linear part is v = x + 2 e, x⁺ = x + 0.1 e."""
    system = linearise_at_rest(make_law(1.0, 1e6)).system
    assert [system.a.item(), system.b.item(), system.c.item(), system.d] == pytest.approx([1.0, 0.1, 1.0, 2.0])
