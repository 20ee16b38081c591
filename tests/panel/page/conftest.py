"""One service, one panel and one browser for the tests of this folder, which is a package so that they end with it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.faults.bench import Bench
from tests.panel.page.browser import HEIGHT, WIDTH, chromium, launched, opened, panel_of, said


@pytest.fixture(scope="package")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """A service whose outputs are off until it is armed."""
    chromium()
    changes = ("[recording]", "[service]\narm = true\n[recording]")
    with Bench(tmp_path_factory.mktemp("page"), changes) as bench:
        yield bench


@pytest.fixture(scope="package")
def address(bench: Bench) -> str:
    """Of its panel."""
    return panel_of(bench)[0]


@pytest.fixture(scope="package")
def browser() -> Iterator[Any]:
    """Of these tests alone: Playwright has an event loop of its own."""
    with launched() as browser:
        yield browser


@pytest.fixture(scope="package")
def window(browser: Any, address: str) -> Iterator[Any]:
    """The panel, opened once: loading it takes longer than most that is done with it."""
    page = opened(browser, address)
    yield page
    page.context.close()


@pytest.fixture
def shown(window: Any) -> Iterator[Any]:
    """The panel as it is after it was opened, whatever was looked at before; no error was seen in it at its end."""
    window.set_viewport_size({"width": WIDTH, "height": HEIGHT})
    window.emulate_media(color_scheme="dark", reduced_motion="no-preference")
    window.evaluate("scrollTo(0, 0)")
    for key in ("Escape", "Escape", "1"):  # a list or the help, then the field
        window.keyboard.press(key)
    if window.get_attribute("#cursors", "aria-pressed") == "true":
        window.keyboard.press("m")
    yield window
    faults, window.faults = window.faults, []
    assert not faults


@pytest.fixture
def page(shown: Any, bench: Bench) -> Iterator[Any]:
    """The panel, outputs off."""
    off(bench)
    said(shown, "#state-word", "stopped")
    yield shown
    off(bench)


def off(bench: Bench) -> None:
    """Stop it."""
    bench.client.post("/stop")
    bench.await_state("stopped")
