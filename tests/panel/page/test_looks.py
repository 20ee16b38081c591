"""The page on screens of all sizes, in both themes, for people who see or use it otherwise."""

from __future__ import annotations

from typing import Any

import pytest

from tests.panel.page.browser import AXE, opened, said, started, stopped

VIEWS = ("scope", "xy", "spectrum", "timing", "recordings")
RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_violation_in_any_view(browser: Any, address: str, scheme: str) -> None:
    if not AXE.exists():
        pytest.skip(f"{AXE} is not there: make browser")
    page = opened(browser, address, scheme=scheme)
    page.evaluate(AXE.read_text(encoding="utf-8") + "; undefined")
    check = "async (tags) => (await axe.run({runOnly: {type: 'tag', values: tags}})).violations"
    for view in (*VIEWS, "help"):
        page.keyboard.press("Escape")
        page.keyboard.press(str(VIEWS.index(view) + 1) if view in VIEWS else "?")
        if view == "scope":
            page.keyboard.press("m")
        page.wait_for_timeout(300)
        found = page.evaluate(check, RULES)
        assert [(view, one["id"], [node["html"] for node in one["nodes"]]) for one in found] == []
    assert not page.faults
    page.context.close()


@pytest.mark.parametrize(("width", "scheme"), [(320, "light"), (400, "dark"), (1400, "light"), (2560, "dark")])
def test_nothing_lies_beyond_the_edge_and_stop_is_always_seen(
    browser: Any, address: str, width: int, scheme: str
) -> None:
    page = opened(browser, address, width, 900, scheme)
    assert page.get_attribute("html", "data-theme") == scheme
    for place, view in enumerate(VIEWS, start=1):
        page.keyboard.press(str(place))
        page.wait_for_timeout(100)
        assert page.is_visible(f"#{view}")
        assert page.is_visible("#scope") or width < 1900, "a large screen keeps the scope"
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), view
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
    page.context.close()


def test_the_numbers_beside_the_plot_say_what_it_shows(page: Any) -> None:
    started(page)
    page.fill("#setpoint", "-2.5")
    page.keyboard.press("Enter")
    said(page, "#traces tbody tr:nth-of-type(2)", r"−2\.500.*−2\.500")
    page.keyboard.press("Escape")
    page.keyboard.press("m")
    slider = "[role=slider][aria-label='Cursor A']"
    assert "Cursor A" in page.get_attribute(slider, "aria-valuetext")
    said(page, "#measured", "1/Δt")
    stopped(page)


def test_with_reduced_motion_it_works_as_well(browser: Any, address: str) -> None:
    page = opened(browser, address)
    page.emulate_media(reduced_motion="reduce")
    moving = "[...document.querySelectorAll('*')].filter((one) => parseFloat(getComputedStyle(one).transitionDuration))"
    assert page.evaluate(f"{moving}.length") == 0
    said(page, "#position-x", r"\d")
    page.context.close()
