"""The page after the death of loop, service and panel, and after the return of the service."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from rtloop.hil import board
from tests.faults.bench import Bench
from tests.panel.page.browser import (
    await_text,
    chromium_path,
    open_panel,
    start_by_client,
    start_panel,
    stop_by_keyboard,
)

pytestmark = pytest.mark.system

DESK_CONTROLS = ("#go", "#set-mode button", "#setpoint", "#tune-value", "#undo")

COUNT_GREY_FILTERS = """(at) => {
  let count = 0;
  for (let e = document.querySelector(at); e; e = e.parentElement)
    if (getComputedStyle(e).filter.includes("grayscale")) count++;
  return count}"""
"""Script: count the grey filters on an element and those around it, for two make it too faint to read."""


@pytest.fixture
def bench_to_kill(tmp_path: Any) -> Iterator[Bench]:
    """Yield a bench whose processes the test kills; its loop ends one second after the death of the service."""
    chromium_path()
    changes = (
        ("[recording]", "[service]\narm = true\n[recording]"),
        ("[loop]\n", "[loop]\nheartbeat_timeout_s = 1.0\n"),
    )
    with Bench(tmp_path, *changes) as bench:
        yield bench


def await_empty(page: Any, selector: str) -> None:
    """Wait until an element has no text."""
    await_text(page, selector, "^$")


def test_a_dead_process_is_named_and_old_values_are_grey_and_locked(browser: Any, bench_to_kill: Bench) -> None:
    address, panel = start_panel(bench_to_kill)
    page = open_panel(browser, address)
    start_by_client(page, bench_to_kill)
    bench_to_kill.cause_fault(board.FROZEN_INPUT)
    await_text(page, "#alarm", "Tripped: x: frozen 2000 ticks, its limit 2000 ticks; also stale. Use Reset to continue")
    bench_to_kill.cause_fault(board.NO_FAULT)
    page.click("#reset")
    await_empty(page, "#alarm")

    os.kill(bench_to_kill.pid("rt"), signal.SIGKILL)
    bench_to_kill.await_restart()
    await_text(
        page,
        "#alarm",
        r"Tripped: the loop's process died \(signal 9\); rtloop parked the outputs.* Use Reset to continue",
    )
    assert page.is_enabled("#reset")

    assert bench_to_kill.service is not None
    bench_to_kill.service.kill()
    bench_to_kill.service.wait()
    died = "The service does not answer: the service has died: .* STOP does not get through"
    await_text(
        page, "#said", f"{died}.*`rtloop park CONFIG --name lab`, .*then start the service with `rtloop serve CONFIG"
    )
    await_text(page, "#state-word", "^unreachable$")
    await_text(page, "#drives", "^—$")
    assert str(bench_to_kill.folder) not in page.inner_text("body")
    assert page.evaluate(
        "(controls) => controls.every((at) => document.querySelector(at).closest('[inert]'))", [*DESK_CONTROLS]
    )
    for figure in ("#digits", "#rate", "#traces", "#trigger-state", "#spectrum-figures"):
        assert page.evaluate(COUNT_GREY_FILTERS, figure) == 1, figure
    assert page.evaluate(COUNT_GREY_FILTERS, "#state") == 0, "the service is unreachable now"
    await_text(page, "#recording", "^—$")
    page.keyboard.press("Escape")
    page.keyboard.press("Space")
    await_text(page, "#stop-alarm", "STOP did not get through: the service does not answer: the service has died")

    assert bench_to_kill.rtloop("park", bench_to_kill.config).wait() == 0
    bench_to_kill.start_service()
    await_text(page, "#state-word", "stopped")
    for selector in ("#stop-alarm", "#alarm", "#said", "#power-error", "#lock-error"):
        await_empty(page, selector)
    assert not page.evaluate("document.querySelector('#desk').inert")
    start_by_client(page, bench_to_kill)
    stop_by_keyboard(page)

    panel.kill()
    page.wait_for_selector("body.stale")
    await_text(page, "#said", "No connection: .* Use the emergency stop")
    await_text(page, "#age", "s old")
    assert "the values shown are" in page.get_attribute("#scope-plot .veil", "data-says")
    for figure in ("#scope-plot .uplot", "#state"):
        assert page.evaluate(COUNT_GREY_FILTERS, figure) == 1, figure
    page.keyboard.press("Space")
    await_text(page, "#stop-alarm", "STOP did not get through.*emergency stop")
    page.context.close()
