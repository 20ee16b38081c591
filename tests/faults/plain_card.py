"""A third party's driver in plain Python, and its card: a small file that outlives every process.

The card holds the last voltage written, a record of its output, and the fault that a test has set. This module is
copied into a separate package, where its entry point declares it.
"""

from __future__ import annotations

import time

import numpy as np

from rtloop.drivers.base import Channel, Facts
from rtloop.drivers.python import PythonDriver
from rtloop.foundation.options import Options

NONE, NAN, RAISE_IN_READ, RAISE_IN_WRITE, BLOCK_50_MS, BLOCK, ENABLE_OPEN = range(7)
LEVELS, WINDOW_NS = 64, 1_000_000
RESOLUTION_V = 1e-9
MEMORY = np.dtype(
    [("fault", np.int64), ("position_um", np.float64), ("last_v", np.float64), ("lowest_v", np.float64),
     ("highest_v", np.float64), ("largest_step_v", np.float64), ("largest_window_v", np.float64),
     ("moved_ns", np.int64), ("levels", np.int64), ("level_v", np.float64, LEVELS), ("level_ns", np.int64, LEVELS)]
)  # fmt: skip
"""`level_v` and `level_ns` are the last voltages of the output and their times; number i stands at i modulo LEVELS."""
UM_PER_V, LAG = 4.3, 0.1


class CardOptions(Options):
    file: str


class PlainCard(PythonDriver):
    """A driver of the card in a file: a first-order plant, an enable input, and the faults that a test sets."""

    kind = "plain_card"
    options_model = CardOptions

    @property
    def facts(self) -> Facts:
        return Facts((Channel("in"), Channel("enable")), (Channel("out"),), max_rate_hz=2000.0)

    def start(self) -> None:
        self.memory = np.memmap(self.options.file, MEMORY, "r+", shape=(1,))[0]

    def outputs_v(self) -> list[float]:
        return [float(self.memory["last_v"])]

    def read(self) -> tuple[float, float]:
        memory, fault = self.memory, int(self.memory["fault"])
        memory["position_um"] += LAG * (UM_PER_V * memory["last_v"] - memory["position_um"])
        if fault in (NAN, RAISE_IN_READ, BLOCK_50_MS):
            memory["fault"] = NONE  # these faults happen once
        if fault == RAISE_IN_READ:
            raise OSError("the card does not answer")
        if fault == BLOCK_50_MS:
            time.sleep(0.05)
        if fault == BLOCK:
            time.sleep(3600.0)
        volts = float("nan") if fault == NAN else float(memory["position_um"]) / 10.0
        return volts, 0.0 if fault == ENABLE_OPEN else 5.0

    def write(self, volts: list[float]) -> None:
        memory = self.memory
        if memory["fault"] == RAISE_IN_WRITE:
            memory["fault"] = NONE
            raise OSError("the card refuses")
        if volts[0] == memory["last_v"]:
            return
        memory["moved_ns"] = time.monotonic_ns()
        self._record_level(volts[0], int(memory["moved_ns"]))
        memory["lowest_v"] = min(memory["lowest_v"], volts[0])
        memory["highest_v"] = max(memory["highest_v"], volts[0])
        memory["last_v"] = volts[0]

    def _record_level(self, volts: float, now_ns: int) -> None:
        """Update the largest step, and the largest change from a level of the last millisecond, with a new level."""
        memory, newest = self.memory, int(self.memory["levels"])
        memory["largest_step_v"] = max(memory["largest_step_v"], abs(volts - memory["last_v"]))
        for i in range(newest, max(newest - LEVELS, -1), -1):
            memory["largest_window_v"] = max(memory["largest_window_v"], abs(volts - memory["level_v"][i % LEVELS]))
            if now_ns - memory["level_ns"][i % LEVELS] > WINDOW_NS:
                break
        memory["levels"] = newest + 1
        memory["level_v"][(newest + 1) % LEVELS], memory["level_ns"][(newest + 1) % LEVELS] = volts, now_ns

    def stop(self) -> None:
        pass


def install(folder) -> None:
    """Write this driver and its entry point into `folder` as an installed package, and an empty card."""
    from pathlib import Path

    (folder / "plain_card.py").write_text(Path(__file__).read_text())
    metadata = folder / "plain_card-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: plain-card\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[rtloop.drivers]\nplain_card = plain_card:PlainCard\n")
    (folder / "card").write_bytes(bytes(MEMORY.itemsize))
