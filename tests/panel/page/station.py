"""A service, its panel and its page, for the tests of one file: a failed test leaves none of them to the next."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tests.faults.bench import Bench
from tests.panel.page.browser import opened, panel_of

CHANGES = ("[recording]", "[service]\narm = true\n[recording]")


class Station:
    """A service whose outputs are off until it is armed, its panel, and a window with the page, opened once: loading it
    takes longer than most that is done with it.
    """

    def __init__(self, folder: Path, browser: Any) -> None:
        self._ending = ExitStack()
        with ExitStack() as ending:
            self.bench = ending.enter_context(Bench(folder, CHANGES))
            self.address = panel_of(self.bench)[0]
            self.window = opened(browser, self.address)
            ending.callback(self.window.context.close)
            self._ending = ending.pop_all()

    def close(self) -> None:
        """End all of it."""
        self._ending.close()


class Stations:
    """The station that the tests of a file share as long as they pass; `start` makes another one."""

    def __init__(self, start: Callable[[], Any]) -> None:
        self._start = start
        self._present: Any = None

    def present(self) -> Any:
        """The station of the tests before, or a new one."""
        if self._present is None:
            self._present = self._start()
        return self._present

    def discard(self) -> None:
        """End the present one: the next test starts another."""
        if self._present is not None:
            station, self._present = self._present, None
            station.close()
