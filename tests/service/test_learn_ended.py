"""A client that learns on a real service, and is killed or goes: the held reference comes back."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.service.http import answer
from tests.service.test_learn import LONG_CYCLES, MODEL, REQUEST, SCAN_UM, TICKS
from tests.service.test_response import CONFIGURATION, SETPOINT_UM

pytestmark = pytest.mark.system

JUDGED_TICKS = 5000
RETURN_S = 10.0


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Yield a running service whose axis has a model."""
    folder = tmp_path_factory.mktemp("learn")
    text = CONFIGURATION.replace("[axis.interlocks]", MODEL + "[axis.interlocks]")
    with Bench(folder, board=False, text=text.replace("FOLDER", str(folder))) as bench:
        bench.await_state("running")
        yield bench


def hold_setpoint(bench: Bench) -> None:
    """Set the reference to the constant SETPOINT_UM."""
    bench.client.post("/setpoint", {"axis": "x", "value": SETPOINT_UM})


def reference_um(bench: Bench) -> float:
    """Return the present reference (µm) of axis x."""
    return bench.client.get("/status")["axes"]["x"]["reference_um"]


def assert_reference_returns(bench: Bench) -> None:
    """Check that the reference returns to SETPOINT_UM within RETURN_S and stays, and that the measurement has ended."""
    wait_for(lambda: reference_um(bench) == SETPOINT_UM, "the held reference", RETURN_S)
    references_um, end = set[float](), bench.ticks + 4 * TICKS
    while bench.ticks < end:
        references_um.add(reference_um(bench))
    assert references_um == {SETPOINT_UM}
    too_long = REQUEST | {"samples": [5.0] * 100_000, "cycles": 50}
    wait_for(lambda: answer(bench, "POST", "/learn", too_long)[0] == 422, "the end of the measurement", RETURN_S)


def await_tables(bench: Bench) -> None:
    """Wait until a table is played, and then until JUDGED_TICKS ticks have passed."""
    wait_for(lambda: reference_um(bench) != SETPOINT_UM, "a table that is played")
    tick = bench.ticks
    wait_for(lambda: bench.ticks > tick + JUDGED_TICKS, "tables that were judged")


def kill_client(bench: Bench, tmp_path: Path, number: int) -> str:
    """Start a client process that learns, send it signal `number` while tables are tried, and return its stderr."""
    (tmp_path / "scan.csv").write_text("\n".join(map(repr, SCAN_UM.tolist())))
    options = ["ctl", "--socket", bench.client.path, "learn", "x", tmp_path / "scan.csv", "--cycles", str(LONG_CYCLES)]
    command = [sys.executable, "-m", "rtloop", *map(str, options)]
    with subprocess.Popen(command, env=bench.environment, stderr=subprocess.PIPE, text=True) as client:
        try:
            await_tables(bench)
            client.send_signal(number)
            return client.communicate(timeout=60)[1]
        finally:
            client.kill()


ENDINGS: dict[str, Callable[[Bench, Path], object]] = {
    "SIGKILL": lambda bench, folder: kill_client(bench, folder, signal.SIGKILL),
    "Ctrl-C": lambda bench, folder: kill_client(bench, folder, signal.SIGINT),
}


@pytest.mark.parametrize("ending", ENDINGS)
def test_learning_ends_with_its_client_and_the_held_reference_comes_back(running: Bench, tmp_path: Path, ending: str):
    hold_setpoint(running)
    ENDINGS[ending](running, tmp_path)
    assert_reference_returns(running)
