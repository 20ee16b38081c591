"""The panel's page in Debian's Chromium, driven by Playwright: actions of an operator, and waits for texts."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rtloop.client import Client
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for

FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
AXE = Path(sys.prefix) / "lib" / "node_modules" / "axe-core" / "axe.min.js"
"""The script of axe-core, where `make tools` installs it."""
WIDTH, HEIGHT = 1400, 900
DRAW_LESS = "window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 100)"
"""Script that lets a page draw ten times a second instead of sixty, for drawing without a graphics card is costly."""
TIMEOUT_S = 150.0
"""Time-out of each wait, far longer than a wait takes."""


def chromium_path() -> str:
    """Return the path of Chromium; skip the test if Chromium or Playwright is not installed."""
    pytest.importorskip("playwright.sync_api", reason="Playwright is not installed: make tools")
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        pytest.skip("Chromium is not installed: make tools")
    return path


@contextmanager
def launch_browser() -> Iterator[Any]:
    """Yield a new process of Chromium, which ends with the context."""
    path = chromium_path()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


def start_panel(bench: Bench, service: str | None = None) -> tuple[str, subprocess.Popen[str]]:
    """Start the panel of the bench's service, or of one named `service`; return its address and its process."""
    log_length = len(bench.log())
    process = bench.rtloop("panel", bench.folder / "run" / f"{service or bench.config.stem}.sock", "--port", "0")
    find_addresses = lambda: re.findall(r"http://127\.[\d.]+:\d+/#token=\S+", bench.log()[log_length:])
    addresses = wait_for(find_addresses, "the panel's address", TIMEOUT_S)
    return addresses[0], process


def open_panel(browser: Any, address: str, width: int = WIDTH, height: int = HEIGHT, scheme: str = "dark") -> Any:
    """Return a new window with the panel once it shows present values; `page.faults` collects errors of the page."""
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
    context.set_default_timeout(1000 * TIMEOUT_S)
    page = context.new_page()
    page.faults = []
    page.on("pageerror", lambda error: page.faults.append(f"{error}: {error.stack}"))
    page.on("console", lambda entry: page.faults.append(entry.text) if "Content Security" in entry.text else None)
    page.add_init_script(DRAW_LESS)
    page.goto(address)
    page.wait_for_selector("body:not(.stale)", timeout=1000 * TIMEOUT_S)
    return page


def await_text(page: Any, selector: str, text: str) -> None:
    """Wait until the text of an element matches the pattern `text`; fail with the text of the element."""
    from playwright.sync_api import TimeoutError

    try:
        page.wait_for_function(
            "([selector, text]) => new RegExp(text).test(document.querySelector(selector)?.textContent)",
            arg=[selector, text],
            timeout=1000 * TIMEOUT_S,
        )
    except TimeoutError:
        errors = list(filter(None, page.locator(".error").all_text_contents()))
        pytest.fail(f"{selector} has {page.text_content(selector)!r}; expected {text!r}; errors on the page: {errors}")


def await_number(page: Any, selector: str, value: float, within: float = 0.1) -> None:
    """Wait until an element shows a number that differs from `value` by less than `within`."""
    page.wait_for_function(
        """([selector, value, within]) => {
        const text = document.querySelector(selector).textContent.replace("−", "-").replace("≈", "");
        return Math.abs(parseFloat(text) - value) < within}""",
        arg=[selector, value, within],
        timeout=1000 * TIMEOUT_S,
    )


def read_number(page: Any, selector: str) -> float:
    """Return the number that an element shows."""
    return float(page.inner_text(selector).replace("−", "-").replace("≈", ""))


def hold_button(page: Any, selector: str) -> None:
    """Hold a button until its action is done, after a second."""
    page.hover(selector)
    page.mouse.down()
    await_hold(page, selector)
    page.mouse.up()


def await_hold(page: Any, selector: str) -> None:
    """Wait until a pressed button has been held for the second that its action needs."""
    page.wait_for_timeout(1000)
    page.wait_for_selector(f"{selector}:not(.holding)")


def start_by_hand(page: Any, name: str = "ada") -> None:
    """Arm and start the loop under a name with the button of the page."""
    page.fill("#who", name)
    await_text(page, "#state-word", "stopped")
    hold_button(page, "#go")
    await_text(page, "#state-word", "armed")
    hold_button(page, "#go")
    await_text(page, "#state-word", "running")


def start_by_client(page: Any, bench: Bench, name: str = "ada") -> None:
    """Arm and start the loop by requests, under the name that is entered in the page, so that the page may drive."""
    page.fill("#who", name)
    client = Client(bench.client.path, name)
    for command in ("/arm", "/start"):
        client.post(command)
    await_text(page, "#state-word", "running")


def stop_by_keyboard(page: Any) -> None:
    """Stop the loop by the keyboard and release the lock."""
    page.keyboard.press("Escape")
    page.keyboard.press("Space")
    await_text(page, "#state-word", "stopped")
    page.click("#release")
    await_text(page, "#drives", "Nobody")
