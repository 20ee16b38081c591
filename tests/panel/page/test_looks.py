"""The page fits screens of all sizes in both themes and is accessible, by the rules of axe-core.

A page of another origin can neither read nor command the panel; a page without the token asks for it.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

import pytest

from tests.faults.bench import Bench
from tests.panel.page.browser import AXE, TIMEOUT_S, await_text, open_panel, start_by_client, stop_by_keyboard

pytestmark = pytest.mark.system

MOVING = "[...document.querySelectorAll('*')].filter((e) => parseFloat(getComputedStyle(e).transitionDuration))"
"""Script: the elements with a transition."""
VIEWS = ("scope", "xy", "spectrum", "timing", "recordings", "measure")
TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]

ATTACKS = """async (panel) => {
  const outcomes = {};
  const post = (name, path, options) => fetch(panel + path, {method: "POST", credentials: "include", ...options})
    .then((answer) => (outcomes[name] = answer.type + answer.status), (error) => (outcomes[name] = "failed"));
  const body = JSON.stringify({axis: "x", value: 30});
  await post("json", "/api/setpoint?as=ada", {body, headers: {"Content-Type": "application/json"}});
  await post("plain", "/api/setpoint?as=ada", {body, mode: "no-cors", headers: {"Content-Type": "text/plain"}});
  await post("stop", "/api/stop", {mode: "no-cors", body: "{}"});
  await post("mode", "/api/mode?as=ada", {mode: "no-cors", body: '{"mode": "off"}'});
  outcomes.read = await fetch(panel + "/api/status", {credentials: "include"}).then((a) => a.text(), () => "failed");
  outcomes.socket = await new Promise((resolve) => {
    const socket = new WebSocket(panel.replace("http", "ws") + "/live");
    socket.onopen = () => resolve("open");
    socket.onerror = () => resolve("failed");
  });
  const form = document.createElement("form");
  Object.assign(form, {method: "post", action: panel + "/api/stop", target: "in"});
  const frame = Object.assign(document.createElement("iframe"), {name: "in"});
  document.body.append(frame, form);
  form.submit();
  await new Promise((resolve) => setTimeout(resolve, 500));
  return outcomes;
}"""
"""Script: requests from another origin to the panel at an address; returns the outcome of each by its name."""


class EmptyPageHandler(BaseHTTPRequestHandler):
    """Answers each request with an empty page."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>elsewhere</title><body></body>")

    def log_message(self, format: str, *_: Any) -> None:
        """Log no request to the terminal."""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_violation_in_any_view(window: Any, scheme: str) -> None:
    """Only the contrast is checked in the dark theme, which differs from the light one in its colours alone."""
    if not AXE.exists():
        pytest.skip(f"{AXE} is not installed: make tools")
    page = window
    page.emulate_media(color_scheme=scheme)
    page.wait_for_selector(f"html[data-theme={scheme}]", state="attached")
    page.evaluate(AXE.read_text(encoding="utf-8") + "; undefined")
    rules = {"type": "tag", "values": TAGS} if scheme == "light" else {"type": "rule", "values": ["color-contrast"]}
    check = "async (rules) => (await axe.run({runOnly: rules, resultTypes: ['violations']})).violations"
    for view in (*VIEWS, "help"):
        page.keyboard.press("Escape")
        page.keyboard.press(str(VIEWS.index(view) + 1) if view in VIEWS else "?")
        if view == "scope":
            page.keyboard.press("m")
        await_drawing(page)
        violations = page.evaluate(check, rules)
        assert [(view, rule["id"], [node["html"] for node in rule["nodes"]]) for rule in violations] == []


@pytest.mark.parametrize(("width", "scheme"), [(320, "light"), (400, "dark"), (1400, "light"), (2560, "dark")])
def test_nothing_lies_beyond_the_edge_and_stop_is_always_seen(window: Any, width: int, scheme: str) -> None:
    page = window
    page.set_viewport_size({"width": width, "height": 900})
    page.emulate_media(color_scheme=scheme)
    page.wait_for_selector(f"html[data-theme={scheme}]", state="attached")
    for number, view in enumerate(VIEWS, start=1):
        page.keyboard.press(str(number))
        await_drawing(page)
        assert page.is_visible(f"#{view}")
        assert page.is_visible("#scope") or width < 1900, "a large screen keeps the scope"
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), view
        assert page.evaluate("document.documentElement.scrollHeight <= innerHeight") or width < 1400, view
        for scroll_px in ("0", "document.body.scrollHeight"):
            page.evaluate(f"scrollTo(0, {scroll_px})")
            is_stop_visible = page.evaluate(
                """() => {
                const {left, top, right, bottom} = document.querySelector("#stop").getBoundingClientRect();
                const element = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
                const within = left >= 0 && top >= 0 && right <= innerWidth && bottom <= innerHeight;
                return within && !!element.closest("#stop")}"""
            )
            assert is_stop_visible, (view, scroll_px)
            top, bottom = page.evaluate(
                "(({top, bottom}) => [top, bottom])(document.querySelector('#state').getBoundingClientRect())"
            )
            assert 0 <= top < bottom <= 100, "the state stays in view"
    page.click("#theme")
    assert page.get_attribute("html", "data-theme") != scheme
    page.click("#theme")
    assert page.get_attribute("html", "data-theme") == scheme


def test_with_reduced_motion_it_works_as_well(window: Any) -> None:
    window.emulate_media(reduced_motion="reduce")
    assert window.evaluate(f"{MOVING}.length") == 0
    await_text(window, "#position-x", r"\d")


def test_the_numbers_beside_the_plot_say_what_it_shows(page: Any, bench: Bench) -> None:
    start_by_client(page, bench)
    page.fill("#setpoint", "-2.5")
    page.keyboard.press("Enter")
    await_text(page, "#traces tbody tr:nth-of-type(2)", r"−2\.500.*−2\.500")
    page.keyboard.press("Escape")
    page.keyboard.press("m")
    slider = "[role=slider][aria-label='Cursor A']"
    page.wait_for_selector(f"{slider}[aria-valuetext*='Cursor A']")  # The next frame places the cursor.
    await_text(page, "#measured", "1/Δt")
    stop_by_keyboard(page)


def await_drawing(page: Any) -> None:
    """Wait for two frames, after which the page has drawn all earlier changes."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


@pytest.fixture(scope="module")
def other_origin() -> Iterator[str]:
    """Yield the address of a page of another origin on the same host: its requests carry the panel's cookies."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), EmptyPageHandler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}/"
    server.shutdown()
    server.server_close()


def test_a_page_of_another_origin_cannot_move_the_drive(
    page: Any, bench: Bench, address: str, other_origin: str
) -> None:
    start_by_client(page, bench)
    page.fill("#setpoint", "12.5")
    page.keyboard.press("Enter")
    await_text(page, "#digits", "12.500")
    stranger = page.context.new_page()  # The context has the cookie of the session.
    stranger.goto(other_origin)
    parts = urlsplit(address)
    outcomes = stranger.evaluate(ATTACKS, f"{parts.scheme}://{parts.netloc}")
    assert outcomes["json"] == outcomes["read"] == outcomes["socket"] == "failed"
    status = bench.status()
    assert status["state"] == "running"
    assert status["mode"] == "closed_loop"
    assert status["axes"]["x"]["reference_um"] == 12.5
    stranger.close()
    page.keyboard.press("Escape")
    page.keyboard.press("Space")
    await_text(page, "#state-word", "stopped")
    page.click("#release")


def test_the_token_leaves_the_address_and_without_it_there_is_a_form(browser: Any, address: str) -> None:
    page = open_panel(browser, address)
    assert "token" not in page.url
    assert "#" not in page.url
    page.reload()
    page.wait_for_selector("body:not(.stale)")
    address_without_token, token = address.split("#token=")
    stranger = browser.new_context().new_page()
    stranger.set_default_timeout(1000 * TIMEOUT_S)
    stranger.goto(address_without_token)
    stranger.wait_for_selector("#token-dialog[open]")
    stranger.fill("#token", "not-it")
    stranger.keyboard.press("Enter")
    await_text(stranger, "#token-error", "not the token")
    stranger.fill("#token", token)
    stranger.keyboard.press("Enter")
    stranger.wait_for_selector("body:not(.stale)")
    assert "rtloop" not in stranger.evaluate("document.cookie")
    stranger.context.close()
    page.context.close()
