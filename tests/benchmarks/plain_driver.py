"""A driver in plain Python, installed like a third party's package: the loop's process finds it by its entry point."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rtloop.drivers.base import Channel, Facts
from rtloop.drivers.python import PythonDriver

NAME = "rtloop_bench_driver"
LAG = 0.05
UM_PER_V, SENSOR_UM_PER_V = 4.0, 10.0


class LagDriver(PythonDriver):
    """A first-order lag as a card: the smallest driver in Python that can close the loop."""

    kind = "bench_lag"

    def __init__(self, *arguments) -> None:
        super().__init__(*arguments)
        self._drive_v = self._reading_v = 0.0

    @property
    def facts(self) -> Facts:
        """The driver's facts: one input and one output."""
        return Facts((Channel("in"),), (Channel("out"),), exclusive=False, real=False)

    def start(self) -> None:
        """Return at once: the driver has no device to open."""

    def read(self) -> Sequence[float]:
        """Advance the lag by one tick; return its output in V."""
        self._reading_v += LAG * (self._drive_v * UM_PER_V / SENSOR_UM_PER_V - self._reading_v)
        return (self._reading_v,)

    def write(self, volts: Sequence[float]) -> None:
        """Set the lag's input in V."""
        self._drive_v = volts[0]

    def stop(self) -> None:
        """Return at once: the driver has no device to close."""


def install(folder: Path) -> None:
    """Write this module to `folder` as a package, with metadata that declares its driver."""
    (folder / f"{NAME}.py").write_text(Path(__file__).read_text())
    metadata = folder / f"{NAME}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {NAME}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[rtloop.drivers]\n{LagDriver.kind} = {NAME}:LagDriver\n")
