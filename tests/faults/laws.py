"""Fault of a user's law: its step does not return from the tick of a certain setpoint."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rtloop.errors import RtloopError
from tests.faults.bench import Bench
from tests.faults.configuration import CONTROLLER
from tests.faults.fault import Fault, Outcome
from tests.faults.processes import STOPPED_SAFE_MS
from tests.laws.failing import ENDLESS, ENDLESS_UM

NAME = "endless.py"
WITH_ENDLESS_LAW = ((CONTROLLER, f'[axis.controller]\nfile = "{NAME}"\n'),)


@contextmanager
def endless_law_file(folder: Path) -> Iterator[None]:
    """Write the law's file into `folder`, where the configuration will be."""
    (folder / NAME).write_text(ENDLESS)
    yield


def never_ends(bench: Bench) -> Outcome:
    """Set the setpoint at which the law never returns; the next loop starts without this setpoint."""
    loop = bench.pid("rt")

    def post_setpoint() -> None:
        with suppress(RtloopError):  # the request may stay unanswered: the loop that received it stands still
            bench.client.post("/setpoint", {"axis": "x", "value": ENDLESS_UM + 1.0})

    bench.strike(post_setpoint)
    took_ms = bench.await_safe(STOPPED_SAFE_MS, by_request=True)
    bench.await_restart()
    assert bench.await_state("tripped")["faults"]
    assert bench.pid("rt") != loop
    assert "stood still and was killed" in bench.log()
    bench.recover()
    return Outcome(took_ms)


FAULTS = (
    Fault("law never ends", "loop killed, parked, another loop", never_ends, changes=WITH_ENDLESS_LAW,
          around=endless_law_file),
)  # fmt: skip
