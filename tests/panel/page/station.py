"""Stations, each a service with its panel and a window: the tests of a file share one until a test fails."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tests.faults.bench import Bench
from tests.panel.page.browser import open_panel, start_panel

CHANGES = ("[recording]", "[service]\narm = true\n[recording]")


class Station:
    """A service whose loop is not armed, its panel, and a window with the page, which loads slowly and only once."""

    def __init__(self, folder: Path, browser: Any) -> None:
        self._ending = ExitStack()
        with ExitStack() as ending:
            self.bench = ending.enter_context(Bench(folder, CHANGES))
            self.address = start_panel(self.bench)[0]
            self.window = open_panel(browser, self.address)
            ending.callback(self.window.context.close)
            self._ending = ending.pop_all()

    def close(self) -> None:
        """Close the window and end the panel and the service."""
        self._ending.close()


class Stations:
    """The stations of a test file, one at a time, which `start` makes when a test needs one."""

    def __init__(self, start: Callable[[], Any]) -> None:
        self._start = start
        self._current: Any = None

    def current(self) -> Any:
        """Return the station of the tests before, or a new one if there is none."""
        if self._current is None:
            self._current = self._start()
        return self._current

    def discard(self) -> None:
        """End the current station, so that the next test starts a new one."""
        if self._current is not None:
            station, self._current = self._current, None
            station.close()
