"""Kind `sim`: the simulated rig in the loop's process. It advances by one period per tick, in any real time.

Plant number i lies between output `dac<i>` and input `adc<i>`. Its true position and hysteresis are observed signals.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rtloop.drivers.base import Channel, Driver, Facts, Pointers, Wiring
from rtloop.foundation.native.compiled import cfunc
from rtloop.foundation.native.pointers import SIGNATURE, address_pointer, carray
from rtloop.hil.options import ConverterOptions, RigOptions
from rtloop.hil.rig import COEFFICIENTS, STATE, advance, build_rig, sample

_COUNTS, _ADDRESSES = ("count", "looped"), ("coefficients", "state", "looped_v")
CONTEXT = np.dtype([*((name, np.uint32) for name in _COUNTS), *((name, np.int64) for name in _ADDRESSES)], align=True)
OBSERVED_PER_AXIS = 2


@cfunc(SIGNATURE)
def sim_read(context, values):
    """Fill `values`: readings in V of plants and loopback channels, age 0, then for each plant the true position and
    the displacement by hysteresis and creep, in µm.

    Draws one sample of noise for each plant whose sensor has noise. Returns 0.
    """
    rig = carray(context, 1, CONTEXT)[0]
    coefficients = carray(address_pointer(rig.coefficients), rig.count, COEFFICIENTS)
    state = carray(address_pointer(rig.state), rig.count, STATE)
    out = carray(values, rig.count * (1 + OBSERVED_PER_AXIS) + rig.looped + 1)
    loopback_v = carray(address_pointer(rig.looped_v), rig.looped, np.float64)
    for i in range(rig.looped):
        out[rig.count + i] = loopback_v[i]
    out[rig.count + rig.looped] = 0.0
    for i in range(rig.count):
        out[i] = sample(coefficients[i], state[i])
        observed = rig.count + rig.looped + 1 + i * OBSERVED_PER_AXIS
        out[observed] = state[i].true_position_um
        out[observed + 1] = state[i].hysteresis_um
    return 0


@cfunc(SIGNATURE)
def sim_write(context, values):
    """Advance the rig by one period with the outputs at `values`, in V, and return 0.

    NaN holds the last value of a plant's output; a loopback channel stores it.
    """
    rig = carray(context, 1, CONTEXT)[0]
    coefficients = carray(address_pointer(rig.coefficients), rig.count, COEFFICIENTS)
    state = carray(address_pointer(rig.state), rig.count, STATE)
    out = carray(values, rig.count + rig.looped)
    loopback_v = carray(address_pointer(rig.looped_v), rig.looped, np.float64)
    for i in range(rig.looped):
        loopback_v[i] = out[rig.count + i]
    advance(coefficients, state, out[: rig.count])
    return 0


class SimDriver(Driver):
    """The driver of the simulated rig, for any number of axes and any rate."""

    kind = "sim"
    options_model = RigOptions

    def __init__(self, options: RigOptions, wiring: Mapping[str, Wiring], rate_hz: float) -> None:
        """Build the rig, at rest at 0 V.

        Raises ValueError if an axis does not use `adc<i>` with `dac<i>`, if two axes use the same plant, and as
        `build_rig` for the options.
        """
        super().__init__(options, wiring, rate_hz)
        self._rig_options = options
        self._rig = build_rig(options, self._axes_by_plant(), 1.0 / rate_hz)
        self._context = np.zeros(1, CONTEXT)
        self._loopback_v = np.zeros(options.loopback)

    @property
    def rig(self) -> tuple[np.recarray, np.recarray]:
        """Coefficients and state of the rig, records (axes,) in the order of its channels, no copies: ticks advance the
        state.
        """
        return self._rig

    def _axes_by_plant(self) -> list[str]:
        """Return the name of the axis of each plant, in the order of the plants.

        Raises ValueError if an axis does not use `dac<i>` with `adc<i>`, or two axes use the same plant.
        """
        names: dict[int, str] = {}
        for axis, (input_name, output_name) in self.wiring.items():
            plant = next((i for i in range(len(self.wiring)) if output_name == f"dac{i}"), None)
            if plant is None or input_name != f"adc{plant}":
                raise ValueError(
                    f"channels.{axis}: input {input_name!r} with output {output_name!r}; allowed on the "
                    f"simulated rig: 'adc<i>' with 'dac<i>', i from 0 to {len(self.wiring) - 1} and equal in both"
                )
            if plant in names:
                raise ValueError(
                    f"channels.{axis}: axis {names[plant]} uses {output_name!r} already; choose another channel pair"
                )
            names[plant] = axis
        return [names[i] for i in sorted(names)]

    @property
    def facts(self) -> Facts:
        """Facts: the channel pairs of the axes, with the ranges of their converters, then those for loopback, ±10 V.

        The observed signals are true position and hysteresis of each axis, in µm.
        """
        axes = self._axes_by_plant()
        plants = [self._rig_options.plants.get(axis, self._rig_options.plant) for axis in axes]
        observed = tuple(f"{axis}_{name}" for axis in axes for name in ("true_position_um", "hysteresis_um"))
        inputs = self._channels("adc", [plant.adc for plant in plants])
        outputs = self._channels("dac", [plant.dac for plant in plants])
        return Facts(inputs, outputs, observed, exclusive=False, real=False)

    def _channels(self, prefix: str, converters: list[ConverterOptions]) -> tuple[Channel, ...]:
        """Return the channels `prefix`0, 1, …: one for each plant's converter, then those for loopback, ±10 V."""
        converters += [ConverterOptions()] * self._loopback_v.size
        return tuple(Channel(f"{prefix}{i}", each.lowest_v, each.range_v) for i, each in enumerate(converters))

    def open(self) -> Pointers:
        """Return pointers to the compiled rig, which continues from its present state."""
        coefficients, state = self._rig
        self._context["looped"], self._context["looped_v"] = self._loopback_v.size, self._loopback_v.ctypes.data
        self._context["count"] = coefficients.size
        self._context["coefficients"], self._context["state"] = coefficients.ctypes.data, state.ctypes.data
        return Pointers(self._context.ctypes.data, sim_read.address, sim_write.address)

    def outputs_v(self) -> list[float]:
        """Return the volts at the DAC of each plant, after quantisation, and then at each loopback output."""
        return [*self._rig[1]["dac_v"].tolist(), *self._loopback_v.tolist()]

    def close(self) -> None:
        """Set the outputs to 0 V; the rig does not advance, and can be opened again."""
        self._rig[1]["dac_v"] = 0.0
        self._loopback_v[:] = 0.0
