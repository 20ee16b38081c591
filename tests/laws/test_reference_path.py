"""The figures of a step are those of the law as it is, with its own use of the reference: on paper as in the run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from rtloop.configuration.second_opinion import faults_on_models
from rtloop.design.verification.judgement import noise_gains
from rtloop.experiments.linear_model import linear_model
from rtloop.laws.contract import Controller
from rtloop.laws.linearise import linear_part
from rtloop.laws.options import ControllerOptions
from rtloop.linear.realisation import System
from rtloop.linear.sampled import SampledController
from tests.command_line import answer, run
from tests.engine.harness import LoopBench, make_plan, prepare_text
from tests.kernel.harness import PERIOD_S
from tests.laws.lab_stage import DYNAMICS, FEED, PAPER_DYNAMICS, PID, own_law, stage
from tests.laws.test_coupled import EXAMPLE, make_invertible, set_references, step_to
from tests.recording.real_loop import ROOT

LEAD = own_law(
    "c.kp * told.error_um + s.integral_um + c.feed * (told.reference_um + 4.0 * (told.reference_um - s.slow_um))",
    f"{PID}\ns.slow_um += 0.1 * (told.reference_um - s.slow_um)",
    state="slow_um",
)
"""A feedforward (1 + 4 z⁻¹ …) that leads the reference, by the difference from a first-order lag of 10 ticks."""
MODEL = own_law(
    "c.kp * told.error_um + s.integral_um + c.kp * (s.model_um - told.reference_um) + c.feed * s.model_um",
    "error_um = told.error_um + s.model_um - told.reference_um\n"
    "s.integral_um += c.ki * error_um + told.applied_um - told.command_um\n"
    "s.model_um += 0.004 * (s.before_um - s.model_um)\ns.before_um += 0.004 * (told.reference_um - s.before_um)",
    state="model_um before_um",
)
"""Two degrees of freedom: the feedback follows a reference model of two lags of 250 ticks, 25 ms, each."""
LAST = own_law(
    "c.kp * told.error_um + s.integral_um + 0.5 * c.feed * (told.reference_um + s.last_um)",
    f"{PID}\ns.last_um = told.reference_um",
    state="last_um",
)
WEIGHTED = own_law("s.integral_um - c.kp * told.position_um + 0.3 * c.kp * told.reference_um", PID)
"""The reference has the weight 0.3 in the proportional part."""
LINEAR = {"feed": FEED, "lead": LEAD, "model": MODEL, "last": LAST, "weighted": WEIGHTED}
HEIGHT_UM, DWELL_S = 2.0, 0.8
STEP_FIGURES = ("settling_time_s", "overshoot_percent", "static_error_percent", "peak_command")


class StepFigures(NamedTuple):
    settling_ms: float
    overshoot_percent: float
    peak_command: float


def on_stage(name: str, controller: str) -> str:
    """Return the configuration of the lab's stage, or of the paper's dynamics on its actuator without hysteresis."""
    reference = f'kind = "steps"\nlevels = [40.0, {40.0 + HEIGHT_UM}]\ndwell_s = {DWELL_S}'
    return stage(controller, reference, dynamics={"lab": DYNAMICS, "paper": PAPER_DYNAMICS}[name])


def recorded_step(text: str, folder: Path) -> StepFigures:
    """Run the configuration, and measure the second step up on the true position of the rig."""
    bench = LoopBench(make_plan(text, folder))
    ticks = round(DWELL_S / PERIOD_S)
    rows = bench.run(4 * ticks)
    assert len(rows) == 4 * ticks
    position, command = (bench.column(rows, f"x_{name}_um") for name in ("true_position", "command"))
    position = (position[3 * ticks :] - 40.0) / HEIGHT_UM
    command = command[3 * ticks :] - command[2 * ticks + ticks // 2 : 3 * ticks].mean()
    outside = np.flatnonzero(np.abs(position - 1.0) > 0.05)
    return StepFigures((outside[-1] + 1) * 0.1, 100 * (position.max() - 1.0), np.abs(command).max() / HEIGHT_UM)


def computed_step(path: Path) -> StepFigures:
    figures = answer("check", path)["axes"][0]["running"]
    return StepFigures(1e3 * figures["settling_time_s"], figures["overshoot_percent"], figures["peak_command"])


@pytest.mark.parametrize(("feed", "swing_ticks", "trips"), [(0.1, 40, False), (1.0, 40, True), (1.0, 10, False)])
def test_a_step_that_rings_until_the_loop_trips_is_warned_of(
    feed: float, swing_ticks: int, trips: bool, tmp_path: Path
) -> None:
    """A step of the command swings the stage of 310 Hz over by 98 % of its height, 16 ticks a swing, for 43 ms."""
    (tmp_path / "lab.py").write_text(FEED)
    path, text = tmp_path / "lab.toml", on_stage("lab", f'file = "lab.py"\nki_per_s = 15.0\nkp = 0.004\nfeed = {feed}')
    interlocks = f"oscillation_um = 0.5\noscillation_swings = 8\nswing_ticks = {swing_ticks}\n"
    path.write_text(text.replace("[axis.interlocks]\n", f"[axis.interlocks]\n{interlocks}"))
    warned = "a step of 2 µm rings: the position turns back by more than" in " ".join(run("check", path).stderr.split())
    result = run("run", path, "--unpaced", "--duration", 2.0, "--out", tmp_path / "out")
    assert (warned, " oscillation;" in result.stdout) == (trips, trips), result.output


@pytest.mark.parametrize("dynamics", ["lab", "paper"])
@pytest.mark.parametrize("kind", LINEAR)
def test_check_computes_the_step_that_runs(kind: str, dynamics: str, tmp_path: Path) -> None:
    """The whole family of linear uses of the reference, on a stage of 310 Hz and on the paper's."""
    gains = {"lab": "ki_per_s = 15.0\nkp = 0.004", "paper": "ki_per_s = 150.0\nkp = 0.04"}[dynamics]
    (tmp_path / "lab.py").write_text(LINEAR[kind])
    path = tmp_path / "lab.toml"
    path.write_text(on_stage(dynamics, f'file = "lab.py"\n{gains}'))
    assert_equal_steps(path)


@pytest.mark.parametrize(
    "prefilter", ["taps = [0.2, 0.3, 0.5]", "taps = [0.5, 0.5]\ncommand_taps = [0.1, 0.0, -0.1]"], ids=["taps", "both"]
)
def test_the_law_sees_the_reference_behind_the_prefilter(prefilter: str, tmp_path: Path) -> None:
    (tmp_path / "lab.py").write_text(LEAD)
    path = tmp_path / "lab.toml"
    text = on_stage("paper", 'file = "lab.py"\nki_per_s = 150.0')
    path.write_text(text.replace("[axis.limits]", f"[axis.prefilter]\n{prefilter}\n[axis.limits]"))
    assert_equal_steps(path)


@pytest.mark.parametrize("name", ["pid", "integral-resonant", "positive-position"])
def test_shipped_laws_that_use_the_position_have_their_steps(name: str, tmp_path: Path) -> None:
    """Their response to the reference is not the one of the error: they damp by the position."""
    text = (ROOT / "deploy" / "laws" / f"{name}.toml").read_text()
    controller = text[text.index("\n[axis.controller]\n") + 19 : text.index("[axis.model]")]
    path = tmp_path / "lab.toml"
    path.write_text(on_stage("paper", controller.replace("kd_s = 1e-5", "kd_s = 4e-5")))
    assert_equal_steps(path)


def assert_equal_steps(path: Path) -> None:
    """Compare the step that `check` computes, which python-control confirms, with the one that runs."""
    computed, recorded = computed_step(path), recorded_step(path.read_text(), path.parent)
    assert computed.settling_ms == pytest.approx(recorded.settling_ms, rel=0.02, abs=0.2)
    assert computed.overshoot_percent == pytest.approx(recorded.overshoot_percent, rel=0.03, abs=1.0)
    assert computed.peak_command == pytest.approx(recorded.peak_command, rel=0.02)


FEEDS = "c.kp * told.error_um + s.integral_um + "
NOT_LINEAR = {
    "square": own_law(FEEDS + "0.001 * told.reference_um * told.reference_um"),
    "cubic": own_law(FEEDS + "c.feed * told.reference_um * (1.0 + 1e-5 * told.reference_um * told.reference_um)"),
    "limited": own_law(FEEDS + "c.feed * min(max(told.reference_um, -20.0), 20.0)"),
    "one sign": own_law(FEEDS + "c.feed * max(told.reference_um, 0.0)"),
    "dead band": own_law(FEEDS + "c.feed * (told.reference_um if abs(told.reference_um) > 0.5 else 0.0)"),
    "root": own_law(FEEDS + "c.feed * math.sqrt(told.reference_um)")
    .replace("from rtloop", "import math\n\nfrom rtloop")
    .replace("    options_model", "    libm = True\n    options_model"),
    "rate": own_law(
        FEEDS + "c.feed * s.slow_um", f"{PID}\ns.slow_um += min(max(told.reference_um - s.slow_um, -0.1), 0.1)",
        state="slow_um",
    ),
    "gain": own_law("(c.kp + 0.001 * told.reference_um) * told.error_um + s.integral_um"),
    "gain of integral": own_law(
        FEEDS + "0.0", "s.integral_um += c.ki * (1.0 + abs(told.reference_um) / 80.0) * told.error_um"
    ),
    "divided": own_law(FEEDS + "(1e-9 / told.reference_um if told.reference_um != 0.0 else 0.0)"),
}  # fmt: skip


@pytest.mark.parametrize("kind", NOT_LINEAR)
def test_a_law_that_is_not_linear_in_its_reference_has_margins_and_no_step(kind: str, tmp_path: Path) -> None:
    (tmp_path / "lab.py").write_text(NOT_LINEAR[kind])
    path = tmp_path / "lab.toml"
    path.write_text(on_stage("lab", 'file = "lab.py"\nki_per_s = 15.0\nkp = 0.004'))
    report = answer("check", path)
    running = report["axes"][0]["running"]
    assert {running[name] for name in STEP_FIGURES} == {None}
    assert running["stable"]
    assert 2.0 < running["gain_margin"] < 4.0
    [warning] = [text for text in report["warnings"] if "axis.x.controller" in text]
    assert "the law is not linear in the reference: " in warning
    assert warning.endswith("; settling, overshoot, static error and peak command are not computed")
    lines = run("check", path).stdout.splitlines()
    for label in ("settling (5 %)", "overshoot", "static error", "peak command, µm per µm"):
        [line] = [line for line in lines if line.startswith(label + " ")]
        assert line.split()[-1] == "–"


def test_an_unknown_step_is_not_judged(tmp_path: Path) -> None:
    (tmp_path / "lab.py").write_text(NOT_LINEAR["square"])
    (tmp_path / "spec.toml").write_text("[specification]\novershoot_percent = 90.0\nsettling_ms = 900.0\n")
    path = tmp_path / "lab.toml"
    text = on_stage("lab", 'file = "lab.py"\nki_per_s = 15.0\nkp = 0.004')
    path.write_text(text.replace('name = "x"\n', 'name = "x"\nspecification = "spec.toml"\n'))
    axis = answer("check", path)["axes"][0]
    assert (axis["meets"], axis["missed"]) == (False, [])
    assert "spec.toml: not judged: axis.x.controller: the law is not linear" in run("check", path).stdout


@pytest.mark.parametrize("kind", [*LINEAR, "integral-resonant"])
def test_python_control_computes_the_same_step(kind: str, tmp_path: Path) -> None:
    text = (ROOT / "deploy" / "laws" / "integral-resonant.toml").read_text()
    text = text[text.index("\n[axis.controller]\n") + 19 : text.index("[axis.model]")]
    if kind in LINEAR:
        (tmp_path / "lab.py").write_text(LINEAR[kind])
        text = 'file = "lab.py"\nki_per_s = 150.0\nkp = 0.04'
    checked = prepare_text(on_stage("paper", text), tmp_path)
    assert checked.checks[0].linear.with_reference is not None
    assert faults_on_models(checked) == []
    changed = replace(checked.checks[0].linear, with_reference=None)
    differing = replace(checked, checks=(replace(checked.checks[0], linear=changed),))
    assert any("step response" in fault or "poles" in fault for fault in faults_on_models(differing))


def test_noise_and_disturbances_do_not_pass_the_path_of_the_reference(tmp_path: Path) -> None:
    """A static feedforward changes neither the noise of position and command, nor the response to a disturbance."""
    noise, response = [], []
    for feed in (0.0, 0.8):
        (tmp_path / "lab.py").write_text(FEED)
        prepared = prepare_text(on_stage("lab", f'file = "lab.py"\nkp = 0.004\nfeed = {feed}'), tmp_path)
        noise.append(noise_gains(prepared.checks[0].on_model))
        [axis] = prepared.configuration.axes
        model = linear_model(axis, 1 / PERIOD_S)
        response.append(model.disturbance_response(np.ones(400)))
    np.testing.assert_allclose(noise[1], noise[0], rtol=1e-12)
    np.testing.assert_allclose(response[1], response[0], rtol=1e-12)


class Declared(Controller):
    """An integrator, declared as such, whose reference is fed forward by functions that no linearisation covers."""

    coefficients = {"ki": float, "feed": float}  # noqa: RUF012
    state = {"integral_um": float, "memory_um": (float, 500)}  # noqa: RUF012
    feed, places = 0.0, 500

    def build(self) -> dict[str, Any]:
        return {"ki": 0.01, "feed": self.feed}

    def output(c: Any, s: Any, told: Any) -> float:
        return s.integral_um + c.feed * told.reference_um

    def update(c: Any, s: Any, told: Any) -> None:
        s.integral_um += c.ki * told.error_um

    def linear(self) -> SampledController:
        return SampledController(System(np.eye(1), np.array([0.01]), np.ones(1), 0.0), self.period_s)


class SmallDeclared(Declared):
    state = {"integral_um": float}  # noqa: RUF012


@pytest.mark.parametrize(
    ("law", "feed", "has_path", "fault"),
    [
        (Declared, 0.0, False, ""),
        (Declared, 0.5, False, "the law has 501 states; allowed in a linearisation: up to 400"),
        (SmallDeclared, 0.0, False, ""),
        (SmallDeclared, 0.5, True, ""),
    ],
)
def test_a_declared_linear_part_is_completed(law: type[Declared], feed: float, has_path: bool, fault: str) -> None:
    """The declaration is from the error alone; the functions tell the rest, or that it is not known."""
    controller = law(ControllerOptions(), PERIOD_S, None)
    controller.feed = feed
    linear = linear_part(controller, 40.0)
    assert (linear.with_reference is not None, linear.reference_fault) == (has_path, fault)
    assert linear.system.b.tolist() == [0.01]


def test_two_axes_with_references_of_each_other(tmp_path: Path) -> None:
    """A shared law feeds each reference to both commands: the step that check computes is the one that runs."""
    (tmp_path / "mine.py").write_text(SHARED)
    start, end = EXAMPLE.index("[axis.controller]\n"), EXAMPLE.index("[axis.model]")
    text = EXAMPLE[:start] + '[axis.controller]\nfile = "mine.py"\naxes = ["x", "y"]\n' + EXAMPLE[end:]
    text = set_references(make_invertible(text), step_to(10.0, 500), 'kind = "hold"')
    path = tmp_path / "mine.toml"
    path.write_text(text)
    computed = computed_step(path)
    bench = LoopBench(make_plan(text, tmp_path))
    rows = bench.run(2500)[500:]
    position, command = (bench.column(rows, f"x_{name}_um") / 10.0 for name in ("true_position", "command"))
    outside = np.flatnonzero(np.abs(position - 1.0) > 0.05)
    assert computed.settling_ms == pytest.approx((outside[-1] + 1) * 0.1, rel=0.03, abs=0.2)
    assert computed.overshoot_percent == pytest.approx(100 * (position.max() - 1.0), rel=0.05)
    assert computed.overshoot_percent > 5.0
    assert computed.peak_command == pytest.approx(np.abs(command).max(), rel=0.02)
    assert faults_on_models(prepare_text(text, tmp_path)) == []


SHARED = """
from rtloop.laws import CoupledController


class Mine(CoupledController):
    axes = 2
    coefficients = {"ki": float}
    state = {"integral_um": (float, 2)}

    def build(self):
        return {"ki": 150.0 * self.period_s}

    def output(c, s, told):
        for i in range(2):
            told.command_um[i] = s.integral_um[i] + 0.7 * told.reference_um[i] - 0.2 * told.reference_um[1 - i]

    def update(c, s, told):
        for i in range(2):
            s.integral_um[i] += c.ki * told.error_um[i] + told.applied_um[i] - told.command_um[i]
"""
