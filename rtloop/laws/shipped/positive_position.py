"""Positive position feedback: a tuned filter in positive feedback damps the resonance, and an integrator tracks.

    F(s) = g ω² / (s² + 2 ζ ω s + ω²),    v = I + F x,    I' = ki e

J. L. Fanson and T. K. Caughey, Positive position feedback control for large space structures, AIAA Journal 28(4), 1990,
eqs (5), (6). The loop through F is stable at 0 Hz as long as g times the plant's gain stays below 1. F is discretised
exactly, for an input held over each tick.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from pydantic import Field

from rtloop.foundation.arrays import Real
from rtloop.laws.contract import Controller
from rtloop.laws.options import ControllerOptions


class PositivePositionOptions(ControllerOptions):
    """Options of the filter and of the parallel integrator."""

    gain: float = Field(gt=0)
    """g, in µm of command per µm of position."""
    filter_hz: float = Field(gt=0)
    """Natural frequency ω/2π of the filter, near the resonance that it damps."""
    damping: float = Field(gt=0, lt=1)
    """ζ, damping ratio of the filter."""
    ki_per_s: float = Field(ge=0)
    """Gain of the integrator, in µm per second and µm of error; 0 damps without tracking."""
    tracking_s: float = Field(default=1e-3, gt=0)
    """Time constant with which the integral follows a limited command."""


class PositivePosition(Controller):
    """A resonant filter in positive feedback, beside an integrator."""

    kind = "positive_position"
    options_model = PositivePositionOptions
    coefficients = MappingProxyType(
        {"a": (float, (2, 2)), "b": (float, 2), "gain": float, "ki": float, "tracking": float}
    )
    state = MappingProxyType({"filter": (float, 2), "integral_um": float})

    def build(self) -> Mapping[str, float | Real]:
        """Return a (2, 2) and b (2,) of the discretised filter, gain = g, ki = ki_per_s T and tracking, for the period
        T.

        `tracking` is the part of (v_applied − v) that the integral takes over in a tick: T/`tracking_s`, at most 1.
        Raises ValueError for a gain that, times the magnitude of the model's gain at 0 Hz, is 1 or more.
        """
        options: PositivePositionOptions = self.options
        if self.model is not None and (gain := options.gain * abs(self.model.transfer().dc_gain)) >= 1:
            raise ValueError(
                f"gain: {options.gain:g} times the plant's gain at 0 Hz is {gain:.4g}; allowed: below 1. "
                "Use a smaller gain"
            )
        a, b = discretise_resonance(2 * math.pi * options.filter_hz, options.damping, self.period_s)
        return {
            "a": a,
            "b": b,
            "gain": options.gain,
            "ki": options.ki_per_s * self.period_s,
            "tracking": min(self.period_s / options.tracking_s, 1.0),
        }

    @staticmethod
    def output(c: np.record, s: np.record, told: np.record) -> float:
        """Return the command in µm: the integral plus the filtered position."""
        return s.integral_um + c.gain * s.filter[0]

    @staticmethod
    def update(c: np.record, s: np.record, told: np.record) -> None:
        """Advance filter and integral by a tick; the integral follows the applied command."""
        first, second = s.filter[0], s.filter[1]
        s.filter[0] = c.a[0, 0] * first + c.a[0, 1] * second + c.b[0] * told.position_um
        s.filter[1] = c.a[1, 0] * first + c.a[1, 1] * second + c.b[1] * told.position_um
        s.integral_um += c.ki * told.error_um + c.tracking * (told.applied_um - told.command_um)

    @staticmethod
    def enter(c: np.record, s: np.record, told: np.record) -> None:
        """Set, in a state of zeros, the filter at rest at told.position_um, and the integral so that `output` returns
        told.command_um.
        """
        s.filter[0] = told.position_um
        s.integral_um = told.command_um - c.gain * told.position_um


def discretise_resonance(omega: float, damping: float, period_s: float) -> tuple[Real, Real]:
    """Return A (2, 2) and b (2,) of ω²/(s² + 2 ζ ω s + ω²), for an input held over each period.

    ω is `omega` in rad/s, ζ is `damping`, below 1. The states are the output, and its rate divided by ω.
    """
    decay, angle = math.exp(-damping * omega * period_s), omega * math.sqrt(1 - damping**2) * period_s
    share = damping / math.sqrt(1 - damping**2)
    cosine, sine = decay * math.cos(angle), decay * math.sin(angle)
    a = np.array([
        [cosine + share * sine, sine / math.sqrt(1 - damping**2)],
        [-sine / math.sqrt(1 - damping**2), cosine - share * sine],
    ])  # fmt: skip
    return a, (np.eye(2) - a) @ np.array([1.0, 0.0])
