"""docs/notebooks/design.ipynb: every cell runs, and finds the rig's own hysteresis and dynamics."""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest

import rtloop
from rtloop.errors import OutputError
from rtloop.hil.stages.hysteresis import RESIDUAL_WEIGHTS_UM_PER_V, THRESHOLDS_V
from rtloop.workbench.dynamics import fit_dynamics
from rtloop.workbench.hysteresis import fit_hysteresis
from tests.workbench.notebook import ROOT, Names, execute_notebook
from tests.workbench.test_documented import EXAMPLES

pytestmark = pytest.mark.system

RESONANCE_HZ, DAMPING = 595.5, 0.0073
"""The second mode of eq (5) of the paper, which the rig has: 3741.7 rad/s."""


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Names]:
    """Yield the names that the notebook's cells define."""
    before = Path.cwd()
    try:
        yield execute_notebook("design.ipynb", tmp_path_factory.mktemp("notebook"))
    finally:
        os.chdir(before)


def lines(text: str) -> list[str]:
    """Return the lines of a text without white space at their ends."""
    return [line.rstrip() for line in text.rstrip().splitlines()]


def test_the_model_of_the_hysteresis_is_the_rigs(names: Names):
    """Output of the plays for a sine, by the play operator's definition, against the rig's thresholds and weights."""
    model = names["hysteresis"].model
    drive_v = 10.0 * np.sin(np.linspace(0, 6 * np.pi, 1200))

    def output_um(thresholds: Any, weights: Any) -> np.ndarray:
        state, outputs = np.zeros(len(thresholds)), []
        for volt in drive_v:
            state = np.clip(state, volt - np.asarray(thresholds), volt + np.asarray(thresholds))
            outputs.append(state @ np.asarray(weights))
        return np.array(outputs)

    expected = output_um(THRESHOLDS_V, RESIDUAL_WEIGHTS_UM_PER_V)
    assert np.abs(output_um(model.thresholds, model.weights) - expected).max() < 0.01 * np.ptp(expected)
    assert names["hysteresis"].error_um < 0.005 * np.ptp(expected)


def test_the_model_of_the_dynamics_has_the_papers_resonance(names: Names):
    dynamics = names["dynamics"]
    poles = dynamics.to_control().poles()
    light = poles[np.argmin(np.abs(poles.real / np.abs(poles)))]
    assert abs(light) / (2 * np.pi) == pytest.approx(RESONANCE_HZ, rel=2e-3)
    assert -light.real / abs(light) == pytest.approx(DAMPING, rel=0.03)
    assert (dynamics.order, dynamics.as_dict()["order"], dynamics.delay_ticks, len(poles)) == (4, 4, 0, 4)
    assert dynamics.to_control().dcgain() == pytest.approx(1.0, rel=1e-9)


def test_the_designed_controller_closes_a_stable_loop_by_python_control(names: Names):
    design = names["design"]
    plant = design.specification.design.required_plant.transfer()
    loop = control.zpk(plant.zeros, plant.poles, plant.gain) * names["system"]
    assert np.all(control.feedback(loop, 1).poles().real < 0)
    assert names["system"].nstates == design.order == 5
    assert np.sort_complex(names["system"].poles()) == pytest.approx(np.sort_complex(design.controller.poles))
    assert design.gamma_opt < design.gamma < design.achieved < 1.1 * design.gamma


def test_the_check_has_the_margins_of_the_loop_by_python_control(names: Names):
    """The check's margins equal the margins of C(s) on the plant, without sampling."""
    design = names["design"]
    plant = design.specification.design.required_plant.transfer()
    loop = control.zpk(plant.zeros, plant.poles, plant.gain) * names["system"]
    gain_margin, phase_margin_deg, _, _, _, _ = control.stability_margins(loop)[:6]
    continuous = names["check"].axes["x"].continuous
    assert continuous.phase_margin_deg == pytest.approx(phase_margin_deg, rel=1e-3)
    assert 20 * np.log10(continuous.gain_margin) == pytest.approx(20 * np.log10(gain_margin), abs=0.05)
    assert names["check"].axes["x"].meets_specification is False
    assert "static error" in names["check"].axes["x"].missed


def test_identification_returns_and_prints_what_the_command_does(names: Names, command):
    file, result = names["step"].recordings[0], names["dynamics"]
    options = ("--hysteresis", "design-notebook/hysteresis.toml", "--order", "4", "--delay", "0")
    assert result.as_dict() | {"output": None} == json.loads(
        command("identify", "dynamics", file, *options, "--json").stdout
    )
    assert "595.5" in str(result)
    assert str(result).endswith("design-notebook/model.toml")
    with pytest.raises(OutputError, match="exists already"):
        result.write("design-notebook/model.toml")


def test_design_prints_and_returns_what_the_command_does(names: Names, command):
    spec = ROOT / "deploy/paper-spec.toml"
    result = names["design"]
    assert result.as_dict() | {"output": None} == json.loads(command("design", "synthesise", spec, "--json").stdout)
    assert lines(command("design", "synthesise", spec).stdout) == lines(result.section)
    assert Path("design-notebook/designed.toml").read_text().count(f"gain = {result.controller.gain!r}") == 1


def test_the_example_of_the_page_uses_these_results(names: Names, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The example of docs/python.md that identifies and designs, with the notebook's results in place of new ones."""
    monkeypatch.chdir(tmp_path)

    def return_notebook_result(recordings: str, kind: str, **options: Any) -> Any:
        """Check the options against the function's parameters; return the notebook's result."""
        inspect.signature(fit_hysteresis if kind == "hysteresis" else fit_dynamics).bind([recordings], **options)
        return names[kind]

    results = {"identify": return_notebook_result, "design": lambda _: names["design"], "check": rtloop.check}
    [example] = [text for text in EXAMPLES if "rtloop.identify(" in text]
    exec(compile(example, "docs/python.md", "exec"), {"rtloop": SimpleNamespace(**results)})
    assert {file.name for file in tmp_path.iterdir()} == {"hysteresis.toml", "model.toml", "designed.toml"}


def test_results_and_pictures_show_in_a_notebook(names: Names):
    for name in ("sine", "hysteresis", "dynamics", "design", "check"):
        html = names[name]._repr_html_()
        assert html.startswith("<pre")
        assert "[red]" not in html
        assert repr(names[name]).startswith(f"<{type(names[name]).__name__}: ")
    assert names["check"].plot()._repr_png_().startswith(b"\x89PNG")
