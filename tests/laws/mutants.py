"""Laws that each break one promise, and the test of the conformance suite that says so."""

# ruff: noqa: RUF012
from __future__ import annotations

import math
from typing import Any

import numpy as np

from rtloop.kernel.validity import Allowed
from rtloop.laws import Controller

MEMORY = [0.0]
GLOBAL = np.zeros(1)


class Good(Controller):
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


class InfiniteCoefficient(Good):
    def build(self) -> dict[str, Any]:
        return {"ki": math.inf}


class AnotherBuildEachTime(Good):
    def build(self) -> dict[str, Any]:
        MEMORY[0] += 1.0
        return {"ki": 0.01 * MEMORY[0]}


class UnboundedIndex(Good):
    coefficients = {"ki": float, "which": int}

    def build(self) -> dict[str, Any]:
        return {"ki": 0.01, "which": 0}


class UnboundedIndexOfState(Good):
    state = {"integral_um": float, "at": int}


class RulesForNothing(Good):
    allowed_coefficients = {"ki": Allowed(0, 1)}


class WritesCoefficients(Good):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um
        c.ki = c.ki * 0.999


class RemembersElsewhere(Good):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        GLOBAL[0] += told.error_um
        return s.integral_um + GLOBAL[0]

    enter = None


class CountsElsewhere(Good):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        GLOBAL[0] += 1.0
        return s.integral_um + 1e-9 * GLOBAL[0]


class GrowsWithoutBound(Good):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um = 1.1 * s.integral_um + told.error_um


class InfiniteFromACommandBelowZero(Good):
    """Goes wrong where the command in force, from which a law may continue, is negative."""

    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        return math.inf if told.command_um < 0.0 else s.integral_um


class NoAntiWindup(Good):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += 1e8 * told.error_um


class WindsUp(Good):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += c.ki * told.error_um


class WindsUpALittle(Good):
    """A tenth of what was not applied is made up for in a tick: 23 ms for a loop that takes 30 ms."""

    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += c.ki * told.error_um + 0.004 * (told.applied_um - told.command_um)


class EntersAtZero(Good):
    @staticmethod
    def enter(c: Any, s: Any, told: Any) -> None:
        s.integral_um = 0.0


class EntersWithTheErrorForgotten(Good):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        return 0.5 * told.error_um + s.integral_um


class KeepsNan(Good):
    @staticmethod
    def enter(c: Any, s: Any, told: Any) -> None:
        s.integral_um = told.command_um
        if c.ki > 0.0:
            s.integral_um = (told.command_um - told.command_um) / (told.error_um - told.error_um + 1e-320 * 1e-320)


class Sine(Good):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        return s.integral_um + math.sin(told.reference_um)

    enter = None


class Power(Good):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        return s.integral_um + abs(told.error_um) ** 0.3

    enter = None


class TakesMemory(Good):
    @staticmethod
    def output(c: Any, s: Any, told: Any) -> float:
        taken = np.zeros(3)
        taken[0] = s.integral_um
        return taken.sum()


class Prints(Good):
    @staticmethod
    def update(c: Any, s: Any, told: Any) -> None:
        print(told.error_um)
        s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um


class RaisesWhatItMade(Good):
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
    WindsUp: WINDUP,
    WindsUpALittle: WINDUP,
    EntersAtZero: ENTERS,
    EntersWithTheErrorForgotten: ENTERS,
    KeepsNan: POISON,
    Sine: FOREIGN,
    Power: FOREIGN,
    TakesMemory: FOREIGN,
    Prints: FOREIGN,
    RaisesWhatItMade: FOREIGN,
}
