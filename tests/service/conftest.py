"""Fixtures: a real service on a simulated board, with its control API, shared by the tests of a module."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.faults.bench import Bench


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Yield a service that is disarmed at first, for all tests of a module; each test leaves its state `stopped`."""
    changes = ("[recording]", "[service]\narm = true\n[recording]")
    with Bench(tmp_path_factory.mktemp("api"), changes) as bench:
        yield bench


@pytest.fixture
def running(bench: Bench) -> Iterator[Bench]:
    """Yield the service armed and in closed loop, and stop it afterwards."""
    bench.client.post("/arm")
    bench.client.post("/start")
    bench.await_drive()
    yield bench
    bench.client.post("/stop")
    bench.await_state("stopped")
