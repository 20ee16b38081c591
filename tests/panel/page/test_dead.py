"""The page after the death of loop, service and panel, and after the return of the service."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from rtloop.hil import board
from tests.faults.bench import Bench
from tests.panel.page.browser import chromium, opened, panel_of, running, said, stopped

DESK = ("#go", "#set-mode button", "#setpoint", "#tune-value", "#undo")

GREYS = """(at) => {
  let count = 0;
  for (let e = document.querySelector(at); e; e = e.parentElement)
    if (getComputedStyle(e).filter.includes("grayscale")) count++;
  return count}"""
"""How many times an element is made grey: twice is too faint to read."""


@pytest.fixture
def doomed(tmp_path: Any) -> Iterator[Bench]:
    """Whose loop ends by itself a second after its service died."""
    chromium()
    changes = (
        ("[recording]", "[service]\narm = true\n[recording]"),
        ("[loop]\n", "[loop]\nheartbeat_timeout_s = 1.0\n"),
    )
    with Bench(tmp_path, *changes) as bench:
        yield bench


def blank(page: Any, selector: str) -> None:
    """Wait until an element says nothing."""
    said(page, selector, "^$")


def test_a_dead_process_is_named_and_old_values_are_grey_and_locked(browser: Any, doomed: Bench) -> None:
    address, panel = panel_of(doomed)
    page = opened(browser, address)
    running(page, doomed)
    doomed.ask_for(board.FROZEN_INPUT)
    said(page, "#alarm", "Tripped: x: frozen 2000 ticks, its limit 2000 ticks; also stale. Use Reset to continue")
    doomed.ask_for(board.NO_FAULT)
    page.click("#reset")
    blank(page, "#alarm")

    os.kill(doomed.pid("rt"), signal.SIGKILL)
    doomed.await_restart()
    said(
        page,
        "#alarm",
        r"Tripped: the loop's process died \(signal 9\); rtloop parked the outputs.* Use Reset to continue",
    )
    assert page.is_enabled("#reset")

    assert doomed.service is not None
    doomed.service.kill()
    doomed.service.wait()
    died = "The service does not answer: the service has died: .* STOP does not get through"
    said(page, "#said", f"{died}.*`rtloop park CONFIG --name lab`, .*then start the service with `rtloop serve CONFIG")
    said(page, "#state-word", "^unreachable$")
    said(page, "#drives", "^—$")
    assert str(doomed.folder) not in page.inner_text("body")
    assert page.evaluate("(places) => places.every((one) => document.querySelector(one).closest('[inert]'))", [*DESK])
    for figure in ("#digits", "#rate", "#traces", "#trigger-state", "#spectrum-figures"):
        assert page.evaluate(GREYS, figure) == 1, figure
    assert page.evaluate(GREYS, "#state") == 0, "the service is unreachable now"
    said(page, "#recording", "^—$")
    page.keyboard.press("Escape")
    page.keyboard.press("Space")
    said(page, "#stop-alarm", "STOP did not get through: the service does not answer: the service has died")

    assert doomed.rtloop("park", doomed.config).wait() == 0
    doomed.start_service()
    said(page, "#state-word", "stopped")
    for place in ("#stop-alarm", "#alarm", "#said", "#power-error", "#lock-error"):
        blank(page, place)
    assert not page.evaluate("document.querySelector('#desk').inert")
    running(page, doomed)
    stopped(page)

    panel.kill()
    page.wait_for_selector("body.stale")
    said(page, "#said", "No connection: .* Use the emergency stop")
    said(page, "#age", "s old")
    assert "the values shown are" in page.get_attribute("#scope-plot .veil", "data-says")
    for figure in ("#scope-plot .uplot", "#state"):
        assert page.evaluate(GREYS, figure) == 1, figure
    page.keyboard.press("Space")
    said(page, "#stop-alarm", "STOP did not get through.*emergency stop")
    page.context.close()
