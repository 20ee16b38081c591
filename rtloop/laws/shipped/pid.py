"""PID with a filtered derivative of the position and anti-windup by back-calculation.

    v = kp e + I − D,    I' = ki e + (v_applied − v) / T_t,    D = kd s / (1 + T_f s) · x

K. J. Åström and T. Hägglund, Advanced PID Control, ISA, 2006, sections 3.3 to 3.5 and 13.4: I by Euler's rule, D by
backward differences, which stay stable for any T_f. The derivative is of the position, so that no step of the reference
kicks it.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from pydantic import Field

from rtloop.laws.contract import Controller
from rtloop.laws.options import ControllerOptions


class PidOptions(ControllerOptions):
    """Gains in µm of command per µm of error."""

    kp: float = 0.0
    """Proportional gain, in µm of command per µm of error."""
    ki_per_s: float = Field(default=0.0, ge=0)
    """Integral gain, in µm per second and µm of error; with 0 there is no integral action."""
    kd_s: float = Field(default=0.0, ge=0)
    """Derivative gain, in µm per µm/s of the position; with 0 there is no derivative action."""
    filter_s: float = Field(default=1e-3, gt=0)
    """T_f, time constant of the derivative's filter."""
    tracking_s: float = Field(default=1e-3, gt=0)
    """T_t, time constant with which the integral follows a limited command."""


class Pid(Controller):
    """Proportional, integral and filtered derivative action."""

    options_model = PidOptions
    coefficients = MappingProxyType({name: float for name in ("kp", "ki", "decay", "kd", "tracking")})
    state = MappingProxyType({"integral_um": float, "derivative_um": float, "last_um": float})

    def build(self) -> Mapping[str, float]:
        """Return kp, ki = ki_per_s T, kd = kd_s/(T_f + T), decay = T_f/(T_f + T) and tracking, for the period T.

        `tracking` is the part of (v_applied − v) that the integral takes over in a tick: T/T_t, at most 1.
        """
        options: PidOptions = self.options
        filtered_s = options.filter_s + self.period_s
        return {
            "kp": options.kp,
            "ki": options.ki_per_s * self.period_s,
            "decay": options.filter_s / filtered_s,
            "kd": options.kd_s / filtered_s,
            "tracking": min(self.period_s / options.tracking_s, 1.0),
        }

    @staticmethod
    def output(c: np.record, s: np.record, told: np.record) -> float:
        """Return the command in µm: kp times the error, plus the integral, minus the filtered derivative."""
        derivative_um = c.decay * s.derivative_um + c.kd * (told.position_um - s.last_um)
        return c.kp * told.error_um + s.integral_um - derivative_um

    @staticmethod
    def update(c: np.record, s: np.record, told: np.record) -> None:
        """Advance integral and filtered derivative by a tick; the integral follows a limited command."""
        s.integral_um += c.ki * told.error_um + c.tracking * (told.applied_um - told.command_um)
        s.derivative_um = c.decay * s.derivative_um + c.kd * (told.position_um - s.last_um)
        s.last_um = told.position_um

    @staticmethod
    def enter(c: np.record, s: np.record, told: np.record) -> None:
        """Set, in a state of zeros, the integral so that `output` returns told.command_um, as if told.position_um had
        been constant before."""
        s.last_um = told.position_um
        s.integral_um = told.command_um - c.kp * told.error_um
