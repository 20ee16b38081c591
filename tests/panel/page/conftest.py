"""One service, one panel and one browser for the tests of a module."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.faults.bench import Bench
from tests.panel.page.browser import chromium, launched, opened, panel_of


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """A service whose outputs are off until it is armed."""
    chromium()
    changes = ("[recording]", "[service]\narm = true\n[recording]")
    with Bench(tmp_path_factory.mktemp("page"), changes) as bench:
        yield bench


@pytest.fixture(scope="module")
def address(bench: Bench) -> str:
    """Of its panel."""
    return panel_of(bench)[0]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Of this module alone: Playwright has an event loop of its own."""
    with launched() as browser:
        yield browser


@pytest.fixture
def page(browser: Any, address: str, bench: Bench) -> Iterator[Any]:
    """The panel, outputs off; no error was seen in it at its end."""
    bench.client.post("/stop")
    bench.await_state("stopped")
    page = opened(browser, address)
    yield page
    faults = page.faults
    page.context.close()
    bench.client.post("/stop")
    bench.await_state("stopped")
    assert not faults
