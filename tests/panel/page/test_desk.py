"""An operator drives a real service from the page in a real browser."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rtloop
from rtloop.client import Client
from tests.faults.bench import Bench
from tests.panel.page.browser import (
    await_hold,
    await_number,
    await_text,
    hold_button,
    open_panel,
    read_number,
    start_by_client,
    start_by_hand,
    start_panel,
    stop_by_keyboard,
)

pytestmark = pytest.mark.system


def trace_figure(page: Any, name: str, figure: int) -> float:
    """Return a figure of a trace from the table beneath the plot: 1 low, 2 high, 3 mean."""
    return read_number(page, f"#traces tbody tr:has-text('{name}') td:nth-of-type({figure + 1})")


def test_each_action_of_an_operator_shows_in_the_page(page: Any, bench: Bench, tmp_path: Path) -> None:
    start_by_hand(page)
    await_text(page, "#drives", "You drive")

    page.fill("#setpoint", "12,5")
    page.keyboard.press("Enter")
    await_number(page, "#position-x", 12.5)
    for figure in (2, 3):  # Low and high: no sweep with the earlier setpoint is shown.
        await_number(page, f"#traces tbody tr:nth-of-type(2) td:nth-of-type({figure})", 12.5, 0.001)
    await_number(page, "#traces tbody tr:nth-of-type(1) td:nth-of-type(4)", 12.5)
    assert trace_figure(page, "x_reference_um", 1) == trace_figure(page, "x_reference_um", 2) == 12.5
    assert trace_figure(page, "x_position_um", 3) == pytest.approx(12.5, abs=0.1)

    page.fill("#tune-value", "0.012")
    assert page.is_hidden("#apply")
    page.keyboard.press("Enter")
    page.wait_for_selector("#apply")
    margins = page.inner_text("#preview-figures")
    assert all(figure in margins for figure in ("phase margin", "resonance may shift", "settles in"))
    page.fill("#tune-value", "none")
    page.keyboard.press("Enter")
    await_text(page, "#tune-error", "no number")
    page.fill("#tune-value", "0.012")
    assert not page.inner_text("#tune-error"), "the message of a refusal goes when the text changes"
    page.keyboard.press("Enter")
    page.wait_for_selector("#apply")
    assert bench.client.get("/configuration")["values"]["axis"][0]["controller"]["gain"] == 0.016
    page.click("#apply")
    await_text(page, "#tune-done", r"applied at tick \d+")
    assert bench.client.get("/configuration")["values"]["axis"][0]["controller"]["gain"] == 0.012
    page.click("#undo")
    await_text(page, "#tune-done", r"undone at tick \d+")
    assert bench.client.get("/configuration")["values"]["axis"][0]["controller"]["gain"] == 0.016
    await_text(page, "#tune-now", "0.016")
    await_text(page, "#events", r"reference · sine of 8\sµm at 5\sHz about 20\sµm → 12.5\sµm")
    await_text(page, "#events", r"controller\.gain 0\.016 → 0\.012")
    await_text(page, "#events", r"controller\.gain 0\.012 → 0\.016")

    with page.expect_download() as download:
        page.click("#capture")
    screenshot = tmp_path / "screen.png"
    download.value.save_as(screenshot)
    assert screenshot.read_bytes().startswith(b"\x89PNG")
    assert screenshot.stat().st_size > 5_000
    await_text(page, "#said", "replay identical")
    captured = rtloop.load(next((bench.folder / "recordings").glob("*.capture-*.mcap")))
    assert abs(float(np.mean(captured["x_position_um"])) - 12.5) < 0.1

    page.click("#stop")
    await_text(page, "#state-word", "stopped")
    page.click("#release")
    await_text(page, "#drives", "Nobody")


def test_space_stops_whatever_has_the_focus(page: Any, bench: Bench) -> None:
    for selector in ("#setpoint", "#trigger-source button", "#waveform-repeat", "#stacked"):
        start_by_client(page, bench)
        if selector == "#waveform-repeat":
            page.click("summary:has-text('Waveform')")
        page.focus(selector)
        if selector == "#trigger-source button":
            page.keyboard.press("Enter")
            assert page.is_visible("#trigger-source-list")
        values = f"[document.querySelector('{selector}').value, document.querySelector('#stacked').ariaPressed]"
        before = page.evaluate(values)
        page.keyboard.press("Space")
        await_text(page, "#state-word", "stopped")
        assert page.evaluate(values) == before
        assert not page.is_checked("#waveform-repeat")
        page.keyboard.press("Escape")
    start_by_client(page, bench)
    page.focus("#who")  # In free text, Space types a blank; Shift+Space stops.
    page.keyboard.press("End")
    page.keyboard.press("Space")
    assert page.input_value("#who") == "ada "
    assert page.inner_text("#state-word") == "running"
    page.keyboard.press("Shift+Space")
    await_text(page, "#state-word", "stopped")
    page.click("#release")


def test_the_keyboard_alone_drives(page: Any) -> None:
    keys = page.keyboard
    keys.press("l")
    keys.type("ada")
    keys.press("Escape")
    for state in ("armed", "running"):
        keys.down("g")
        await_hold(page, "#go")
        keys.up("g")
        await_text(page, "#state-word", state)
    keys.press("s")
    keys.type("+5,25")
    keys.press("Enter")
    await_number(page, "#position-x", 5.25)
    keys.press("Escape")
    keys.press("]")
    await_number(page, "#position-x", 6.25)
    keys.press("m")
    page.wait_for_selector("[aria-label='Cursor A'][aria-valuenow]")  # The next frame places the cursor.
    page.focus("[role=slider][aria-label='Cursor A']")
    at_s = float(page.get_attribute("[aria-label='Cursor A']", "aria-valuenow"))
    keys.press("Shift+ArrowRight")
    has_moved = "(at_s) => Number(document.querySelector('[aria-label=\"Cursor A\"]').ariaValueNow) > at_s"
    page.wait_for_function(has_moved, arg=at_s)
    keys.press("3")
    assert page.is_visible("#spectrum")
    keys.press("?")
    assert page.is_visible("#help-dialog")
    keys.press("Space")
    await_text(page, "#state-word", "stopped")
    keys.press("Escape")
    assert page.is_hidden("#help-dialog")
    page.click("#release")


def test_a_short_hold_does_nothing_and_a_name_is_needed_to_drive(page: Any, bench: Bench) -> None:
    page.hover("#go")
    page.mouse.down()
    page.wait_for_timeout(100)
    page.mouse.up()
    page.wait_for_timeout(900)
    assert bench.status()["state"] == "stopped"
    assert not bench.status()["armed"]
    page.fill("#who", "")
    hold_button(page, "#go")
    await_text(page, "#lock-error", "Enter your name: ")
    assert not bench.status()["armed"]


def test_a_refusal_of_the_service_is_shown_beside_the_field(page: Any, bench: Bench) -> None:
    start_by_client(page, bench)
    for text, words in (("twelve", "no number"), ("1.2.3", "no number"), ("1e300", "")):
        page.fill("#setpoint", text)
        page.keyboard.press("Enter")
        await_text(page, "#setpoint-error", words or "refer")
    page.fill("#setpoint", "−3,5")
    page.keyboard.press("Enter")
    await_text(page, "#setpoint-error", "^$")
    await_text(page, "#digits", r"−3\.5")
    stop_by_keyboard(page)


def test_a_page_delayed_by_a_second_keeps_input_and_messages(page: Any, bench: Bench) -> None:
    start_by_client(page, bench)
    page.fill("#setpoint", "twelve")
    page.keyboard.press("Enter")
    await_text(page, "#setpoint-error", "no number")
    page.fill("#setpoint", "4.5")
    page.evaluate("() => { for (const begun = performance.now(); performance.now() - begun < 1500; ); }")
    page.wait_for_timeout(300)
    assert page.evaluate("document.activeElement.id") == "setpoint"
    await_text(page, "#setpoint-error", "no number")
    page.keyboard.press("Enter")
    await_number(page, "#position-x", 4.5)
    stop_by_keyboard(page)


def test_two_people_one_drives_and_both_may_stop(page: Any, browser: Any, address: str, bench: Bench) -> None:
    start_by_client(page, bench)
    second_page = open_panel(browser, address)
    second_page.fill("#who", "bob")
    await_text(second_page, "#drives", "ada drives")
    second_page.fill("#setpoint", "3")
    second_page.keyboard.press("Enter")
    await_text(second_page, "#setpoint-error", "ada has held the lock since")
    Client(bench.client.path, "ada").post("/tune", {"axis": "x", "section": "controller", "values": {"gain": 0.012}})
    await_text(second_page, "#tune-now", r"0\.012")
    Client(bench.client.path, "ada").post("/undo", {"axis": "x"})
    second_page.keyboard.press("Space")
    await_text(page, "#state-word", "stopped")
    await_text(page, "#events", "bob.*stopped · closed loop → off")
    second_page.context.close()
    page.click("#release")


def test_a_page_before_its_service_says_that_it_waits(browser: Any, bench: Bench) -> None:
    address, process = start_panel(bench, "none")
    page = browser.new_context().new_page()
    page.goto(address)
    await_text(page, "#state-word", "unreachable")
    await_text(
        page,
        "#said",
        "The service does not answer: the service was stopped, or never started. STOP does not get through, .*"
        "Start the service with `rtloop serve CONFIG`",
    )
    assert page.get_attribute("#scope-plot .veil", "data-says").endswith("the service was stopped, or never started")
    page.context.close()
    process.kill()


def test_the_modules_read_numbers_as_people_type_them(page: Any) -> None:
    read = "async (text) => (await import('/page/numbers.js')).parseNumber(text)"
    for text, value in {"-5": -5, "+5": 5, "−5": -5, "12,5": 12.5, "12.5": 12.5, " .5 ": 0.5, "1e-3": 1e-3}.items():
        assert page.evaluate(read, text) == value
    for text in ("", "5 5", "1.000,5", "0x10", "Infinity", "NaN", "--5"):
        with pytest.raises(Exception, match="no number"):
            page.evaluate(read, text)
    columns = "async (text) => JSON.stringify((await import('/page/desk/reference.js')).columns(text))"
    assert json.loads(page.evaluate(columns, "1,5\n2,5\n")) == {"samples": [1.5, 2.5], "command_um": []}
    assert json.loads(page.evaluate(columns, "# two\n1.5, 2\n3.5;4")) == {"samples": [1.5, 3.5], "command_um": [2, 4]}


def test_a_loop_that_does_not_control_is_not_shown_as_running(page: Any, bench: Bench) -> None:
    start_by_client(page, bench)
    driver = Client(bench.client.path, "ada")
    driver.post("/tune", {"axis": "x", "section": "limits", "values": {"settled_within_um": 1e-4}})
    await_text(page, "#state-word", "x not settled")
    assert page.get_attribute("#state", "data-state") == "uncontrolled"
    assert page.title().startswith("!")
    driver.post("/tune", {"axis": "x", "section": "limits", "values": {"settled_within_um": None}})
    await_text(page, "#state-word", "^running$")
    page.click("#release")
