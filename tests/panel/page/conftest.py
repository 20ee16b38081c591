"""A station for each test file, and a new one after each failed test, so that no test makes others fail.

All stations have windows of one browser; this folder is a package so that the browser ends with its tests.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.faults.bench import Bench
from tests.panel.page.browser import HEIGHT, WIDTH, await_text, chromium_path, launch_browser
from tests.panel.page.parts import open_parts_page
from tests.panel.page.station import Station, Stations

FAILED = pytest.StashKey[bool]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Store in a test whether it has failed, for the fixtures that end after it."""
    report = yield
    item.stash[FAILED] = item.stash.get(FAILED, False) or report.failed
    return report


@pytest.fixture(scope="package")
def browser() -> Iterator[Any]:
    """Yield the browser of the tests in this folder; Playwright's event loop ends with it."""
    with launch_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def parts_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the files that the page of `parts` loads."""
    return tmp_path_factory.mktemp("parts")


@pytest.fixture(scope="module")
def parts(browser: Any, parts_folder: Path) -> Iterator[Any]:
    """Yield a page with the panel's elements and modules, but without a service."""
    with open_parts_page(browser, parts_folder) as page:
        yield page


@pytest.fixture(scope="module")
def stations(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stations]:
    """Yield the stations of a test file, of which one exists at a time."""
    chromium_path()
    stations = Stations(lambda: Station(tmp_path_factory.mktemp("page"), browser))
    yield stations
    stations.discard()


@pytest.fixture
def station(stations: Stations, request: pytest.FixtureRequest) -> Iterator[Station]:
    """Yield a station in which no test has failed yet."""
    yield stations.current()
    if request.node.stash[FAILED]:
        stations.discard()


@pytest.fixture
def bench(station: Station) -> Bench:
    """Return the bench of the station's service."""
    return station.bench


@pytest.fixture
def address(station: Station) -> str:
    """Return the address of the station's panel, with its token."""
    return station.address


@pytest.fixture
def window(station: Station) -> Iterator[Any]:
    """Yield the station's window, reset to the state after opening; fail if the page had an error during the test."""
    window = station.window
    window.set_viewport_size({"width": WIDTH, "height": HEIGHT})
    window.emulate_media(color_scheme="dark", reduced_motion="no-preference")
    window.evaluate("scrollTo(0, 0)")
    for key in ("Escape", "Escape", "1"):  # Close a list or the help, leave the field, show the first view.
        window.keyboard.press(key)
    if window.get_attribute("#cursors", "aria-pressed") == "true":
        window.keyboard.press("m")
    yield window
    faults, window.faults = window.faults, []
    assert not faults


@pytest.fixture
def page(window: Any, bench: Bench) -> Iterator[Any]:
    """Yield the station's window, reset, with the loop stopped and the outputs off."""
    stop_loop(bench)
    await_text(window, "#state-word", "stopped")
    yield window
    stop_loop(bench)


def stop_loop(bench: Bench) -> None:
    """Stop the loop of a service, which switches the outputs off."""
    bench.client.post("/stop")
    bench.await_state("stopped")
