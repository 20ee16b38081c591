"""Response, retuning and learning from the page; the rig's resonance, which differs from the model's, is known."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.errors import RtloopError
from tests.design.measured_loops import compute_margins
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.panel.measurement_rig import MODEL_HZ, SCAN_UM, make_configuration
from tests.panel.page.browser import TIMEOUT_S, await_text, chromium_path, open_panel, start_panel
from tests.service.test_response import LOOP, SETPOINT_UM

pytestmark = pytest.mark.system

COUNT_COLOURS = """(at) => {
  const canvas = document.querySelector(at);
  const {data} = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return new Set(new Uint32Array(data.buffer)).size}"""
"""Script: count the colours of a canvas; an empty plot has few."""


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Yield the bench of the measurement rig, with its loop running."""
    chromium_path()
    folder = tmp_path_factory.mktemp("measure")
    with Bench(folder, board=False, text=make_configuration(folder)) as rig:
        rig.await_state("running")
        yield rig


@pytest.fixture(scope="module")
def measure_page(browser: Any, rig: Bench) -> Iterator[Any]:
    """Yield a page of the rig's panel that shows the view of measurements, under the name ada."""
    page = open_panel(browser, start_panel(rig)[0])
    page.fill("#who", "ada")
    page.keyboard.press("Escape")
    page.keyboard.press("6")
    yield page
    page.context.close()


@pytest.fixture
def view(measure_page: Any) -> Iterator[Any]:
    """Yield the page of the rig's panel; fail if it had an error during the test."""
    yield measure_page
    faults, measure_page.faults = measure_page.faults, []
    assert not faults


def reference_um(rig: Bench) -> float:
    """Return the present reference of axis x."""
    return rig.status()["axes"]["x"]["reference_um"]


def prefilter(rig: Bench) -> dict[str, list[float]]:
    """Return the prefilter in force; empty without one."""
    return rig.client.get("/configuration")["values"]["axis"][0].get("prefilter", {})


def begin(view: Any, activity: str, **fields: str) -> None:
    """Choose an activity, fill its fields and start it."""
    view.click("#measure-activity button")
    view.click(f"#measure-activity-list li:text-is('{activity}')")
    for name, text in fields.items():
        view.fill(f"#measure-{name}", text)
    view.click("#measure-start")


def await_result(view: Any, selector: str) -> None:
    """Wait until the activity has ended, so that it can be started again, and an element of its result is there."""
    view.wait_for_selector(
        f"#measure-start:enabled >> xpath=/.. >> xpath=/.. >> css={selector}", timeout=1e3 * TIMEOUT_S
    )


def cells(view: Any, row: str) -> list[str]:
    """Return the texts of a table's row, without its name."""
    return view.locator(f"#measure tr:has(th:text-is('{row}')) td").all_inner_texts()


def parse_number(text: str) -> float:
    """Return the number at the beginning of a cell's text."""
    return float(text.replace("−", "-").replace("±", "").split()[0])


def test_margins_are_shown_with_their_uncertainty_beside_the_models(view: Any, rig: Bench) -> None:
    begin(view, "Response", duration="1")
    await_text(view, "#measure-lamp", "axis x is measured")
    await_result(view, "#measured-margins:visible")
    await_text(view, "#measure-done", "axis x holds its earlier setpoint again")
    true = compute_margins(LOOP.open, 4.0, 4500.0)
    measured, spread, model = cells(view, "gain margin")
    true_db = 20 * np.log10(true["gain_margin"])
    assert abs(parse_number(measured) - true_db) < 5 * parse_number(spread) + 0.005
    assert abs(parse_number(model) - true_db) > 0.3, "the model has another resonance"
    assert 0 < parse_number(cells(view, "modulus margin")[2]) < 1, "the modulus margin of the model"
    measured, spread, _ = cells(view, "phase margin")
    assert abs(parse_number(measured) - true["phase_margin_deg"]) < 5 * parse_number(spread) + 0.005
    assert parse_number(view.inner_text("#measured-figures dd")) == pytest.approx(LOOP.hz, rel=0.002)
    for plot in ("#measured-loop", "#measured-sensitivity"):
        assert view.evaluate(COUNT_COLOURS, f"{plot} canvas") > 10
    assert reference_um(rig) == SETPOINT_UM


def test_taps_are_swapped_after_consent_alone(view: Any, rig: Bench) -> None:
    begin(view, "Retune", within="0")
    await_result(view, "#measure-consent:visible")
    await_text(view, "#retuned-figures", rf"\+{100 * (LOOP.hz / MODEL_HZ - 1):.0f}\.0|\+4\.9")
    before, after = map(parse_number, cells(view, "settles in"))
    assert after < before
    assert not prefilter(rig).get("taps")
    view.click("#measure-agree")
    await_text(view, "#measure-done", r"Swapped in at tick \d+")
    assert len(prefilter(rig)["taps"]) == 20


def test_a_scan_is_learned_and_plays_after_consent_alone(view: Any, rig: Bench, tmp_path: Path) -> None:
    (tmp_path / "scan.txt").write_text("\n".join(map(repr, SCAN_UM.tolist())))
    view.set_input_files("#measure-file", str(tmp_path / "scan.txt"))
    begin(view, "Learn", cycles="1")
    await_result(view, "#measure-consent:visible")
    view.click("#measure-decline")
    await_text(view, "#measure-done", "Nothing was changed")
    assert view.is_hidden("#measure-consent")
    assert reference_um(rig) == SETPOINT_UM
    begin(view, "Learn", cycles="3")
    await_text(view, "#measure-lamp", r"cycle \d of 4 is measured: rms error")
    await_result(view, "#measure-consent:visible")
    assert reference_um(rig) == SETPOINT_UM
    errors = [parse_number(text) for text in view.locator("#learned-cycles td:nth-of-type(1)").all_inner_texts()]
    assert min(errors) < errors[0] / 5
    view.click("#measure-agree")
    await_text(view, "#measure-done", "plays from tick")
    wait_for(lambda: abs(reference_um(rig) - SETPOINT_UM) > 1.0, "the table that plays")
    await_text(
        view, "#measure-lamp", "not ready: axis x has no constant setpoint .100 samples, repeated.; set one first"
    )
    assert view.is_disabled("#measure-start")
    with pytest.raises(RtloopError, match="kind is table; allowed: hold"):
        rig.client.post("/response?as=ada", {"axis": "x", "amplitude_um": 0.5, "duration_s": 1.0})
    rig.client.post("/setpoint?as=ada", {"axis": "x", "value": SETPOINT_UM})
    wait_for(lambda: reference_um(rig) == SETPOINT_UM, "the setpoint after the table")


def test_refusals_are_shown_and_cancelling_or_leaving_ends_a_measurement(view: Any, rig: Bench) -> None:
    for amplitude, words in (("0", "above 0 and at most"), ("26", "at most 25.0 µm"), ("much", "no number")):
        begin(view, "Response", amplitude=amplitude)
        await_text(view, "#measure-error", words)
    await_text(view, "#measure-most", "µm, at most 25.0, by interlocks.position_um")
    begin(view, "Response", amplitude="0.5", duration="30")
    await_text(view, "#measure-lamp", "axis x is measured")
    view.click("#measure-cancel")
    await_text(view, "#measure-done", "Cancelled: axis x returns to its earlier setpoint")
    await_text(view, "#measure-lamp", "ready")
    wait_for(lambda: rig.status()["measuring"] is None, "the end of the measurement")
    assert reference_um(rig) == SETPOINT_UM

    begin(view, "Response", duration="30")
    await_text(view, "#measure-lamp", "axis x is measured")
    view.reload()
    wait_for(lambda: rig.status()["measuring"] is None, "the end of the measurement")
    assert reference_um(rig) == SETPOINT_UM
