"""The card of a world, which outlives its loops: simulated axes, whose faults are set from outside."""

from __future__ import annotations

from collections.abc import Sequence

from rtloop.drivers.base import Channel, Facts, Wiring
from rtloop.drivers.python import PythonDriver


class Board:
    """Card with two axes, each with a lag; `volts` are its outputs. Faults are set from outside."""

    def __init__(self, um_per_v: Sequence[float], lag: float) -> None:
        self.um_per_v, self._lag = um_per_v, lag
        self.volts, self.position_um = [0.0] * len(um_per_v), [0.0] * len(um_per_v)
        self.age_us = 0.0
        self.jump_um, self.replacement_v = 0.0, None
        self.refuses_read = self.refuses_write = self.is_gone = False
        self.written: list[tuple[float, ...]] = []

    def read(self) -> list[float]:
        if self.refuses_read:
            raise OSError("the card does not answer")
        for axis, gain in enumerate(self.um_per_v):
            self.position_um[axis] += self._lag * (gain * self.volts[axis] - self.position_um[axis])
        values = [(position + self.jump_um) / 10.0 for position in self.position_um]
        if self.replacement_v is not None:
            values[-1] = self.replacement_v
        return values

    def write(self, volts: Sequence[float]) -> None:
        if self.refuses_write:
            raise OSError("the card refuses the write")
        self.volts = [*volts]
        self.written.append(tuple(volts))


class BoardDriver(PythonDriver):
    """Driver of a board."""

    kind = "board"

    def __init__(self, board: Board) -> None:
        axes = "xy"[: len(board.volts)]
        wiring = {axis: Wiring(f"adc{i}", f"dac{i}") for i, axis in enumerate(axes)}
        super().__init__(self.options_model(), wiring, 1000.0)
        self._board = board

    @property
    def facts(self) -> Facts:
        count = range(len(self._board.volts))
        return Facts(tuple(Channel(f"adc{i}") for i in count), tuple(Channel(f"dac{i}") for i in count), (), real=False)

    def start(self) -> None:
        if self._board.is_gone:
            raise OSError("the card is not there")

    def stop(self) -> None:
        """Do nothing: the board stays."""

    def outputs_v(self) -> list[float]:
        return [*self._board.volts]

    def read(self) -> Sequence[float]:
        self.sample_age_us = self._board.age_us
        return self._board.read()

    def write(self, volts: Sequence[float]) -> None:
        self._board.write(volts)
