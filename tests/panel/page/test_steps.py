"""Steps of the setpoint are bounded, digits suit the stroke, and the trigger suits the reference, in a browser."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.panel.page.parts import await_exact_text, choose, write_configuration
from tests.panel.page.station import Stations

pytestmark = pytest.mark.system

NANO: dict[str, Any] = {
    "name": "x",
    "feedforward": {"thresholds_v": [0.0, 2.0], "weights_um_per_v": [0.009, 0.00125]},
    "limits": {"command_um": 40.0},
}
"""Configuration of a stage that a drive of ±10 V moves by ±(0.009·10 + 0.00125·8) µm = ±0.1 µm."""


@pytest.fixture(autouse=True)
def two_axes(parts: Any, parts_folder: Path) -> None:
    """Show axes x at 12.5 µm and y at 0 in closed loop, with the default limits, before any command."""
    write_configuration(parts_folder, {"name": "x"}, {"name": "y"})
    parts.evaluate("configuration.read()")
    state = "{tick: 100, mode: 'closed_loop', axes: {x: {position_um: 12.4996, reference_um: 12.5}, y: {}}}"
    parts.evaluate(f"setpoints.length = 0, state({state})")
    choose(parts, "desk-axis", "axis y")
    choose(parts, "desk-axis", "axis x")


@pytest.mark.parametrize("key", ["Home", "End", "PageUp", "PageDown"])
def test_no_key_on_the_slider_crosses_the_stroke(parts: Any, key: str) -> None:
    parts.focus("#setpoint-slider")
    parts.keyboard.press(key)
    assert float(parts.input_value("#setpoint-slider")) == 12.5
    assert parts.evaluate("setpoints") == []


def test_an_arrow_moves_the_slider_by_the_step_of_the_jog_and_enter_applies(parts: Any) -> None:
    choose(parts, "jog-step", "0.2 µm")
    parts.focus("#setpoint-slider")
    for key in ("ArrowRight", "ArrowUp", "ArrowLeft", "ArrowRight"):
        parts.keyboard.press(key)
    assert parts.input_value("#setpoint") == "12.900"
    await_exact_text(parts, "#setpoint-staged", "12.900 µm is not applied yet: Enter or Set applies it.")
    assert parts.evaluate("setpoints") == []
    parts.keyboard.press("Enter")
    await_exact_text(parts, "#setpoint-staged", "")
    assert parts.evaluate("setpoints") == [12.9]
    choose(parts, "jog-step", "1 µm")


def test_a_dragged_slider_applies_its_value_only_on_set(parts: Any) -> None:
    box = parts.locator("#setpoint-slider").bounding_box()
    parts.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + box["height"] / 2)
    assert float(parts.input_value("#setpoint")) > 15
    assert parts.evaluate("setpoints") == []
    parts.click("#setpoint-form [type=submit]")
    assert parts.evaluate("setpoints") == [float(parts.input_value("#setpoint"))]


def test_a_key_that_is_held_on_a_button_jogs_once(parts: Any) -> None:
    parts.evaluate("import('/page/keys.js').then(({Keys}) => { window.keys ??= new Keys(() => {}) })")
    parts.wait_for_function("window.keys")
    parts.focus("[data-jog='1']")
    for _ in range(5):  # Without a release, all but the first are repetitions.
        parts.keyboard.down("Enter")
    parts.keyboard.up("Enter")
    assert parts.evaluate("setpoints") == [13.5]


HELD = {"kind": "hold", "text": "12.5 µm", "value": 12.5}
SINE = {"kind": "sine", "text": "sine of 8 µm at 5 Hz", "value": None}


def play(parts: Any, reference_um: float, **references: Any) -> None:
    """Show the page the references that play, as axis=reference, while x is at `reference_um`."""
    axes = {"x": {"position_um": reference_um, "reference_um": reference_um}, "y": {"reference_um": 0.0}}
    parts.evaluate("(status) => state(status)", {"mode": "closed_loop", "axes": axes, "references": references})


def test_the_setpoint_is_the_reference_that_plays_and_another_generator_is_said_to_replace_it(parts: Any) -> None:
    play(parts, 12.5, x=HELD)
    assert parts.input_value("#setpoint") == "12.500"
    await_exact_text(parts, "#reference-now", "Now: 12.5 µm")
    buttons = parts.locator("#generator [type=submit], #waveform [type=submit]")
    assert buttons.all_text_contents() == ["Play", "Play"]
    for reference_um in (3.1, 7.9):
        play(parts, reference_um, x=SINE)
        assert not parts.input_value("#setpoint"), "a sine has no setpoint"
        await_exact_text(parts, "#reference-now", "Now: sine of 8 µm at 5 Hz")
        assert buttons.all_text_contents() == ["Replace", "Replace"]
    play(parts, 7.7, x=HELD | {"text": "-4 µm", "value": -4.0})  # The state may be older than the event.
    assert parts.input_value("#setpoint") == "-4.000"
    assert parts.input_value("#setpoint-slider") == "-4"
    play(parts, 2.25, x=HELD | {"text": "", "value": None})  # As after mode raw.
    assert parts.input_value("#setpoint") == "2.250"
    await_exact_text(parts, "#reference-now", "Now: 2.250 µm")


def test_a_typed_setpoint_stays_until_it_is_applied_or_left_by_escape(parts: Any) -> None:
    play(parts, 12.5, x=HELD)
    parts.fill("#setpoint", "20")
    play(parts, 3.0, x=SINE)
    assert parts.input_value("#setpoint") == "20"
    parts.press("#setpoint", "Escape")
    assert not parts.input_value("#setpoint")
    parts.fill("#setpoint", "20")
    parts.press("#setpoint", "Enter")
    assert parts.evaluate("setpoints") == [20]
    play(parts, 3.1, x=SINE)
    assert parts.input_value("#setpoint") == "20", "the sine plays until the command takes effect"
    play(parts, 20.0, x=HELD | {"text": "20 µm", "value": 20.0})
    assert parts.input_value("#setpoint") == "20.000"


def test_a_field_of_the_generator_keeps_the_focus_over_a_change_of_the_configuration(parts: Any) -> None:
    parts.click("summary:text-is('Generator')")
    parts.focus("#generator-fields input")
    parts.evaluate("configuration.read()")
    assert parts.evaluate("document.activeElement.matches('#generator-fields input')")
    parts.click("summary:text-is('Generator')")


@pytest.mark.parametrize("stroke", [80.0, 30.0, 2.0, 0.2, 1e-3])
def test_a_jog_is_a_tenth_of_the_stroke_at_most(parts: Any, stroke: float) -> None:
    script = "async (stroke) => (await import('/page/desk/steps.js')).jogSteps(stroke)"
    steps = parts.evaluate(script, stroke)
    assert steps["sizes"] == sorted(set(steps["sizes"]))
    assert stroke / 25 <= steps["sizes"][-1] <= stroke / 10 * (1 + 1e-9)
    assert steps["sizes"][0] <= stroke / 5000
    assert steps["first"] in steps["sizes"]
    assert stroke / 1000 < steps["first"] <= stroke / 50 * (1 + 1e-9)


def test_digits_and_steps_suit_a_stage_of_nanometres(parts: Any, parts_folder: Path) -> None:
    write_configuration(parts_folder, NANO, {"name": "y"})
    parts.evaluate("configuration.read()")
    parts.wait_for_timeout(200)  # The page updates digits at a rate that the eye can follow.
    parts.evaluate("state({tick: 101, axes: {x: {position_um: 0.012344, reference_um: 0.0125, error_um: 0.000156}}})")
    await_exact_text(parts, "#position-x", "0.01234")
    range_um = [float(parts.get_attribute("#setpoint-slider", end)) for end in ("min", "max")]
    assert range_um == pytest.approx([-0.1, 0.1])
    sizes = parts.locator("#jog-step-list li").all_text_contents()
    assert sizes[-1] == "0.02 µm"
    assert "0.0001 µm" in sizes
    choose(parts, "jog-step", "0.001 µm")
    parts.evaluate("(async () => { await reference.jog(1) })()")
    assert parts.evaluate("setpoints") == [0.0135]


@pytest.mark.parametrize(
    ("low", "high", "condition"),
    [
        (12.0, 28.0, {"kind": "edge", "slope": "rising", "level": 20.0, "hysteresis": 1.6}),
        (-0.001, 0.003, {"kind": "edge", "slope": "rising", "level": 0.001, "hysteresis": 0.0004}),
        (12.5, 12.5, {"kind": "step", "threshold": 0.0}),
    ],
)
def test_the_trigger_follows_the_reference_that_plays(
    parts: Any, parts_folder: Path, low: float, high: float, condition: dict[str, Any]
) -> None:
    """The trigger adapts to the measured reference of a run, but a trigger that was set by hand stays unchanged."""
    (parts_folder / "api" / "measure").write_text(json.dumps({"x_reference_um": {"low": low, "high": high}}))
    run = parts.evaluate("window.run = (window.run ?? 0) + 1")
    parts.evaluate("scope.trigger.setLevel(7)")
    assert parts.get_attribute("#suited", "aria-pressed") == "false"
    parts.evaluate(f"state({{run: {run}, tick: 5000, axes: {{}}}})")
    parts.wait_for_timeout(500)
    assert parts.evaluate("scope.view.trigger.level") == 7
    parts.click("#suited")
    parts.wait_for_function(
        "(condition) => Object.entries(condition).every(([key, value]) => scope.view.trigger[key] === value)",
        arg=condition | {"source": "x_reference_um"},
    )
    field = "hysteresis" if condition["kind"] == "edge" else "threshold"
    assert float(parts.input_value(f"#{field}")) == condition[field]


@pytest.mark.parametrize("view", ["xy", "spectrum"])
def test_a_view_of_an_axis_at_rest_says_that_it_shows_noise(parts: Any, view: str) -> None:
    parts.evaluate(f"document.getElementById('{view}').hidden = false, {view}.open()")
    for at_rest in (True, False):
        header = f"at_rest: {str(at_rest).lower()}, signal: 'x_position_um', unit: 'µm', rms: 1, low_hz: 1, high_hz: 9"
        array = "new Float32Array([1, 2])"
        arrays = f"arrays: {{drive_v: {array}, position_um: {array}, hz: {array}, amplitude: {array}}}"
        parts.evaluate(f"dispatch('{view}', {{{header}, loop_percent: null, {arrays}}})")
        parts.wait_for_selector(f"#{view}-rest", state="visible" if at_rest else "hidden")
    parts.evaluate(f"document.getElementById('{view}').hidden = true")


def test_a_failed_test_leaves_no_station_to_the_next() -> None:
    stubs: list[Any] = []

    class StationStub:
        """Station that only stores whether it was closed."""

        def __init__(self) -> None:
            self.closed = False
            stubs.append(self)

        def close(self) -> None:
            self.closed = True

    stations = Stations(StationStub)
    assert stations.current() is stations.current()
    stations.discard()
    stations.current()
    assert [stub.closed for stub in stubs] == [True, False]
