"""python-control agrees with rtloop on every shipped loop, and the comparison detects a wrong number."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.analysis.closed_loop import discrete_loop
from rtloop.cli import main
from rtloop.configuration import second_opinion as second_opinion_module
from rtloop.configuration.axis import ModelOptions, PrefilterOptions
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.configuration.second_opinion import (
    LoopNumbers,
    controller_matrices,
    coupled_opinion,
    disagreements,
    faults_on_models,
    second_opinion,
)
from rtloop.design.synthesis.specification import SensorOptions
from rtloop.linear.discretise import discretise_controller
from rtloop.linear.transfer import Transfer

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
CONTROLLED = [path.name for path in sorted(DEPLOY.glob("*.toml")) if "\n[axis.controller]" in path.read_text("utf-8")]


@pytest.mark.parametrize("name", CONTROLLED)
def test_python_control_agrees_and_a_wrong_gain_or_delay_is_found(name: str) -> None:
    """A controller gain wrong by 1 %, and one sample of delay fewer than the loop has."""
    prepared = prepare(load(DEPLOY / name))
    for axis, check in zip(prepared.configuration.axes, prepared.checks, strict=True):
        a, b, c, d = controller_matrices(check)
        numbers = LoopNumbers((a, b, c, d), axis.model, check.delay_ticks, axis.prefilter, check.linear.period_s)
        opinion = second_opinion(numbers)
        assert disagreements(check.on_model, opinion) == []
        higher_gain = second_opinion(numbers._replace(controller=(a, b, 1.01 * np.asarray(c), 1.01 * d)))
        delayed = check.loop(check.plant, check.delay_ticks + 1)
        for faults in (disagreements(check.on_model, higher_gain), disagreements(delayed, opinion)):
            assert faults[0].startswith("closed-loop poles:")
            assert any(fault.startswith("step response: rtloop and python-control differ by") for fault in faults)
        assert disagreements(delayed, second_opinion(numbers._replace(delay_ticks=check.delay_ticks + 1))) == []


def test_axes_that_share_a_controller_are_judged_together() -> None:
    """The comparison detects a gain wrong by 1 %, swapped couplings, and one more sample of delay in the other axis."""
    prepared = prepare(load(DEPLOY / "laws" / "coupled.toml"))
    assert faults_on_models(prepared) == []
    a, b, c, d = prepared.checks[0].together.linear.system
    checked = zip(prepared.configuration.axes, prepared.checks, strict=True)
    axes = [LoopNumbers((a, b, c, d), axis.model, check.delay_ticks, axis.prefilter, 1e-4) for axis, check in checked]
    coupling = np.array([[1.0, 0.15], [-0.12, 1.0]])
    higher_gain = [numbers._replace(controller=(a, b, 1.01 * c, 1.01 * d)) for numbers in axes]
    delayed = [axes[0], axes[1]._replace(delay_ticks=axes[1].delay_ticks + 1)]
    for index, check in enumerate(prepared.checks):
        assert disagreements(check.on_model, coupled_opinion(axes, coupling, index)) == []
        for wrong_loop in ((higher_gain, coupling), (axes, coupling.T), (delayed, coupling)):
            faults = disagreements(check.on_model, coupled_opinion(*wrong_loop, index))
            assert faults[0].startswith("closed-loop poles:")


MODELS = {
    "factors": {"gain": 8e9, "numerator": [[1.0, 900.0]], "denominator": [[1.0, 300.0, 9e6], [1.0, 8e5]]},
    "zpk": {"gain": 7.2e12, "zeros": [], "poles": [[-150.0, 2996.0], [-150.0, -2996.0], [-8e5, 0.0]]},
    "transfer_function": {"numerator": [4.5e6, 9e6], "denominator": [2.0, 304.0, 9.3e6, 9e6]},
    "state_space": {"a": [[0.0, 1.0], [-9e6, -300.0]], "b": [0.0, 9e6], "c": [1.0, 0.0], "d": 0.0},
}


@pytest.mark.parametrize("form", MODELS)
def test_every_form_of_a_model_and_the_sensor_are_taken_from_their_numbers(form: str) -> None:
    model, sensor = ModelOptions.model_validate({"form": form, **MODELS[form]}), SensorOptions(bandwidth_hz=2000.0)
    controller = discretise_controller(Transfer.from_zpk([], [0.0], 30.0), 1e-4, "tustin")
    loop = discrete_loop(controller, sensor.add_sensor_lag(model.transfer()), 2)
    numbers = LoopNumbers(controller.system, model, 2, PrefilterOptions(), 1e-4, 2000.0)
    assert disagreements(loop, second_opinion(numbers)) == []


@pytest.mark.parametrize("delay_ticks", [0, 1])
def test_a_loop_whose_margins_python_control_cannot_search_gets_an_opinion(delay_ticks: int) -> None:
    """A design of `design auto` for 800 Hz and a lag of 1000 Hz, on which control.stability_margins raises.

    Without a delay its search finds no bracket, with a sample of delay its spline refuses the grid of frequencies.
    """
    lag, light = [-6276.742266365938, 0.0], [-100.52771602350595, 5025.574807706254]
    zeros = [[-237058.13987435773, 0.0], [243307.5276712738, 0.0]]
    poles = [lag, light, [light[0], -light[1]]]
    options = {"form": "zpk", "gain": -2.749597354419189, "zeros": zeros, "poles": poles}
    model = ModelOptions.model_validate(options)
    notch, fast = -100.5277160235057 + 5025.574807706242j, -6348.63797618617 + 6951.526639437399j
    controller_zeros = [complex(*lag), -825.0, notch, notch.conjugate()]
    controller_poles = [-120677.60965808626, -1053.5378306103935, -0.7500000000000204, fast, fast.conjugate()]
    continuous = Transfer.from_zpk(controller_zeros, controller_poles, 61835.23799150042)
    controller = discretise_controller(continuous, 1e-4, "matched")
    loop = discrete_loop(controller, model.transfer(), delay_ticks)
    opinion = second_opinion(LoopNumbers(controller.system, model, delay_ticks, PrefilterOptions(), 1e-4))
    assert disagreements(loop, opinion) == []
    assert opinion.margins["gain_margin"] > 2.0


@pytest.mark.parametrize("command", [("check", "--strict"), ("design", "verify")])
def test_a_disagreement_is_a_fault_of_the_command(monkeypatch, command) -> None:
    monkeypatch.setattr(second_opinion_module, "STEP_TOLERANCE", -1.0)
    result = CliRunner().invoke(main, [*command, str(DEPLOY / "board.toml")])
    assert result.exit_code == 78
    assert "axis.x: step response: rtloop and python-control differ by" in result.stderr
