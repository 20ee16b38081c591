"""A fault of a law that somebody wrote: in the tick that meets it nothing comes back to the loop."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rtloop.errors import RtloopError
from tests.faults.bench import Bench
from tests.faults.configuration import CONTROLLER
from tests.faults.fault import Fault, Measured
from tests.faults.processes import STOPPED_SAFE_MS
from tests.laws.failing import ENDLESS, ENDLESS_UM

NAME = "endless.py"
WITH_IT = ((CONTROLLER, f'[axis.controller]\nfile = "{NAME}"\n'),)


@contextmanager
def beside_the_configuration(folder: Path) -> Iterator[None]:
    """The law's file."""
    (folder / NAME).write_text(ENDLESS)
    yield


def never_ends(bench: Bench) -> Measured:
    """A setpoint from which on its output runs for ever; another loop begins without that setpoint."""
    loop = bench.pid("rt")

    def ask() -> None:
        with suppress(RtloopError):  # nobody may come to answer: the loop has taken it and stands still
            bench.client.post("/setpoint", {"axis": "x", "value": ENDLESS_UM + 1.0})

    bench.strike(ask)
    took_ms = bench.await_safe(STOPPED_SAFE_MS, by_request=True)
    bench.await_restart()
    assert bench.await_state("tripped")["faults"]
    assert bench.pid("rt") != loop
    assert "stood still and was killed" in bench.log()
    bench.recover()
    return Measured(took_ms)


FAULTS = (
    Fault("law never ends", "loop killed, parked, another loop", never_ends, changes=WITH_IT,
          around=beside_the_configuration),
)  # fmt: skip
