"""Fixtures: a service that the tests of a module share, as real processes on a simulated board or in virtual time."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.faults.bench import Bench
from tests.faults.configuration import on_a_rig
from tests.virtual.bench import VirtualBench


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


@pytest.fixture(scope="module")
def virtual_bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VirtualBench]:
    """Yield a service as `bench`, on the simulated rig in virtual time."""
    folder = tmp_path_factory.mktemp("virtual")
    text = on_a_rig(folder, ("[recording]", "[service]\narm = true\n[recording]"))
    with pytest.MonkeyPatch.context() as patch:
        bench = VirtualBench(folder, patch, text)
        bench.await_state("stopped")
        yield bench
        bench.end()


@pytest.fixture
def virtual(virtual_bench: VirtualBench) -> Iterator[VirtualBench]:
    """Yield the virtual service armed and in closed loop, and stop it afterwards."""
    virtual_bench.client.post("/arm")
    virtual_bench.client.post("/start")
    virtual_bench.await_drive()
    yield virtual_bench
    virtual_bench.client.post("/stop")
    virtual_bench.await_state("stopped")
