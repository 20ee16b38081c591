"""Driver in plain Python with scripted readings and failures."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rtloop.drivers.base import Channel, Facts, Wiring
from rtloop.drivers.python import PythonDriver


class ScriptedDriver(PythonDriver):
    """Driver that returns `volts(k)` V at read number k, from 0, and stores accepted writes (V) in `written`.

    Each write first calls `refuse` with the number of accepted writes. Either function may raise an exception.
    """

    kind = "scripted"

    def __init__(self, volts: Callable[[int], float], refuse: Callable[[int], None] = lambda k: None) -> None:
        super().__init__(self.options_model(), {"x": Wiring("adc0", "dac0")}, 10_000)
        self.volts, self.refuse, self.reads = volts, refuse, 0
        self.written: list[float] = []

    @property
    def facts(self) -> Facts:
        return Facts((Channel("adc0"),), (Channel("dac0"),), ("x_true_position_um", "x_hysteresis_um"), real=False)

    def start(self) -> None:
        """Do nothing: a scripted driver has no resource to open."""

    def stop(self) -> None:
        """Do nothing: a scripted driver has no resource to close."""

    def read(self) -> Sequence[float]:
        self.reads += 1
        return (self.volts(self.reads - 1),)

    def observe(self) -> Sequence[float]:
        return 1.5, 2.5

    def write(self, volts: Sequence[float]) -> None:
        self.refuse(len(self.written))
        self.written.append(volts[0])
