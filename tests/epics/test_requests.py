"""Requests of EPICS clients are executed in order; the table of channels reads a status. Neither needs caproto."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtloop.epics.requests import MAX_PENDING, Requests
from rtloop.epics.variables import LOOP_VARIABLES, axis_variables, unit_in_mode
from rtloop.errors import LoopFault
from tests.command_line import run

TABLE = {variable.suffix: variable for variable in (*LOOP_VARIABLES, *axis_variables("x"))}
STATUS: dict[str, Any] = {"state": "stopped", "armed": False, "faults": []}
TRIPPED = {
    **STATUS,
    "state": "tripped",
    "faults": ["the loop died"],
    "trip": ["position"],
    "trip_reason": "position 61 µm",
}


@pytest.fixture
def requests() -> Iterator[Requests]:
    """Yield an empty queue of requests, closed at the end."""
    requests = Requests()
    yield requests
    requests.close()


def test_a_stop_waits_for_no_request_and_withdraws_those_that_wait(requests: Requests):
    """The first request blocks; two more wait behind it when the stop comes, and a last one comes after the stop."""
    order: list[str] = []
    release, began = threading.Event(), threading.Event()

    def wait_for_release() -> None:
        began.set()
        release.wait()
        order.append("first")

    async def write() -> list[Any]:
        first = asyncio.create_task(requests.execute(wait_for_release))
        waiting = [asyncio.create_task(requests.execute(lambda: order.append("withdrawn"))) for _ in range(2)]
        await asyncio.to_thread(began.wait)
        await requests.stop(lambda: order.append("stop"))
        last = asyncio.create_task(requests.execute(lambda: order.append("last")))
        release.set()
        return await asyncio.gather(first, *waiting, last, return_exceptions=True)

    first, *withdrawn, last = asyncio.run(write())
    assert order == ["stop", "first", "last"]
    assert [type(outcome) for outcome in (first, *withdrawn, last)] == [type(None), LoopFault, LoopFault, type(None)]


def test_requests_beyond_the_limit_are_refused_until_others_end(requests: Requests):
    release = threading.Event()
    executed: list[int] = []

    async def write() -> list[Any]:
        tasks = [asyncio.create_task(requests.execute(release.wait))]
        tasks += [asyncio.create_task(requests.execute(lambda: executed.append(0))) for _ in range(MAX_PENDING)]
        await asyncio.sleep(0)
        release.set()
        outcomes = await asyncio.gather(*tasks, return_exceptions=True)
        await requests.execute(lambda: executed.append(1))
        return outcomes

    outcomes = asyncio.run(write())
    assert [isinstance(outcome, LoopFault) for outcome in outcomes] == [False] * MAX_PENDING + [True]
    assert executed == [0] * (MAX_PENDING - 1) + [1]


def test_a_service_without_a_loop_leaves_values_unknown():
    unknown = {suffix for suffix, variable in TABLE.items() if variable.read(STATUS) is None}
    assert unknown == {"MODE", "TICK", "RATE", "LATE_TICKS"} | {suffix for suffix in TABLE if suffix.startswith("x:")}


def test_the_cause_has_the_trip_and_the_latched_faults():
    read_cause = TABLE["CAUSE"].read
    assert read_cause(TRIPPED) == "position 61 µm; the loop died"
    assert read_cause(TRIPPED | {"trip_reason": None}) == "position; the loop died"
    assert read_cause(TRIPPED | {"faults": ["position 61 µm"]}) == "position 61 µm"
    assert read_cause(STATUS) == ""


def test_only_the_reference_changes_its_unit_in_mode_raw():
    changed = {suffix for suffix, variable in TABLE.items() if unit_in_mode(variable, "raw") != variable.unit}
    assert changed == {"x:REFERENCE", "x:SETPOINT"}
    assert {unit_in_mode(TABLE[suffix], "closed_loop") for suffix in changed} == {"um"}


def test_without_caproto_the_command_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    for module in ("rtloop.epics.server", "rtloop.epics.channels"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    for module in [name for name in sys.modules if name.partition(".")[0] == "caproto"]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "caproto", None)
    result = run("epics", "--socket", tmp_path / "x.sock")
    assert result.exit_code == 78
    assert "pip install 'rtloop[epics]'" in result.output
