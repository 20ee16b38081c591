"""Promise of a configuration for one axis: [axis.model] behind hold and delay, and its loop with C(z).

    P(z)   plant, held and delayed        L = C P,   S = 1/(1 + L),   T = L S,   F_x, F_v the pre-filter:

    x = (T F_x + P S F_v) x_d               x: position, x_d: reference

The model is linear: it leaves out the remaining hysteresis, which an experiment measures too.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rtloop.analysis.closed_loop import Loop, discrete_loop, sampled_plant
from rtloop.analysis.perturbation import (
    PercentRange,
    least_damped_pole,
    loop_builder,
    plant_changes,
    shift_resonance,
    stability_range,
)
from rtloop.analysis.step_response import step_metrics, step_response
from rtloop.configuration.axis import AxisOptions, ModelOptions
from rtloop.configuration.checks import loop_delay_ticks
from rtloop.configuration.coefficients import make_controller
from rtloop.foundation.arrays import Complex, Real
from rtloop.laws.linearise import linear_part
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.realisation import System
from rtloop.linear.sampled import SampledController
from rtloop.linear.transfer import Transfer


class LinearModel:
    """Plant and loop of an axis with a model.

    `loop` is None if it is unstable, and for an axis that has no controller, shares it with other axes, or has one that
    cannot be linearised.
    """

    def __init__(self, axis: AxisOptions, model: ModelOptions, rate_hz: float, rig_delay_ticks: int = 0) -> None:
        """Compute the plant of `model` at `rate_hz`, and its loop with the axis's controller and pre-filter.

        `loop` is None if it is unstable, and without a controller of this axis alone that can be linearised.
        `rig_delay_ticks` is the simulated rig's delay in samples, used if the model states no delay. Raises ValueError
        for a model with as many zeros as poles, unless there is no such controller.
        """
        self.rate_hz = rate_hz
        self.dynamics = model.transfer()
        self._delay_ticks = loop_delay_ticks(axis.model, rig_delay_ticks)
        self._plant = sampled_plant(self.dynamics, 1 / rate_hz, self._delay_ticks)
        self._prefilter = axis.prefilter.path()
        self._controller: DiscreteController | SampledController | None = None
        self.loop: Loop | None = None
        is_shared = axis.controller is not None and len(axis.controller.axes) > 1  # there is no loop of one axis alone
        if not is_shared and (law := make_controller(axis, 1 / rate_hz)) is not None:
            with suppress(ValueError):  # `check` warns of a law that cannot be linearised, which may run all the same
                self._controller = linear_part(law, axis.limits.command_um)
        if self._controller is not None:
            loop = discrete_loop(self._controller, self.dynamics, self._delay_ticks, self._prefilter)
            self.loop = loop if loop.is_stable else None

    @property
    def tracking_loop(self) -> Loop | None:
        """`loop`, but None if its law is not linear in the reference."""
        return None if self.loop is None or self.loop.reference_fault else self.loop

    @property
    def static_gain(self) -> float:
        """Static gain D(0) of the plant, µm of position per µm of command."""
        return self.dynamics.dc_gain

    @cached_property
    def resonance_hz(self) -> float | None:
        """Natural frequency ω_n/2π in Hz of the plant's least damped pair of poles; None if all poles are real."""
        return abs(least_damped_pole(self.dynamics)) / (2 * np.pi) if np.any(self.dynamics.poles.imag > 0) else None

    @cached_property
    def decay_per_s(self) -> float:
        """Decay −Re s in 1/s of the plant's least damped pair of poles; 0 if all poles are real."""
        return -least_damped_pole(self.dynamics).real if self.resonance_hz else 0.0

    def plant(self, hz: npt.ArrayLike) -> Complex:
        """Return the complex response P (k,) from a command to the position, at frequencies (k,) in Hz.

        It contains dynamics, hold and delay, but no hysteresis.
        """
        return self._plant.response(np.exp(2j * np.pi * np.atleast_1d(hz) / self.rate_hz))

    def tracking(self, hz: npt.ArrayLike) -> Complex | None:
        """Return the complex response (k,) from reference to position, pre-filter included, at frequencies (k,) in Hz.

        None without a `tracking_loop`.
        """
        return None if self.tracking_loop is None else self.tracking_loop.response_from_reference(hz)[0]

    def rejection(self, hz: npt.ArrayLike) -> Complex | None:
        """Return the complex response S·P (k,) from a disturbance to the position, at frequencies (k,) in Hz.

        The disturbance is added to the input of the dynamics. None without a stable loop.
        """
        return None if self.loop is None else self.plant(hz) / (1 + self.loop.open(hz))

    def open_response(self, command: Real) -> Real:
        """Return the position (n,) in µm at each tick for a command (n,) in µm, from rest and without a controller."""
        return simulate(*self._plant, command)[0]

    def closed_response(self, reference: Real) -> tuple[Real, Real] | None:
        """Return position and command, (n,) each, for a reference (n,) at the input of the pre-filter, from rest.

        All are in µm. None without a `tracking_loop`.
        """
        if self.tracking_loop is None:
            return None
        a, b, c, d = self.tracking_loop.matrices
        prefilter = self.tracking_loop.reference
        signals = simulate(a, b, c, d, prefilter.error_input(reference))
        if prefilter.has_command_path:
            signals += simulate(
                a, self.tracking_loop.injection.b, c, np.array([0.0, 1.0]), prefilter.command_input(reference)
            )
        return signals[0], signals[1]

    def disturbance_response(self, disturbance: Real) -> Real | None:
        """Return the position (n,) for a disturbance Ω (n,) added to the input of the dynamics, at the reference 0.

        Both are in µm. The position is d − T d, with T = L/(1 + L) and the motion d that Ω causes without a controller.
        None without a stable loop.
        """
        displacement = simulate(*sampled_plant(self.dynamics, 1 / self.rate_hz), disturbance)[0]
        return None if self.loop is None else displacement - simulate(*self.loop.error_matrices, displacement)[0]

    @cached_property
    def step_peak(self) -> float | None:
        """Largest |command| in a step of the reference, divided by the step's height.

        None without a `tracking_loop`.
        """
        return None if self.tracking_loop is None else step_metrics(self.tracking_loop, ()).peak_command

    @cached_property
    def step_reversal(self) -> float | None:
        """Largest command below 0 in a step of the reference up from 0 and in the step back to 0, per height; ≥ 0.

        The command of a step up may begin below 0. The command of the step back to 0 passes 0 by as much as the command
        of the step up passes its final value. None without a `tracking_loop`.
        """
        if self.tracking_loop is None:
            return None
        command, final = step_response(self.tracking_loop).command, self.tracking_loop.final_values[1]
        return float(max(-command.min(), command.max() - final, 0.0))

    @cached_property
    def sine_peak(self) -> float | None:
        """Largest amplitude of the command per amplitude of a sine of the reference, over all frequencies.

        None without a `tracking_loop`.
        """
        if self.tracking_loop is None:
            return None
        return float(np.abs(self.tracking_loop.response_from_reference(self.tracking_loop.frequencies)[1]).max())

    @cached_property
    def tracking_peak(self) -> float | None:
        """Largest amplitude of the position per amplitude of a sine of the reference, over all frequencies.

        The response contains the pre-filter. None without a `tracking_loop`.
        """
        tracking = None if self.tracking_loop is None else self.tracking(self.tracking_loop.frequencies)
        return None if tracking is None else float(np.abs(tracking).max())

    @cached_property
    def open_peak(self) -> float:
        """Largest magnitude of the plant's response from 0.1 Hz to half the rate, divided by its |static gain|."""
        resonances_hz = np.abs(self.dynamics.poles[self.dynamics.poles.imag > 0]) / (2 * np.pi)
        hz = np.concatenate([np.geomspace(0.1, self.rate_hz / 2, 3000), resonances_hz])
        return float(np.abs(self.plant(hz[hz < self.rate_hz / 2])).max() / abs(self.static_gain))

    @cached_property
    def open_overshoot(self) -> float:
        """Largest position after a step of the command, divided by the final position: 1 without overshoot."""
        ticks = round(min(20 / max(self.decay_per_s, 20.0), 1.0) * self.rate_hz)
        return float(np.max(self.open_response(np.ones(ticks)) / self.static_gain))

    def is_stable_with_shift(self, shift_percent: float) -> bool:
        """Whether the loop is stable with the frequency of the plant's resonance shifted by `shift_percent`.

        False without a controller of this axis alone that can be linearised. Raises ValueError for a plant without
        complex poles.
        """
        loop = self.build_loop(shift_resonance(self.dynamics, shift_percent))
        return loop is not None and loop.is_stable

    def build_loop(self, plant: Transfer) -> Loop | None:
        """Return the loop of the axis's controller with `plant` in place of [axis.model], stable or not.

        None without a controller of this axis alone that can be linearised. Raises ValueError for a plant with as many
        zeros as poles.
        """
        if self._controller is None:
            return None
        return discrete_loop(self._controller, plant, self._delay_ticks, self._prefilter)

    @cached_property
    def tolerated_shifts(self) -> PercentRange | None:
        """Shifts of the resonance in %, `down` and `up`, both ≥ 0, within which the loop is stable.

        (0, 0) for an unstable loop. An end is None if the loop is stable for all shifts that the search tries. None
        without a resonance, or without a controller of this axis alone that can be linearised.
        """
        if self._controller is None or not self.resonance_hz:
            return None
        resonance = plant_changes(self.dynamics)["resonance"]
        return stability_range(loop_builder(self._controller, self._delay_ticks), self.dynamics, resonance)


def linear_model(axis: AxisOptions, rate_hz: float, rig_delay_ticks: int = 0) -> LinearModel | None:
    """Return the LinearModel of an axis, its plant and loop; None for an axis without [axis.model].

    `rig_delay_ticks` is the simulated rig's delay in samples, used if the model states no delay. Raises ValueError for
    a model with as many zeros as poles, unless there is no controller of this axis alone that can be linearised.
    """
    return None if axis.model is None else LinearModel(axis, axis.model, rate_hz, rig_delay_ticks)


def simulate(a: Real, b: Real, c: Real, d: Real | float, values: Real) -> Real:
    """Return outputs (outputs, n) of the discrete system a, b, c, d from rest for one input `values` (n,).

    `c` is (outputs, states), `d` (outputs,). For one output, (states,) and a number will do; the result is (1, n).
    """
    states = System(a, b, b, 0.0).simulate_states(values)
    return np.atleast_2d(c) @ states.T + np.outer(d, values)
