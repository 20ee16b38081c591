"""Laws that each break one promise of the contract, and the test of the conformance suite that must fail."""

# ruff: noqa: RUF012
from __future__ import annotations

import math
from typing import Any

import numpy as np

from rtloop.kernel.validity import Allowed
from rtloop.laws import Controller

MEMORY = [0.0]
GLOBAL = np.zeros(1)


class CorrectIntegrator(Controller):
    """Integrator that passes the suite; each mutant differs from it in one respect."""

    coefficients = {"ki": float}
    state = {"integral_um": float}

    def build(self) -> dict[str, Any]:
        return {"ki": 0.01}

    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        return s.integral_um

    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um

    @staticmethod
    def enter(c: Any, s: Any, told: Any) -> None:
        s.integral_um = told.command_um


class WithReferencePath(CorrectIntegrator):
    """Adds the reference to the command, whose limit moves the integrator far."""

    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        return s.integral_um + told.reference_um

    @staticmethod
    def enter(c: Any, s: Any, told: Any) -> None:
        s.integral_um = told.command_um - told.reference_um


class WithWeightedReference(CorrectIntegrator):
    """PI whose reference has the weight 0.2 in the proportional part, with conditional integration."""

    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        return 0.5 * (0.2 * told.reference_um - told.position_um) + s.integral_um

    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        missing_um = told.applied_um - told.command_um
        if abs(missing_um) < 1e-9 or missing_um * told.error_um >= 0.0:
            s.integral_um += c.ki * told.error_um

    @staticmethod
    def enter(c: Any, s: Any, told: Any) -> None:
        s.integral_um = told.command_um - 0.5 * (0.2 * told.reference_um - told.position_um)


CORRECT = (CorrectIntegrator, WithReferencePath, WithWeightedReference)


class InfiniteCoefficient(CorrectIntegrator):
    def build(self) -> dict[str, Any]:
        return {"ki": math.inf}


class AnotherBuildEachTime(CorrectIntegrator):
    def build(self) -> dict[str, Any]:
        MEMORY[0] += 1.0
        return {"ki": 0.01 * MEMORY[0]}


class UnboundedIndex(CorrectIntegrator):
    coefficients = {"ki": float, "which": int}

    def build(self) -> dict[str, Any]:
        return {"ki": 0.01, "which": 0}


class UnboundedIndexOfState(CorrectIntegrator):
    state = {"integral_um": float, "at": int}


class RulesForNothing(CorrectIntegrator):
    allowed_coefficients = {"ki": Allowed(0, 1)}


class WritesCoefficients(CorrectIntegrator):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um
        c.ki = c.ki * 0.999


class RemembersElsewhere(CorrectIntegrator):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        GLOBAL[0] += told.error_um
        return s.integral_um + GLOBAL[0]

    enter = None


class CountsElsewhere(CorrectIntegrator):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        GLOBAL[0] += 1.0
        return s.integral_um + 1e-9 * GLOBAL[0]


class GrowsWithoutBound(CorrectIntegrator):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um = 1.1 * s.integral_um + told.error_um


class InfiniteFromACommandBelowZero(CorrectIntegrator):
    """Returns infinity where the command in force, from which a law may continue, is negative."""

    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        return math.inf if told.command_um < 0.0 else s.integral_um


class NoAntiWindup(CorrectIntegrator):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += 1e8 * told.error_um


class StopsAtARoundingError(CorrectIntegrator):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        if (told.applied_um - told.command_um) * told.error_um >= 0.0:
            s.integral_um += c.ki * told.error_um


class WindsUp(CorrectIntegrator):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += c.ki * told.error_um


class WindsUpALittle(CorrectIntegrator):
    """Moves its state in a tick by only 0.4 % of the difference between applied command and command."""

    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += c.ki * told.error_um + 0.004 * (told.applied_um - told.command_um)


class WindsUpBehindAReferencePath(WithReferencePath):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += c.ki * told.error_um


class WindsUpBehindAWeightedReference(WithWeightedReference):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += c.ki * told.error_um


class EntersAtZero(CorrectIntegrator):
    @staticmethod
    def enter(c: Any, s: Any, told: Any) -> None:
        s.integral_um = 0.0


class EntersWithTheErrorForgotten(CorrectIntegrator):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        return 0.5 * told.error_um + s.integral_um


class KeepsNan(CorrectIntegrator):
    @staticmethod
    def enter(c: Any, s: Any, told: Any) -> None:
        s.integral_um = told.command_um
        if c.ki > 0.0:
            s.integral_um = (told.command_um - told.command_um) / (told.error_um - told.error_um + 1e-320 * 1e-320)


class Sine(CorrectIntegrator):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        return s.integral_um + math.sin(told.reference_um)

    enter = None


class Power(CorrectIntegrator):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        return s.integral_um + abs(told.error_um) ** 0.3

    enter = None


class TakesMemory(CorrectIntegrator):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        buffer = np.zeros(3)
        buffer[0] = s.integral_um
        return buffer.sum()


class Prints(CorrectIntegrator):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        print(told.error_um)
        s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um


class RaisesWhatItMade(CorrectIntegrator):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        if told.error_um > 1e300:
            raise ValueError(told.error_um)
        s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um


FINITE, WHOLE = "test_build_gives_finite_numbers", "test_whole_numbers_are_bounded"
BITS, RECORD = "test_compiled_and_uncompiled_give_the_same_bits", "test_its_state_is_in_its_record"
READ_ONLY, STAYS = "test_its_coefficients_are_read_only", "test_it_stays_finite"
POISON, ENTERS = "test_no_number_that_is_none_outlives_an_entry", "test_enter_continues_from_the_command"
WINDUP = "test_a_limited_command_does_not_wind_it_up"
ROUNDING = "test_a_rounding_error_of_the_applied_command_stops_nothing"
FOREIGN = "test_it_calls_nothing_that_waits_or_differs"
BROKEN = {
    InfiniteCoefficient: FINITE,
    AnotherBuildEachTime: FINITE,
    UnboundedIndex: WHOLE,
    UnboundedIndexOfState: WHOLE,
    RulesForNothing: WHOLE,
    WritesCoefficients: READ_ONLY,
    RemembersElsewhere: RECORD,
    CountsElsewhere: RECORD,
    GrowsWithoutBound: STAYS,
    InfiniteFromACommandBelowZero: STAYS,
    NoAntiWindup: STAYS,
    StopsAtARoundingError: ROUNDING,
    WindsUp: WINDUP,
    WindsUpALittle: WINDUP,
    WindsUpBehindAReferencePath: WINDUP,
    WindsUpBehindAWeightedReference: WINDUP,
    EntersAtZero: ENTERS,
    EntersWithTheErrorForgotten: ENTERS,
    KeepsNan: POISON,
    Sine: FOREIGN,
    Power: FOREIGN,
    TakesMemory: FOREIGN,
    Prints: FOREIGN,
    RaisesWhatItMade: FOREIGN,
}
