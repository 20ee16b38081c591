"""Bench that runs the compiled law of one axis over arrays of inputs."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.coefficients import axis_coefficients, make_controller
from rtloop.configuration.laws import DEFAULT_LAWS
from rtloop.drivers.base import Channel
from rtloop.foundation.native.compiled import jit
from rtloop.kernel.access import axis_state, loop_state
from rtloop.kernel.layout import CONDITIONS, Records
from rtloop.kernel.memory import LawMemory, new_records
from rtloop.kernel.step import evaluate, reset_trip, set_mode, update
from rtloop.laws.binding import bind_functions
from rtloop.laws.registry import law_layout
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
LAWS = DEFAULT_LAWS
KEEP = -1
"""Value in `modes` for a tick without a change of mode."""


class Signals(NamedTuple):
    """Signals of each tick, shape (ticks,)."""

    drive_v: npt.NDArray[np.float64]
    demand_v: npt.NDArray[np.float64]
    command_um: npt.NDArray[np.float64]
    applied_um: npt.NDArray[np.float64]
    error_um: npt.NDArray[np.float64]
    flags: npt.NDArray[np.float64]
    mode: npt.NDArray[np.float64]


@jit
def run_law(law, modes, resets, adc_v, references, feeds_um, conditions, out):
    """Evaluate and update the law in each tick; write its signals to `out`, shape (signals, ticks)."""
    adc, reference, feed = np.empty(1), np.empty(1), np.empty(1)
    for k in range(modes.size):
        if resets[k] != 0:
            reset_trip(law)
        if modes[k] >= 0:
            set_mode(law, modes[k], False)
        adc[0], reference[0], feed[0] = adc_v[k], references[k], feeds_um[k]
        evaluate(law, adc, reference, feed, conditions[k])
        update(law)
        state, loop = axis_state(law, 0), loop_state(law)
        out[0, k], out[1, k], out[2, k] = state.drive_v, state.demand_v, state.command_um
        out[3, k], out[4, k] = state.applied_command_um, state.error_um
        out[5, k], out[6, k] = float(loop.tick_flags), float(loop.mode)


def make_coefficients(output: Channel | None = None, **parts: Any) -> Records:
    """Return the coefficients (1,) of an axis with eq (4), 10 µm/V and the sections `parts` of a configuration."""
    axis = AxisOptions.model_validate({"name": "x", "feedforward": EQ_4, **parts})
    controller = make_controller(axis, PERIOD_S)
    return axis_coefficients(LAWS, axis, controller, 10.0, 0.0, output or Channel("dac0"), PERIOD_S)


class LawBench:
    """Law of one axis, at rest in `mode` at first; its memory persists from one call of `run` to the next."""

    def __init__(self, coefficients: Records, mode: Mode = Mode.OFF) -> None:
        self.law = LawMemory.create_at_rest(law_layout(LAWS), bind_functions(LAWS), coefficients)
        set_mode(self.law.law, int(mode), True)

    @property
    def coefficients(self) -> Records:
        """Coefficients of the axis; changes take effect at once."""
        return self.law.coefficients

    @property
    def axes(self) -> Records:
        """STATE record of the axis."""
        return self.law.axes

    @property
    def loops(self) -> Records:
        """LOOP_STATE record of the loop."""
        return self.law.state

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
        feed_um: npt.ArrayLike = 0.0,
    ) -> Signals:
        """Run over `references` (ticks,); other inputs may be one number. `mode` and `reset` are for the first tick."""
        samples = np.atleast_1d(np.asarray(references, float))
        changes, trip_resets = _spread(KEEP if modes is None else modes, samples, int), _spread(resets, samples, int)
        if mode is not None:
            changes[0] = mode
        if reset:
            trip_resets[0] = 1
        out = np.empty((len(Signals._fields), samples.size))
        conditions = new_records(CONDITIONS, samples.size)
        conditions["driver_status"], conditions["sample_age_us"] = status, age_us
        conditions["heartbeat_lost"], conditions["lateness_us"], conditions["enable_v"] = lost, late_us, enable_v
        adc = _spread(adc_v, samples, float)
        run_law(self.law.law, changes, trip_resets, adc, samples, _spread(feed_um, samples, float), conditions, out)
        return Signals(*out)

    def memory(self) -> dict[str, bytes]:
        """Return the bytes of each field of the law's memory by its name, without the signals of the last tick."""
        names = ("tap_index", "tap_history", "section_history", "bump", "command_bump_um", "applied_command_um")
        memory = {name: self.axes[name].tobytes() for name in names}
        for name in ("inverse_plays_um", "model_plays_v", "dead_band_direction"):
            memory[name] = np.asarray(self.law.slot_record(0, "feedforward", "state")[name]).tobytes()
        return {**memory, "controller": self.law.slot_record(0, "controller", "state").controller.tobytes()}

    def is_finite(self) -> bool:
        """Return whether all numbers of the memory are finite."""
        numbers = [memory for name, memory in self.memory().items() if name != "tap_index"]
        return bool(np.all(np.isfinite(np.frombuffer(b"".join(numbers)))))

    def state_bytes(self) -> bytes:
        """Return the bytes of the states of axis and loop."""
        return self.axes.tobytes() + self.loops.tobytes()


def _spread(value: npt.ArrayLike, like: npt.NDArray[Any], dtype: type) -> npt.NDArray[Any]:
    """Return a copy of one number or an array, in the shape of `like`."""
    return np.broadcast_to(np.asarray(value, dtype), like.shape).copy()
