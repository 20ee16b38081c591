"""A service with its control API, for the tests of a module."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.faults.bench import Bench


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """One service for all tests, outputs off until it is armed; each test leaves it stopped."""
    changes = ("[recording]", "[service]\narm = true\n[recording]")
    with Bench(tmp_path_factory.mktemp("api"), changes) as bench:
        yield bench


@pytest.fixture
def running(bench: Bench) -> Iterator[Bench]:
    """In closed loop."""
    bench.client.post("/arm")
    bench.client.post("/start")
    bench.await_drive()
    yield bench
    bench.client.post("/stop")
    bench.await_state("stopped")
