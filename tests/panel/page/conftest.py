"""A station for each file of this folder, and another one after each test that failed: no test can fail others.

One browser, in which each station has a window of its own; the folder is a package so that the browser ends with it.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.faults.bench import Bench
from tests.panel.page.browser import HEIGHT, WIDTH, chromium, launched, said
from tests.panel.page.parts import page_of_parts
from tests.panel.page.station import Station, Stations

FAILED = pytest.StashKey[bool]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Note in a test that it failed, for the fixtures that end after it."""
    report = yield
    item.stash[FAILED] = item.stash.get(FAILED, False) or report.failed
    return report


@pytest.fixture(scope="package")
def browser() -> Iterator[Any]:
    """Of these tests alone: Playwright has an event loop of its own."""
    with launched() as browser:
        yield browser


@pytest.fixture(scope="module")
def parts_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files behind the page of parts."""
    return tmp_path_factory.mktemp("parts")


@pytest.fixture(scope="module")
def parts(browser: Any, parts_folder: Path) -> Iterator[Any]:
    """The page's elements and its parts, with no service behind them."""
    with page_of_parts(browser, parts_folder) as page:
        yield page


@pytest.fixture(scope="module")
def stations(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stations]:
    """Those of a file, one after the other."""
    chromium()
    stations = Stations(lambda: Station(tmp_path_factory.mktemp("page"), browser))
    yield stations
    stations.discard()


@pytest.fixture
def station(stations: Stations, request: pytest.FixtureRequest) -> Iterator[Station]:
    """A station in which no test has failed."""
    yield stations.present()
    if request.node.stash[FAILED]:
        stations.discard()


@pytest.fixture
def bench(station: Station) -> Bench:
    """Its service."""
    return station.bench


@pytest.fixture
def address(station: Station) -> str:
    """Of its panel."""
    return station.address


@pytest.fixture
def shown(station: Station) -> Iterator[Any]:
    """The panel as it is after it was opened, whatever was looked at before; no error was seen in it at its end."""
    window = station.window
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
