"""The page on screens of all sizes, in both themes, for people who see or use it otherwise."""

from __future__ import annotations

from typing import Any

import pytest

from tests.faults.bench import Bench
from tests.panel.page.browser import AXE, running, said, stopped

MOVING = "[...document.querySelectorAll('*')].filter((one) => parseFloat(getComputedStyle(one).transitionDuration))"
VIEWS = ("scope", "xy", "spectrum", "timing", "recordings", "measure")
RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_violation_in_any_view(shown: Any, scheme: str) -> None:
    if not AXE.exists():
        pytest.skip(f"{AXE} is not there: make browser")
    page = shown
    page.emulate_media(color_scheme=scheme)
    page.wait_for_selector(f"html[data-theme={scheme}]", state="attached")
    page.evaluate(AXE.read_text(encoding="utf-8") + "; undefined")
    check = "async (tags) => (await axe.run({runOnly: {type: 'tag', values: tags}})).violations"
    for view in (*VIEWS, "help"):
        page.keyboard.press("Escape")
        page.keyboard.press(str(VIEWS.index(view) + 1) if view in VIEWS else "?")
        if view == "scope":
            page.keyboard.press("m")
        drawn(page)
        found = page.evaluate(check, RULES)
        assert [(view, one["id"], [node["html"] for node in one["nodes"]]) for one in found] == []


@pytest.mark.parametrize(("width", "scheme"), [(320, "light"), (400, "dark"), (1400, "light"), (2560, "dark")])
def test_nothing_lies_beyond_the_edge_and_stop_is_always_seen(shown: Any, width: int, scheme: str) -> None:
    page = shown
    page.set_viewport_size({"width": width, "height": 900})
    page.emulate_media(color_scheme=scheme)
    page.wait_for_selector(f"html[data-theme={scheme}]", state="attached")
    for place, view in enumerate(VIEWS, start=1):
        page.keyboard.press(str(place))
        drawn(page)
        assert page.is_visible(f"#{view}")
        assert page.is_visible("#scope") or width < 1900, "a large screen keeps the scope"
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), view
        assert page.evaluate("document.documentElement.scrollHeight <= innerHeight") or width < 1400, view
        for scrolled in ("0", "document.body.scrollHeight"):
            page.evaluate(f"scrollTo(0, {scrolled})")
            seen = page.evaluate(
                """() => {
                const {left, top, right, bottom} = document.querySelector("#stop").getBoundingClientRect();
                const there = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
                const within = left >= 0 && top >= 0 && right <= innerWidth && bottom <= innerHeight;
                return within && !!there.closest("#stop")}"""
            )
            assert seen, (view, scrolled)
    page.click("#theme")
    assert page.get_attribute("html", "data-theme") != scheme
    page.click("#theme")
    assert page.get_attribute("html", "data-theme") == scheme


def test_with_reduced_motion_it_works_as_well(shown: Any) -> None:
    shown.emulate_media(reduced_motion="reduce")
    assert shown.evaluate(f"{MOVING}.length") == 0
    said(shown, "#position-x", r"\d")


def test_the_numbers_beside_the_plot_say_what_it_shows(page: Any, bench: Bench) -> None:
    running(page, bench)
    page.fill("#setpoint", "-2.5")
    page.keyboard.press("Enter")
    said(page, "#traces tbody tr:nth-of-type(2)", r"−2\.500.*−2\.500")
    page.keyboard.press("Escape")
    page.keyboard.press("m")
    slider = "[role=slider][aria-label='Cursor A']"
    page.wait_for_selector(f"{slider}[aria-valuetext*='Cursor A']")  # placed in the next frame
    said(page, "#measured", "1/Δt")
    stopped(page)


def drawn(page: Any) -> None:
    """Wait until what was asked for is on the screen: in the second frame from now."""
    page.evaluate("() => new Promise((seen) => requestAnimationFrame(() => requestAnimationFrame(seen)))")
