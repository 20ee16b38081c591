"""Modules of the page in a browser without a panel: they show the right texts for messages of the server."""

from __future__ import annotations

from typing import Any

import pytest

from tests.panel.page.parts import await_exact_text, choose

pytestmark = pytest.mark.system


def test_holding_arm_does_not_start_a_loop_that_another_client_armed(parts: Any) -> None:
    is_held = "document.getElementById('go').classList.contains('holding')"
    parts.evaluate("state()")
    assert parts.evaluate(f"drive.go.begin(), {is_held}")
    assert not parts.evaluate(f"state({{state: 'armed'}}), {is_held}")


def test_the_lock_expires_by_the_clock_of_the_host(parts: Any) -> None:
    parts.evaluate("state()")
    await_exact_text(parts, "#drives", "ada drives; the lock is free after 42 s without a command.")


def test_the_own_name_counts_as_it_is_typed(parts: Any) -> None:
    parts.fill("#who", "ada")  # The field keeps the focus.
    parts.evaluate("state()")
    await_exact_text(parts, "#drives", "You drive; the lock is free after 42 s without a command.")
    parts.fill("#who", "")


def test_a_refusal_goes_when_nobody_else_holds_the_lock_any_more(parts: Any) -> None:
    """The modules have no service, so that every command is refused."""
    parts.fill("#who", "bob")
    parts.evaluate("state()")
    parts.evaluate("drive.driving('reset', {}, document.getElementById('power-error'))")
    parts.evaluate("state()")
    assert parts.inner_text("#power-error")
    parts.evaluate("state({lock: null})")
    await_exact_text(parts, "#power-error", "")
    parts.evaluate("drive.driving('reset', {}, document.getElementById('power-error'))")
    parts.evaluate("state({lock: null})")
    assert parts.inner_text("#power-error"), "the refusal has another reason"
    parts.fill("#who", "")


def test_jogs_start_from_the_last_requested_value_until_it_is_shown(parts: Any) -> None:
    jog = "(async () => { await reference.jog(1) })()"
    parts.evaluate("state({axes: {x: {reference_um: 5}}})")
    for _ in range(3):
        parts.evaluate(jog)
    parts.evaluate("state({tick: 200, axes: {x: {reference_um: 2}}})")
    parts.evaluate(jog)
    assert parts.evaluate("setpoints") == [6, 7, 8, 3]


@pytest.mark.parametrize("selector", ["#setpoint", "#desk-axis", "#who"])
def test_the_focus_comes_back_with_the_desk(parts: Any, selector: str) -> None:
    has_focus = "(at) => !!document.activeElement.closest(at)"
    parts.click(selector)  # A list opens and gets the focus.
    parts.evaluate("freshness({answered: false, fresh: false})")
    parts.wait_for_function("document.activeElement === document.body")
    parts.evaluate("freshness()")
    assert parts.evaluate(has_focus, selector)
    parts.evaluate("freshness({answered: false, fresh: false})")
    parts.focus("#help")
    parts.evaluate("freshness()")
    assert parts.evaluate(has_focus, "#help"), "the operator has moved the focus meanwhile"


def test_a_service_that_does_not_answer_is_shown_with_its_remedy(parts: Any) -> None:
    show_unreachable = (
        "state({state: 'unreachable', error: 'the service does not answer: it has died', remedy: 'start it with `X`'})"
    )
    parts.evaluate(f"{show_unreachable}, freshness({{answered: false, fresh: false}})")
    text = parts.inner_text("#said")
    assert text.startswith("The service does not answer: it has died. STOP does not get through")
    assert text.endswith("use the emergency stop. Start it with `X`.")
    parts.evaluate("state(), freshness()")
    await_exact_text(parts, "#said", "")


def test_an_event_that_is_sent_again_is_shown_once(parts: Any) -> None:
    event = "{tick: 5, kind: 'set_mode', who: 'ada', axis: null, what: {mode: 'off', text: 'closed loop → off'}}"
    for _ in range(2):
        parts.evaluate(f"dispatch('events', {{events: [{event}]}})")
    assert parts.locator("#events li").all_inner_texts() == ["5\nada\nstopped · closed loop → off"]


def test_late_ticks_are_one_row_that_grows(parts: Any) -> None:
    event = "{tick: 9, run: 0, kind: 'periods_missed', who: 'loop', axis: null, what: {text: '%s late ticks'}}"
    for count in (2, 3):
        parts.evaluate(f"dispatch('events', {{events: [{event % count}]}})")
    assert parts.locator("#events li").all_inner_texts()[0] == "9\nloop\n3 late ticks"
    assert parts.locator("#events li:has-text('late')").count() == 1


def test_a_loop_that_started_again_parts_its_events_from_those_before(parts: Any) -> None:
    event = "{tick: %s, run: %s, kind: 'reset_trip', who: 'ada', axis: null, what: {text: ''}}"
    start = "The loop started again: ticks count from 0."
    parts.evaluate(f"dispatch('events', {{events: [{event % (800, 1)}, {event % (6, 2)}]}})")
    assert parts.locator("#events li").all_inner_texts()[:3] == ["6\nada\nreset", start, "800\nada\nreset"]
    parts.evaluate("state({run: 2}), state({run: 3}), state({run: 3, faults: ['the process died']})")
    parts.evaluate(f"state({{run: 3, faults: []}}), dispatch('events', {{events: [{event % (9, 3)}]}})")
    texts = parts.locator("#events li").all_inner_texts()
    assert texts[:3] == ["9\nada\nreset", f"The process died. {start}", "6\nada\nreset"]


def test_a_number_and_its_unit_stay_on_one_line(parts: Any) -> None:
    event = "{tick: 11, kind: 'x', who: 'ada', what: {text: 'sine of 8 µm at 5 Hz, worst 12.5 ms, 3 samples'}}"
    parts.evaluate(f"dispatch('events', {{events: [{event}]}})")
    text = parts.evaluate("document.querySelector('#events li').lastChild.textContent")
    assert text == "x · sine of 8\xa0µm at 5\xa0Hz, worst 12.5\xa0ms, 3 samples"


def test_the_slider_ends_where_limits_are_now(parts: Any) -> None:
    range_ends = "[document.getElementById('setpoint-slider')].map(({min, max}) => [Number(min), Number(max)])[0]"
    parts.evaluate("state({mode: 'closed_loop'})")
    choose(parts, "desk-axis", "axis y")
    assert parts.evaluate(range_ends) == [-30, 30]
    parts.evaluate("configuration.read()")
    assert parts.evaluate(range_ends) == [-25, 25]
    parts.evaluate("state({mode: 'raw'})")
    assert parts.evaluate(range_ends) == [0, 10]
    parts.evaluate("state()")
    choose(parts, "desk-axis", "axis x")


def test_another_axis_is_not_sent_the_setpoint_of_this_one(parts: Any) -> None:
    parts.evaluate("state({axes: {x: {reference_um: 5}, y: {reference_um: -2}}})")
    parts.fill("#setpoint", "20")
    choose(parts, "desk-axis", "axis y")
    assert parts.input_value("#setpoint") == "-2.000"
    choose(parts, "desk-axis", "axis x")


def test_a_list_near_the_edge_opens_upward_and_names_axes_first(parts: Any) -> None:
    parts.locator("#add-trace").evaluate("(picker) => picker.scrollIntoView({block: 'end'})")
    parts.click("#add-trace button")
    list_bottom_px, window_height_px = parts.evaluate(
        "[document.getElementById('add-trace-list').getBoundingClientRect().bottom, innerHeight]"
    )
    assert list_bottom_px <= window_height_px
    names = parts.locator("#add-trace-list li").all_inner_texts()
    assert names.index("tick") == len(names) - 1
    parts.keyboard.press("Escape")


def test_the_key_names_a_model_only_where_there_is_one(parts: Any) -> None:
    loop = "drive_v: new Float32Array([0, 1]), position_um: new Float32Array([0, 9])"
    model = ", model_drive_v: new Float32Array([0, 1]), model_position_um: new Float32Array([0, 8])"
    parts.evaluate("document.getElementById('xy').hidden = false, xy.open()")
    await_exact_text(parts, "#xy-key", "measured position (vertical, µm) over drive (horizontal, V)")
    for model_arrays, is_named in (("", False), (model, True), ("", False)):
        parts.evaluate(f"dispatch('xy', {{loop_percent: null, arrays: {{{loop}{model_arrays}}}}})")
        parts.wait_for_selector("#xy-model", state="visible" if is_named else "hidden")
    parts.evaluate("document.getElementById('xy').hidden = true")


def test_the_scale_that_is_held_is_the_one_that_was_in_force(parts: Any) -> None:
    parts.evaluate("sweep()")
    parts.wait_for_function("document.querySelector('#sweep-says').textContent")
    parts.click("#autoscale")
    low, high = (float(field.input_value()) for field in parts.locator("#scales input").all()[:2])
    assert 10 < low < 11 < 13 < high < 14


def test_no_sweeps_are_sent_while_the_scope_is_out_of_sight_or_held(parts: Any) -> None:
    """The server sends none while a client holds its screen."""
    for is_hidden, presses, is_held in (
        (True, 0, True),
        (False, 0, False),
        (False, 1, True),
        (True, 0, True),
        (False, 1, False),
    ):
        parts.evaluate(f"document.getElementById('scope').hidden = {str(is_hidden).lower()}, scope.redraw()")
        for _ in range(presses):
            parts.click("#hold")
        assert parts.evaluate("wishes.hold") is is_held


def test_single_waits_until_its_own_sweep_has_come(parts: Any) -> None:
    parts.click("#trigger-mode [value=single]")
    parts.evaluate("sweep({trigger: 41})")  # A sweep of the earlier mode, which was under way.
    await_exact_text(parts, "#trigger-state", "waiting")
    parts.evaluate("sweep({mode: 'single', trigger: 42})")
    await_exact_text(parts, "#trigger-state", "done")
    parts.click("#arm-single")
    await_exact_text(parts, "#trigger-state", "waiting")


def test_no_margin_of_a_loop_that_never_settles_is_better(parts: Any) -> None:
    show = """async (settling_ms) => {
      const {Preview} = await import("/page/desk/preview.js");
      const after = {gain_margin_db: 170, settling_ms, problems: ["it rests"]};
      new Preview().show({gain_margin_db: 12, settling_ms: 4}, after);
    }"""
    for settling_ms, count in ((3.0, 2), (None, 0)):
        parts.evaluate(show, settling_ms)
        assert parts.locator("#preview-figures .better").count() == count
    assert parts.locator("#preview-problems li").all_inner_texts() == ["it rests"]
