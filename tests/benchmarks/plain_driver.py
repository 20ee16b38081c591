"""A driver in plain Python, as a third party's package that the loop's process finds by its entry point."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rtloop.drivers.base import Channel, Facts
from rtloop.drivers.python import PythonDriver

NAME = "rtloop_bench_driver"
LAG = 0.05
UM_PER_V, SENSOR_UM_PER_V = 4.0, 10.0


class LagDriver(PythonDriver):
    """A first-order lag: the least that a card in Python can be and still close the loop."""

    kind = "bench_lag"

    def __init__(self, *arguments) -> None:
        super().__init__(*arguments)
        self._drive_v = self._reading_v = 0.0

    @property
    def facts(self) -> Facts:
        """One channel each way."""
        return Facts((Channel("in"),), (Channel("out"),), exclusive=False, real=False)

    def start(self) -> None:
        """Nothing to take."""

    def read(self) -> Sequence[float]:
        """The lag's output."""
        self._reading_v += LAG * (self._drive_v * UM_PER_V / SENSOR_UM_PER_V - self._reading_v)
        return (self._reading_v,)

    def write(self, volts: Sequence[float]) -> None:
        """The lag's input."""
        self._drive_v = volts[0]

    def stop(self) -> None:
        """Nothing to let go."""


def install(folder: Path) -> None:
    """This module as a package in `folder`, with the metadata that declares its driver."""
    (folder / f"{NAME}.py").write_text(Path(__file__).read_text())
    metadata = folder / f"{NAME}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {NAME}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[rtloop.drivers]\n{LagDriver.kind} = {NAME}:LagDriver\n")
