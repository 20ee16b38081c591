"""Memory of a board without the board's process: a test reads it after parking, with all writes in their order."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from rtloop.hil import board
from rtloop.hil.board import FIFO, LSB_V, BoardMemory


class FakeBoard:
    """Memory of a board in the file `path`, with `channels` outputs that start at `volts`."""

    def __init__(self, path: Path, volts: float, channels: int = 1) -> None:
        self.channels, self.start_v = channels, volts
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        os.ftruncate(fd, board.file_bytes())
        self._memory = BoardMemory(fd)
        os.close(fd)
        facts = self._memory.facts
        facts["version"], facts["channels"], facts["rate_hz"] = board.VERSION, channels, 8000.0
        set_first_outputs(self._memory, [round(volts / LSB_V)] * channels)
        facts["magic"] = board.MAGIC

    @property
    def outputs_v(self) -> list[float]:
        """Present output voltages (V), one for each channel."""
        return (self._memory.dac_codes[: self.channels] * LSB_V).tolist()

    @property
    def path_v(self) -> np.ndarray:
        """Voltages (V) of the first output: the start voltage, then one for each later write."""
        count = int(self._memory.words[board.WRITTEN])
        assert count < FIFO, "more writes than the FIFO stores"
        return np.array([self.start_v, *self._memory.fifo.codes[1:count, 0] * LSB_V])


def set_first_outputs(memory: BoardMemory, codes: list[int]) -> None:
    """Set the outputs of a fresh board memory to the DAC codes `codes`, as its first write."""
    memory.fifo.codes[0, : len(codes)] = codes
    memory.words[board.WRITTEN] = 1
