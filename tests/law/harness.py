"""One axis of the compiled law, stepped through arrays of inputs."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.coefficients import axis_coefficients
from rtloop.drivers.base import Channel
from rtloop.hil.native.compiled import jit
from rtloop.law.law import evaluate, reset_trip, set_mode, update
from rtloop.law.layout import CONDITIONS, Records, initial_state, records
from rtloop.linear.discretise import discretise
from rtloop.signals import Mode

PERIOD_S = 1e-4
EQ_4 = {
    "thresholds_v": [0.095, 0.38, 0.84, 1.46, 2.21, 3.07, 4.01, 4.98, 5.96, 6.89, 7.76, 8.52, 9.14, 9.61, 9.9],
    "weights_um_per_v": [
        *(2.55, 0.57, 1.3, -1.57, 1.25, -0.054, -0.032, 0.66, 0.16, -0.77, 2.02, -1.63, -0.15, 2.99, -1.09),
    ],
}  # fmt: skip
EXACT = EQ_4 | {"dead_band": "exact", "dead_band_threshold_v": 1e-12}
EQ_20 = {
    "gain": 0.016,
    "numerator": [[1.0, 7.9e6], [1.0, 971.0, 4.6e5], [1.0, 43.0, 1.4e7]],
    "denominator": [[1.0, 8.8e4], [1.0, 974.0], [1.0, 1.0], [1.0, 1153.0, 1.6e7]],
    "method": "matched",
}
KEEP = -1
"""In `modes`: no change at this tick."""


class Signals(NamedTuple):
    """Of each tick, shape (ticks,)."""

    drive_v: npt.NDArray[np.float64]
    demand_v: npt.NDArray[np.float64]
    command_um: npt.NDArray[np.float64]
    applied_um: npt.NDArray[np.float64]
    error_um: npt.NDArray[np.float64]
    flags: npt.NDArray[np.float64]
    mode: npt.NDArray[np.float64]


@jit
def run_law(coefficients, axes, loop, modes, resets, adc_v, references, conditions, out):
    """Evaluate, update and note down each tick."""
    adc, reference = np.empty(1), np.empty(1)
    for k in range(modes.size):
        if resets[k] != 0:
            reset_trip(loop)
        if modes[k] >= 0:
            set_mode(axes, loop, modes[k], False)
        adc[0], reference[0] = adc_v[k], references[k]
        evaluate(coefficients, axes, loop, adc, reference, conditions[k])
        update(coefficients, axes, loop)
        state = axes[0]
        out[0, k], out[1, k], out[2, k] = state.drive_v, state.demand_v, state.command_um
        out[3, k], out[4, k] = state.applied_command_um, state.error_um
        out[5, k], out[6, k] = float(loop.tick_flags), float(loop.mode)


def coefficients_of(output: Channel | None = None, **parts: Any) -> Records:
    """Coefficients (1,) of an axis with eq (4), 10 µm/V and the parts given as a configuration would say them."""
    axis = AxisOptions.model_validate({"name": "x", "feedforward": EQ_4, **parts})
    controller = axis.controller
    discrete = controller and discretise(controller.transfer(), PERIOD_S, controller.method, controller.prewarp_hz)
    return axis_coefficients(axis, discrete or None, 10.0, 0.0, output or Channel("dac0"), PERIOD_S)


class LawBench:
    """A law at rest in `mode`, and its memory from one call to the next."""

    def __init__(self, coefficients: Records, mode: Mode = Mode.OFF) -> None:
        self.coefficients = coefficients
        self.axes, self.loops = initial_state(coefficients)
        set_mode(self.axes, self.loops[0], int(mode), True)

    def run(
        self,
        references: npt.ArrayLike,
        adc_v: npt.ArrayLike = 0.0,
        *,
        mode: Mode | None = None,
        modes: npt.ArrayLike | None = None,
        reset: bool = False,
        resets: npt.ArrayLike = 0,
        status: npt.ArrayLike = 0,
        age_us: npt.ArrayLike = 0.0,
        lost: npt.ArrayLike = 0,
        late_us: npt.ArrayLike = 0.0,
        enable_v: npt.ArrayLike = 0.0,
    ) -> Signals:
        """Run over `references` (ticks,); the rest may be a number for all ticks. `mode`, `reset` are for the first."""
        wanted = np.atleast_1d(np.asarray(references, float))
        changes, forgiven = _spread(KEEP if modes is None else modes, wanted, int), _spread(resets, wanted, int)
        if mode is not None:
            changes[0] = mode
        if reset:
            forgiven[0] = 1
        out = np.empty((len(Signals._fields), wanted.size))
        conditions = records(CONDITIONS, wanted.size)
        conditions["driver_status"], conditions["sample_age_us"] = status, age_us
        conditions["heartbeat_lost"], conditions["lateness_us"], conditions["enable_v"] = lost, late_us, enable_v
        adc = _spread(adc_v, wanted, float)
        run_law(self.coefficients, self.axes, self.loops[0], changes, forgiven, adc, wanted, conditions, out)
        return Signals(*out)

    def memory(self) -> dict[str, bytes]:
        """Bytes of all that the law remembers from one tick to the next, signals aside."""
        names = (
            *("inverse_plays_um", "model_plays_v", "dead_band_direction", "controller"),
            *("tap_index", "tap_history", "section_history", "bump", "applied_command_um"),
        )
        return {name: self.axes[name].tobytes() for name in names}

    def state_bytes(self) -> bytes:
        """All of the state."""
        return self.axes.tobytes() + self.loops.tobytes()


def _spread(value: npt.ArrayLike, like: npt.NDArray[Any], dtype: type) -> npt.NDArray[Any]:
    return np.broadcast_to(np.asarray(value, dtype), like.shape).copy()
