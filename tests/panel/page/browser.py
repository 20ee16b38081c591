"""Debian's Chromium, driven by Playwright, on the panel of a service: actions and readings of an operator."""

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
"""Where `make tools` puts it."""
WIDTH, HEIGHT = 1400, 900
DRAW_LESS = "window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 100)"
"""A page draws ten times a second in place of sixty: without a graphics card, drawing costs a processor."""
PATIENCE_S = 150.0
"""For whatever is waited for: it says nothing of how long it takes."""


def chromium() -> str:
    """Its path; skips where there is none, or no Playwright."""
    pytest.importorskip("playwright.sync_api", reason="Playwright is not installed: make tools")
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        pytest.skip("Chromium is not installed: make tools")
    return path


@contextmanager
def launched() -> Iterator[Any]:
    """A browser of one's own."""
    path = chromium()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


def panel_of(bench: Bench, service: str | None = None) -> tuple[str, subprocess.Popen[str]]:
    """Start the panel of a service, of the bench's own or of another name; its address and its process."""
    said = len(bench.log())
    process = bench.rtloop("panel", bench.folder / "run" / f"{service or bench.config.stem}.sock", "--port", "0")
    found: list[str] = []

    def told() -> bool:
        found[:] = re.findall(r"http://127\.0\.0\.1:\d+/#token=\S+", bench.log()[said:])
        return bool(found)

    wait_for(told, "the panel's address", PATIENCE_S)
    return found[0], process


def opened(browser: Any, address: str, width: int = WIDTH, height: int = HEIGHT, scheme: str = "dark") -> Any:
    """The panel in a window of its own, showing what is now; what goes wrong in the page is noted in `page.faults`."""
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
    context.set_default_timeout(1000 * PATIENCE_S)
    page = context.new_page()
    page.faults = []
    page.on("pageerror", lambda error: page.faults.append(f"{error}: {error.stack}"))
    page.on("console", lambda said: page.faults.append(said.text) if "Content Security" in said.text else None)
    page.add_init_script(DRAW_LESS)
    page.goto(address)
    page.wait_for_selector("body:not(.stale)", timeout=1000 * PATIENCE_S)
    return page


def said(page: Any, selector: str, text: str) -> None:
    """Wait until the text of an element matches the pattern `text`; fail with the text that it has."""
    from playwright.sync_api import TimeoutError

    try:
        page.wait_for_function(
            "([selector, text]) => new RegExp(text).test(document.querySelector(selector)?.textContent)",
            arg=[selector, text],
            timeout=1000 * PATIENCE_S,
        )
    except TimeoutError:
        errors = list(filter(None, page.locator(".error").all_text_contents()))
        pytest.fail(f"{selector} says {page.text_content(selector)!r}; expected {text!r}; errors on the page: {errors}")


def near(page: Any, selector: str, value: float, within: float = 0.1) -> None:
    """Wait until an element shows a number."""
    page.wait_for_function(
        """([selector, value, within]) => {
        const text = document.querySelector(selector).textContent.replace("−", "-").replace("≈", "");
        return Math.abs(parseFloat(text) - value) < within}""",
        arg=[selector, value, within],
        timeout=1000 * PATIENCE_S,
    )


def number(page: Any, selector: str) -> float:
    """What an element shows."""
    return float(page.inner_text(selector).replace("−", "-").replace("≈", ""))


def hold(page: Any, selector: str) -> None:
    """Press a button for longer than a second."""
    page.hover(selector)
    page.mouse.down()
    held(page, selector)
    page.mouse.up()


def held(page: Any, selector: str) -> None:
    """Wait until a button that is pressed has had its second."""
    page.wait_for_timeout(1000)
    page.wait_for_selector(f"{selector}:not(.holding)")


def started(page: Any, name: str = "ada") -> None:
    """Arm and start it under a name, as a person does."""
    page.fill("#who", name)
    said(page, "#state-word", "stopped")
    hold(page, "#go")
    said(page, "#state-word", "armed")
    hold(page, "#go")
    said(page, "#state-word", "running")


def running(page: Any, bench: Bench, name: str = "ada") -> None:
    """Have it run, driven under a name that is the page's as well, without the hand at its buttons."""
    page.fill("#who", name)
    client = Client(bench.client.path, name)
    for command in ("/arm", "/start"):
        client.post(command)
    said(page, "#state-word", "running")


def stopped(page: Any) -> None:
    """Stop it by the keyboard, and give the lock back."""
    page.keyboard.press("Escape")
    page.keyboard.press("Space")
    said(page, "#state-word", "stopped")
    page.click("#release")
    said(page, "#drives", "Nobody")
