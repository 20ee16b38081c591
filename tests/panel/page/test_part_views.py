"""The views of recordings and of the preview, and narrow screens, in a browser without a panel."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.panel.page.parts import await_exact_text

pytestmark = pytest.mark.system

ALARM = "Tripped: x: frozen 2000 ticks, its limit 2000 ticks; also stale. Reset to go on."
IS_CLICKABLE = """(at) => {
  const {left, top, right, bottom} = document.querySelector(at).getBoundingClientRect();
  return !!document.elementFromPoint((left + right) / 2, (top + bottom) / 2)?.closest(at)}"""
"""Script: whether a click in the middle of an element reaches it."""
DELAYED_INFO = """() => {
  const send = window.fetch;
  const info = () => new Response(JSON.stringify({rate_hz: 9966.0185, ticks: 528488}));
  const delayed = () => new Promise((resolve) => (window.answer = () => resolve(info())));
  window.fetch = (path, options) => (path.endsWith("/info") ? delayed() : send(path, options))}"""
"""Script: delay the information about a recording until `answer` is called."""


@pytest.mark.parametrize("width", [320, 400])
def test_a_narrow_screen_has_the_desk_in_reach_and_the_button_that_closes_the_help(parts: Any, width: int) -> None:
    parts.set_viewport_size({"width": width, "height": 800})
    parts.evaluate("(text) => (document.querySelector('#alarm').textContent = text)", ALARM)
    assert parts.evaluate(IS_CLICKABLE, "nav .narrow")
    parts.evaluate("document.querySelector('#help-dialog').show()")
    for selector in ("#close-help", "#stop", "#alarm", "#state"):
        assert parts.evaluate(IS_CLICKABLE, selector), selector
    parts.evaluate("document.querySelector('#help-dialog').close(), document.querySelector('#alarm').replaceChildren()")


@pytest.mark.parametrize("width", [320, 400])
def test_position_and_drive_are_seen_beside_the_state_on_a_narrow_screen(parts: Any, width: int) -> None:
    parts.set_viewport_size({"width": width, "height": 800})
    parts.wait_for_timeout(200)  # The page updates digits at a rate that the eye can follow.
    axes = "{x: {position_um: 12.5, drive_v: -1.25}, y: {position_um: 0, drive_v: 2}}"
    parts.evaluate(f"scrollTo(0, 0), state({{axes: {axes}}})")
    assert parts.locator(".vitals .brief").all_inner_texts() == ["x\n12.500 µm, −1.250 V", "y\n0.000 µm, 2.000 V"]
    for row in (*parts.locator(".vitals .brief").all(), parts.locator("#state")):
        assert row.bounding_box()["y"] + row.bounding_box()["height"] <= 130
    parts.set_viewport_size({"width": 1280, "height": 800})
    assert not parts.is_visible(".vitals .brief"), "the large digits are in view there"


@pytest.mark.parametrize("width", [320, 1280])
def test_many_recordings_scroll_within_the_list(parts: Any, parts_folder: Path, listing: Path, width: int) -> None:
    parts.set_viewport_size({"width": width, "height": 800})
    recordings = [{"file": f"{number}.mcap", "bytes": 1, "begins_unix_s": number} for number in range(200)]
    (listing / "index.html").write_text(json.dumps(recordings))
    parts.evaluate("recordings.open()")
    parts.wait_for_function("document.querySelectorAll('#recording-list tbody tr').length === 200")
    heights = "(place) => { const {clientHeight, scrollHeight} = place; return [clientHeight, scrollHeight] }"
    visible_px, scrollable_px = parts.locator("#recordings .scroll").evaluate(heights)
    assert visible_px <= 400 < 4000 < scrollable_px


def test_a_recording_is_a_card_on_a_narrow_screen(parts: Any, listing: Path) -> None:
    parts.set_viewport_size({"width": 320, "height": 800})
    for button in parts.locator("#recording-list tr:first-of-type :is(button, a)").all():
        box = button.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 320


def test_the_recording_that_is_shown_is_marked_and_a_wait_is_named(parts: Any, listing: Path) -> None:
    parts.evaluate(DELAYED_INFO)
    parts.click("[aria-label='Info of b.mcap']")
    await_exact_text(parts, "#recording-shown p", "Reading the recording…")
    assert parts.locator("#recording-list [aria-current] th").all_inner_texts() == ["b.mcap"]
    parts.evaluate("answer()")
    await_exact_text(parts, "#recording-shown td", "9966.02")
    assert parts.locator("#recording-shown td").all_inner_texts() == ["9966.02", "528\u202f488"]
    parts.click("#recording-shown button")
    assert parts.locator("#recording-list [aria-current]").count() == 0


def test_no_arrow_stands_beside_equal_figures(parts: Any) -> None:
    show = """async () => {
      const {Preview} = await import("/page/desk/preview.js");
      new Preview().show({overshoot_percent: 0.01, settling_ms: 4}, {overshoot_percent: 0.02, settling_ms: 5});
    }"""
    parts.evaluate(show)
    assert parts.locator("#preview-figures :is(.better, .worse)").all_inner_texts() == ["5.00 ms ▼worse"]


@pytest.fixture
def listing(parts: Any, parts_folder: Path) -> Any:
    """Yield the folder of the list of recordings, while the page shows the view with a.mcap and b.mcap."""
    folder = parts_folder / "api" / "recordings"
    folder.mkdir(exist_ok=True)
    recordings = [{"file": name, "bytes": 1, "begins_unix_s": 1e9} for name in ("a.mcap", "b.mcap")]
    (folder / "index.html").write_text(json.dumps(recordings))
    parts.evaluate("document.querySelector('#recordings').hidden = false, recordings.open()")
    parts.wait_for_selector("#recording-list button")
    yield folder
    parts.evaluate("document.querySelector('#recordings').hidden = true")
