"""A laboratory's card in plain Python, with the simulated rig as its plant: each write moves the rig by one period."""

from __future__ import annotations

import numpy as np

from rtloop.drivers.base import Channel, Facts, Wiring
from rtloop.drivers.python import PythonDriver
from rtloop.hil.options import RigOptions
from rtloop.hil.rig import advance, build_rig, sample


class BenchCard(PythonDriver):
    """The card's driver: one input, one output, and the plant's true position as an observed signal."""

    kind = "bench_card"
    options_model = RigOptions
    example = Wiring("in", "out")

    @property
    def facts(self) -> Facts:
        return Facts((Channel("in"),), (Channel("out"),), observed=("x_true_position_um",), max_rate_hz=20_000.0)

    def start(self) -> None:
        self.coefficients, self.state = build_rig(self.options, ["x"], 1.0 / self.rate_hz)

    def read(self) -> list[float]:
        return [sample(self.coefficients[0], self.state[0])]

    def observe(self) -> list[float]:
        return [self.state[0].true_position_um]

    def write(self, volts: list[float]) -> None:
        advance(self.coefficients, self.state, np.array(volts))

    def stop(self) -> None:
        pass
