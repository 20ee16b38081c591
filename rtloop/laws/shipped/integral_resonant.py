"""Integral resonant control: damping by a lag in positive feedback, and an integrator around it.

    C₂(s) = k / (s + k d),    v = C₂ (w + x),    w' = ki e

A. J. Fleming, S. S. Aphale and S. O. R. Moheimani, A new method for robust damping and tracking control of scanning
probe microscope positioning stages, IEEE Trans. Nanotechnology 9(4), 2010, eqs (10) to (17), with d = −D_f. d must be
above the magnitude of the plant's gain at 0 Hz. The lag is discretised exactly, for an input held over each tick.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from pydantic import Field

from rtloop.laws.contract import Controller
from rtloop.laws.options import ControllerOptions


class IntegralResonantOptions(ControllerOptions):
    """Options of the lag and of the integrator around it."""

    gain_per_s: float = Field(gt=0)
    """k, bandwidth of the lag with a feedthrough of 1."""
    feedthrough: float = Field(gt=0)
    """d, above the plant's gain at 0 Hz in µm per µm."""
    ki_per_s: float = Field(ge=0)
    """Gain of the integrator, in µm per second and µm of error; 0 damps without tracking."""
    tracking_s: float = Field(default=1e-3, gt=0)
    """Time constant with which the integrator follows a limited command."""


class IntegralResonant(Controller):
    """A lag in positive feedback damps the resonance; an integrator tracks."""

    kind = "integral_resonant"
    options_model = IntegralResonantOptions
    coefficients = MappingProxyType({name: float for name in ("ki", "feedthrough", "decay", "tracking")})
    state = MappingProxyType({"integral_um": float, "lag_um": float})

    def build(self) -> Mapping[str, float]:
        """Return ki = ki_per_s T, feedthrough = d, decay = exp(−k d T) of the lag and tracking, for the period T.

        `tracking` is the part of (v_applied − v) that the lag takes over in a tick: T/`tracking_s`, at most 1. The
        integral takes over d times as much.
        Raises ValueError for a feedthrough that is not above the magnitude of the model's gain at 0 Hz.
        """
        options: IntegralResonantOptions = self.options
        if self.model is not None and (gain := abs(self.model.transfer().dc_gain)) >= options.feedthrough:
            raise ValueError(
                f"feedthrough: {options.feedthrough:g}; allowed: above the plant's gain at 0 Hz, {gain:.4g}"
            )
        return {
            "ki": options.ki_per_s * self.period_s,
            "feedthrough": options.feedthrough,
            "decay": math.exp(-options.gain_per_s * options.feedthrough * self.period_s),
            "tracking": min(self.period_s / options.tracking_s, 1.0),
        }

    @staticmethod
    def output(c: np.record, s: np.record, told: np.record) -> float:
        """Return the command in µm, the state of the lag."""
        return s.lag_um

    @staticmethod
    def update(c: np.record, s: np.record, told: np.record) -> None:
        """Advance lag and integral by a tick; both follow the applied command."""
        shortfall_um = told.applied_um - told.command_um
        target_um = (s.integral_um + told.position_um) / c.feedthrough
        s.lag_um = c.decay * s.lag_um + (1.0 - c.decay) * target_um + c.tracking * shortfall_um
        s.integral_um += c.ki * told.error_um + c.tracking * c.feedthrough * shortfall_um

    @staticmethod
    def enter(c: np.record, s: np.record, told: np.record) -> None:
        """Set the lag to the command told.command_um, and the integral so that the lag rests there at the position
        told.position_um."""
        s.lag_um = told.command_um
        s.integral_um = c.feedthrough * told.command_um - told.position_um
