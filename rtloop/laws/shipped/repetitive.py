"""Repetitive control: errors of the periods before are added to the present error; an integrator acts on the sum.

    u_k = e_k + g Σ_j q_j u_{k − N + j},    ê_k = e_k + g Σ_j q_j u_{k − N + L + j},    v' = ki ê

A plug-in internal model u (S. Hara, Y. Yamamoto, T. Omata and M. Nakano, IEEE Trans. Automatic Control 33(7), 1988)
with a smoothing filter Q without phase shift (M. Tomizuka, T.-C. Tsao and K.-K. Chew, J. Dyn. Syst. Meas. Control 111,
1989). The lead L lies outside the internal model, which therefore repeats every N ticks. T is the closed loop of the
integrator alone. The loop is stable if T is stable and |g Q (1 − z^L T)| < 1 at every frequency.

u_k is 0 in the memory if the command of tick k was limited: no command could have reduced this error, and the error
would be added to the command a period later.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from pydantic import Field

from rtloop.foundation.arrays import Real
from rtloop.kernel.validity import Allowed
from rtloop.laws.contract import Controller
from rtloop.laws.options import ControllerOptions
from rtloop.linear.realisation import System
from rtloop.linear.sampled import SampledController

MAX_PLACES = 16384
MAX_WIDTH = 32
GRID = 4096


class RepetitiveOptions(ControllerOptions):
    """Options of the integrator and of the memory of a period."""

    ki_per_s: float = Field(gt=0)
    """Gain of the integrator, in µm per second and µm of error; the loop without memory must be stable with it."""
    repeat_s: float = Field(gt=0)
    """Period of the reference, or of the disturbance: a whole number of ticks."""
    gain: float = Field(default=0.9, gt=0, le=1)
    """g: a value below 1 lets the memory decay, which tolerates model errors."""
    lead_ticks: int = Field(default=1, ge=0)
    """L: ticks that the memory is read ahead, for the loop's delay."""
    smooth_ticks: int = Field(default=8, ge=0, le=MAX_WIDTH)
    """Half-width of Q, a triangular average, in ticks."""


class Repetitive(Controller):
    """Integrator with the memory of a period."""

    options_model = RepetitiveOptions
    coefficients = MappingProxyType(
        {"ki": float, "weights": (float, 2 * MAX_WIDTH + 1), "count": int, "ahead": int, "places": int}
    )
    state = MappingProxyType({"past_um": (float, MAX_PLACES), "integral_um": float, "at": int})
    allowed_coefficients = MappingProxyType(
        {
            "count": Allowed(1, 2 * MAX_WIDTH + 1),
            "ahead": Allowed(0, MAX_PLACES - 1),
            "places": Allowed(1, MAX_PLACES),
        }
    )
    allowed_state = MappingProxyType({"at": Allowed(0, MAX_PLACES - 1)})

    def build(self) -> Mapping[str, float | Real]:
        """Return ki = ki_per_s T, the weights g q_j and their count, and `places` and `ahead` of the memory, in ticks.

        The memory has `places` errors: a period and the half-width of Q. The sum begins `ahead` ticks after the oldest
        of them.

        Raises ValueError for a period that is too long, too short or no whole number of ticks, and, unless
        `allow_unstable`, for an error that would grow from period to period on the axis's model.
        """
        options: RepetitiveOptions = self.options
        ticks, width = options.repeat_s / self.period_s, options.smooth_ticks
        repeat = round(ticks)
        if abs(ticks - repeat) > 1e-6 * ticks or not width + options.lead_ticks < repeat <= MAX_PLACES - width:
            raise ValueError(
                f"repeat_s: {options.repeat_s:g} s are {ticks:g} ticks; allowed: a whole number of ticks from "
                f"{width + options.lead_ticks + 1} (smooth_ticks + lead_ticks + 1) to {MAX_PLACES - width}"
            )
        weights = options.gain * np.bartlett(2 * width + 3)[1:-1] / (width + 1)
        if self.model is not None and not options.allow_unstable:
            self._require_contraction(weights)
        return {
            "ki": options.ki_per_s * self.period_s,
            "weights": weights,
            "count": weights.size,
            "ahead": 2 * width + options.lead_ticks,
            "places": repeat + width,
        }

    def _require_contraction(self, weights: Real) -> None:
        """Raise ValueError if an error grows from one period to the next at some frequency, on the axis's model.

        The law must have a model. `weights` are the g q_j of the sum, in the order of j.
        """
        from rtloop.linear.discretise import zero_order_hold

        turns = np.linspace(1e-6, 0.5, GRID)
        z = np.exp(2j * np.pi * turns)
        plant = zero_order_hold(self.model.transfer(), self.period_s).response(z) * z ** -float(self.model.delay_ticks)
        loop = self.options.ki_per_s * self.period_s / (z - 1) * plant
        width = weights.size // 2
        smoothed = np.sum(weights * np.cos(2 * np.pi * np.outer(turns, np.arange(-width, width + 1))), axis=1)
        error_growth = np.abs(smoothed * (1 - z**self.options.lead_ticks * loop / (1 + loop)))
        if error_growth.max() >= 1:
            hz = turns[np.argmax(error_growth)] / self.period_s
            raise ValueError(
                f"gain: at {hz:.4g} Hz an error grows by a factor of {error_growth.max():.3g} from one period to the "
                "next; use a smaller gain, more smooth_ticks, another lead_ticks, or allow_unstable = true"
            )

    @staticmethod
    def output(c: np.record, s: np.record, told: np.record) -> float:
        """Return the command in µm, the integral."""
        return s.integral_um

    @staticmethod
    def update(c: np.record, s: np.record, told: np.record) -> None:
        """Store u_k in the memory, and add ki T ê_k to the integral (equations of the module).

        If the command was limited, 0 is stored in place of u_k, and the integral moves to the applied command as well.
        """
        ahead, newest = (s.at + c.ahead) % c.places, (s.at + c.count - 1) % c.places
        led_um, repeated_um = 0.0, 0.0
        for j in range(c.count):
            led_um += c.weights[j] * s.past_um[ahead]
            repeated_um += c.weights[j] * s.past_um[newest]
            ahead = ahead - 1 if ahead > 0 else c.places - 1
            newest = newest - 1 if newest > 0 else c.places - 1
        s.past_um[s.at] = told.error_um + repeated_um if told.applied_um == told.command_um else 0.0
        s.at = (s.at + 1) % c.places
        s.integral_um += c.ki * (told.error_um + led_um) + told.applied_um - told.command_um

    def linear(self) -> SampledController:
        """Return the transfer of the integrator alone, from error to command; `build` checks the memory."""
        return SampledController(
            System(np.eye(1), np.array([self.options.ki_per_s * self.period_s]), np.ones(1), 0.0), self.period_s
        )

    @staticmethod
    def enter(c: np.record, s: np.record, told: np.record) -> None:
        """Set, in a state of zeros, the integral to the command told.command_um; the memory of a period stays empty."""
        s.integral_um = told.command_um
