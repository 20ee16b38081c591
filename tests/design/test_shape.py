"""Taps by linear programming, compared with steps that the tests simulate with scipy, at and between ticks."""

import json
import re
import tomllib
from typing import Any, cast

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import optimize, signal

from rtloop.cli import main
from rtloop.configuration.file import load
from rtloop.design.robust import shape as shape_module
from rtloop.design.robust.options import ScenarioOptions, ShapeOptions
from rtloop.design.robust.programme import Bounds
from rtloop.design.robust.responses import step_responses
from rtloop.design.robust.shape import Subject, build_programme, design_taps, fastest_settling
from rtloop.design.robust.subject import load_subject
from rtloop.errors import NoDesign
from rtloop.linear.discretise import discretise_controller
from rtloop.linear.transfer import Transfer
from tests.laws.test_shipped import DEPLOY
from tests.stage_text import resonance, wired

PERIOD_S, FINE = 1e-4, 10
OMEGA, RATIO = 2 * np.pi * 600.0, 0.15
STAGE = Transfer.from_factors(OMEGA**2, [], [[1.0, 2 * RATIO * OMEGA, OMEGA**2]])
CONTROLLER = discretise_controller(Transfer.from_zpk([], [0.0], 500.0), PERIOD_S, "matched")
BOUNDS = Bounds(0.05, 40.0, -40.0, -46.0, 46.0)
OPTIONS = ShapeOptions(
    taps=20, points_per_tick=4, scenarios=ScenarioOptions(resonance_percent=4.0, damping=(1.0,), gain_percent=0.0)
)  # fmt: skip
SUBJECT = Subject(CONTROLLER, STAGE, 1, BOUNDS, 0.004, OPTIONS)


def simulate(taps, command_taps, shift_percent: float, delay_ticks: int, ticks: int = 300, gain: float = 1.0):
    """Return x at FINE points a tick and v at each tick after a unit step, from the loop's equations point by point."""
    omega = OMEGA * (1 + shift_percent / 100)
    plant = signal.tf2ss([gain * omega**2], [1.0, 2 * RATIO * omega, omega**2])
    a, b, c, _, _ = signal.cont2discrete(plant, PERIOD_S / FINE, method="zoh")
    z, p, k = CONTROLLER.zeros, CONTROLLER.poles, CONTROLLER.gain
    numerator, denominator = k * np.real(np.poly(z)), np.real(np.poly(p))
    numerator = np.concatenate([np.zeros(denominator.size - numerator.size), numerator])
    filtered_reference = np.concatenate([np.cumsum(taps), np.full(ticks, np.sum(taps))])
    added_command = np.concatenate([np.cumsum(command_taps), np.full(ticks, np.sum(command_taps))])
    state, errors, outputs = np.zeros(2), np.zeros(denominator.size), np.zeros(denominator.size - 1)
    position, command = [], []
    for tick in range(ticks):
        x = float((c @ state)[0])
        errors = np.concatenate([[filtered_reference[tick] - x], errors[:-1]])
        output = float(numerator @ errors - denominator[1:] @ outputs)
        outputs = np.concatenate([[output], outputs[:-1]])
        command.append(output + added_command[tick])
        applied = command[tick - delay_ticks] if tick >= delay_ticks else 0.0
        for _ in range(FINE):
            state = a @ state + b[:, 0] * applied
            position.append(float((c @ state)[0]))
    return np.array(position), np.array(command)


@pytest.mark.parametrize(("model", "delay_ticks"), [("", 2), ("delay_ticks = 1\n", 1), ("delay_ticks = 0\n", 0)])
def test_taps_are_for_the_delay_of_the_rig_where_the_model_states_none(tmp_path, model: str, delay_ticks: int) -> None:
    text = (DEPLOY / "robust.toml").read_text()
    for heading, line in (("[axis.model]\n", model), ('kind = "sim"\n', "latency_ticks = 2\n")):
        assert text.count(heading) == 1
        text = text.replace(heading, heading + line)
    (tmp_path / "lab.toml").write_text(text)
    _, subject, _ = load_subject(load(tmp_path / "lab.toml"), "x", DEPLOY / "robust-spec.toml")
    assert subject.delay_ticks == delay_ticks


@pytest.mark.parametrize("delay_ticks", [0, 1, 2])
def test_responses_are_those_of_the_loop_between_ticks_too(delay_ticks) -> None:
    responses = step_responses(CONTROLLER, STAGE, delay_ticks, FINE, 150)
    for part, rows in enumerate([([1.0], [0.0]), ([0.0], [1.0])]):
        x, v = simulate(*rows, 0.0, delay_ticks, 150)
        np.testing.assert_allclose(responses.position[part], x, atol=1e-9)
        np.testing.assert_allclose(responses.command[part], v, atol=1e-9)


@pytest.fixture(scope="module", autouse=True)
def reduced_proofs():
    """Reduce the plants of the proof and the points of the curve; the tests simulate plants between them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shape_module, "SWEEP_PLACES", 3)
        patch.setattr(shape_module, "PROOF_PLACES", 9)
        patch.setattr(shape_module, "CURVE_RANGE", (0.95, 1.1, 6))
        yield


@pytest.fixture(scope="module")
def design(reduced_proofs):
    """Return the taps designed for SUBJECT, with their proof."""
    return design_taps(SUBJECT)


def test_taps_keep_band_overshoot_undershoot_and_drive_wherever_the_resonance_is(design) -> None:
    time_ms = np.arange(1, 300 * FINE + 1) / FINE * PERIOD_S * 1e3
    for shift in np.linspace(-4, 4, 9):
        x, v = simulate(design.taps.reference, design.taps.command, shift, 1)
        assert np.all(np.abs(x[time_ms >= design.settling_ms] - 1) <= 0.05)
        assert x.max() <= 1 + design.proof.overshoot + 1e-6
        assert x.min() >= -0.05
        assert v.min() >= 1 - 46 / 40 - 1e-3
        assert v.max() <= 46 / 40 + 1e-3
        assert x[-1] == pytest.approx(1.0, abs=1e-4)
    assert design.proof.overshoot <= 0.0042
    assert design.taps.reference.sum() == pytest.approx(1.0, abs=1e-9)
    assert design.fastest_ms == design.settling_ms < 2.0
    without_taps, _ = simulate([1.0], [0.0], 0.0, 1)
    settling_without_ms = time_ms[np.abs(without_taps - 1) > 0.05].max()
    assert settling_without_ms > 2 * design.settling_ms


def test_taps_for_a_range_of_the_gain_keep_the_overshoot_wherever_gain_and_resonance_are() -> None:
    """Taps for the model's gain overshoot by as much more as the gain is larger."""
    subject = Subject(CONTROLLER, STAGE, 1, BOUNDS, 0.01, OPTIONS)

    def largest(taps) -> float:
        cases = [(shift, gain) for shift in np.linspace(-4, 4, 5) for gain in (0.985, 1.0, 1.015)]
        steps = [simulate(taps.reference, taps.command, shift, 1, gain=gain)[0] for shift, gain in cases]
        return max(float(x.max()) for x in steps) - 1

    assert largest(design_taps(subject.restrict_resonance(4.0)).taps) > 0.02
    assert largest(design_taps(subject.restrict_resonance(4.0, 1.5)).taps) <= 0.0102


def test_nothing_faster_exists_and_less_overshoot_costs_time(design) -> None:
    """No taps settle a quarter tick faster than the fastest; the least overshoot never rises with the settling time."""
    family = SUBJECT.family()
    programme = build_programme(SUBJECT, [family.nominal, *family.sweep_scenarios(3)])
    fastest = fastest_settling(programme, 0.004)
    assert fastest * 0.1 <= design.fastest_ms + 1e-9
    assert not programme.is_feasible(fastest - 0.25, 0.004)
    overshoots = [programme.least_overshoot_taps(fastest + extra_ticks).overshoot for extra_ticks in (0.0, 1.0, 3.0)]
    assert overshoots[0] >= overshoots[1] - 1e-9 >= overshoots[2] - 2e-9
    assert overshoots[0] <= 0.004


def test_more_time_makes_a_quieter_command(design) -> None:
    slower_options = OPTIONS.model_copy(update={"settling_ms": design.fastest_ms + 0.3})
    slower = design_taps(Subject(CONTROLLER, STAGE, 1, BOUNDS, 0.004, slower_options))
    assert slower.settling_ms == pytest.approx(design.fastest_ms + 0.3)
    assert slower.variation < design.variation
    x, _ = simulate(slower.taps.reference, slower.taps.command, 4.0, 1)
    assert np.all(np.abs(x[round(slower.settling_ms * FINE * 10) :] - 1) <= 0.05)


def test_what_cannot_be_says_what_binds_and_the_fastest() -> None:
    too_fast = Subject(CONTROLLER, STAGE, 1, BOUNDS, 0.004, OPTIONS.model_copy(update={"settling_ms": 0.4}))
    with pytest.raises(
        NoDesign,
        match=r"settling_ms: 0.4 ms cannot be .* the fastest settling time is .*no limit on v .* Most helpful: ",
    ):
        design_taps(too_fast)
    wide = OPTIONS.scenarios.model_copy(update={"gain_percent": 4.0})
    with pytest.raises(NoDesign, match=r"overshoot_percent: 0.0001 % cannot be kept .* the least overshoot is"):
        design_taps(Subject(CONTROLLER, STAGE, 1, BOUNDS, 1e-6, OPTIONS.model_copy(update={"scenarios": wide})))


def test_bounds_let_every_step_between_allowed_levels_stay_within_the_drive() -> None:
    """v = a·s + h·w for every level a, step h, and w at its bounds (s: v/x at rest); v reaches one of its limits."""
    cases = ((BOUNDS, 0.97), (Bounds(0.05, 40.0, 0.0, 0.0, 44.0), 1.02), (Bounds(0.05, 40.0, 25.0, 15.0, 72.0), 1.02))
    for bounds, command_per_um in cases:
        low, high = (float(value) for value in bounds.command_limits(np.array(command_per_um)))
        levels_um = np.linspace(bounds.lowest_um, max(bounds.lowest_um, 0.0) + 40.0, 41)
        commands_um = []
        for w in (low, high):
            for a in levels_um:
                for b in levels_um:
                    if abs(b - a) <= bounds.step_um:
                        commands_um.append(a * command_per_um + (b - a) * w)
        assert min(commands_um) >= bounds.low_um - 1e-9
        assert max(commands_um) <= bounds.high_um + 1e-9
        assert min(abs(min(commands_um) - bounds.low_um), abs(max(commands_um) - bounds.high_um)) < 1e-9


CONFIG = f"""# my stage
[loop]
rate_hz = 10000
[driver]
kind = "sim"
latency_ticks = 1
{wired("adc0", "dac0")}
[[axis]]
name = "x"
[axis.feedforward]
thresholds_v = [0.0]
weights_um_per_v = [4.6]       # my actuator
[axis.controller]
form = "zpk"
gain = 500.0
poles = [[0.0, 0.0]]
[axis.model]
{resonance(OMEGA, RATIO)}
delay_ticks = 1
[axis.limits]
command_um = 60.0
"""
SPEC = """[specification]
overshoot_percent = 0.4
[specification.command]
reference_um = 40.0
command_um = 46.0
[shape]
taps = 20
points_per_tick = 4
[shape.scenarios]
resonance_percent = 4.0
damping = [1.0]
gain_percent = 0.0
"""


SECTIONS = "[[1.0, 0.0, 0.0, 0.0, 0.0]]"


def run_shape(folder, config: str = CONFIG, spec: str = SPEC, *more: str):
    """Run `design shape` on a configuration and a specification; return the result of the command."""
    (folder / "mine.toml").write_text(config)
    (folder / "spec.toml").write_text(spec)
    arguments = ["design", "shape", str(folder / "mine.toml"), "--spec", str(folder / "spec.toml"), *more]
    return CliRunner().invoke(main, arguments)


def test_the_command_writes_both_rows_and_keeps_the_rest(tmp_path, design) -> None:
    """±10 V and 4.6 µm/V are the ±46 µm of the subject above: the same taps, in a file that keeps its comments."""
    out, plot = tmp_path / "made.toml", tmp_path / "taps.png"
    result = run_shape(tmp_path, CONFIG, SPEC, "--out", str(out), "--plot", str(plot), "--json")
    assert result.exit_code == 0, result.stderr
    report, axis = json.loads(result.stdout), tomllib.loads(out.read_text())["axis"][0]
    assert axis["prefilter"]["taps"] == report["taps"]
    assert axis["prefilter"]["command_taps"] == pytest.approx(design.taps.command.tolist(), abs=1e-6)
    assert axis["specification"] == "spec.toml"
    assert "# my actuator" in out.read_text()
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert len(report["trade_off"]) > 5


def test_the_command_prints_figures_and_the_written_file_on_stdout(tmp_path) -> None:
    out = tmp_path / "made.toml"
    result = run_shape(tmp_path, CONFIG, SPEC, "--out", str(out))
    assert result.exit_code == 0, result.stderr
    assert re.search(r"settling time \(5 %\) [\d.]+ ms; with overshoot ≤ [\d.]+ %, the least possible", result.stdout)
    assert result.stdout.endswith(f"{out} is written. To judge it: rtloop design verify {out}\n")


@pytest.mark.parametrize(
    ("old", "new", "code", "message"),
    [
        ("overshoot_percent = 0.4", "", 78, "overshoot_percent: missing; allowed: above 0 and up to 5"),
        ("overshoot_percent = 0.4", "overshoot_percent = 0.0", 78, "overshoot_percent: 0.0; allowed: above 0"),
        ("[specification.command]\nreference_um = 40.0\ncommand_um = 46.0\n", "", 78, "reference_um: missing"),
        ("taps = 20", "taps = 1", 78, "greater than or equal to 2"),
        ("reference_um = 40.0", "reference_um = 46.5", 78, "reference_um: value is 46.5 µm; allowed: up to 46 µm"),
        (
            "taps = 20",
            "taps = 2",
            1,
            "no taps settle within 0.1 ms, the longest settling time possible with shape.taps = 2 at",
        ),
        ("resonance_percent = 4.0", "resonance_percent = nan", 78, "resonance_percent"),
        ("command_um = 60.0", "command_um = 60.0\nslew_v_per_s = 1e4", 78, "limits.slew_v_per_s"),
        ("[axis.limits]", f"[axis.prefilter]\nsections = {SECTIONS}\n[axis.limits]", 78, "prefilter.sections"),
        (CONFIG[CONFIG.index("[axis.model]") : CONFIG.index("[axis.limits]")], "", 78, "model: missing"),
    ],
)
def test_a_specification_or_configuration_without_taps_is_refused(tmp_path, old, new, code, message) -> None:
    """`new` replaces `old` in the configuration or in the specification."""
    result = run_shape(tmp_path, CONFIG.replace(old, new), SPEC.replace(old, new))
    assert result.exit_code == code, result.output
    assert message in result.stderr
    assert "Traceback" not in result.output


def test_a_linear_programme_that_no_solver_finishes_is_refused_in_a_sentence(tmp_path, monkeypatch) -> None:
    failure = optimize.OptimizeResult(status=4, message="Serious difficulties. (HiGHS Status 4: Solve error)")
    monkeypatch.setattr("rtloop.design.robust.programme.linprog", lambda *_, **__: failure)
    result = run_shape(tmp_path)
    assert result.exit_code == 1, result.output
    message = (
        "mine.toml: shape: the linear programme for the taps was not solved: Serious difficulties. (HiGHS Status 4"
    )
    assert message in result.stderr
    assert "Use another number of shape.taps or shape.points_per_tick" in result.stderr
    with pytest.raises(NoDesign, match="was not solved"):
        design_taps(SUBJECT)


@pytest.mark.parametrize(
    ("figures", "message"),
    [
        (
            {"overshoot": 0.02},
            "fail the proof on 9 plants: .* overshoot up to 2 %, and the command v stays within its limits",
        ),
        ({"excess": 0.01}, "fail the proof on 9 plants: .* the command v exceeds its limits by 1 % of the height"),
    ],
)
def test_taps_that_their_proof_does_not_bear_out_are_refused(monkeypatch, figures, message) -> None:
    """A plant outside the linear programme misses the designed figures in every round: an error, not a warning."""
    monkeypatch.setattr(shape_module, "MOST_ROUNDS", 2)
    measure_step = shape_module.measure_step
    monkeypatch.setattr(shape_module, "measure_step", lambda *arguments: measure_step(*arguments)._replace(**figures))
    with pytest.raises(NoDesign, match=message):
        design_taps(SUBJECT)


def test_restricted_scenarios_keep_the_delay() -> None:
    options = ShapeOptions(scenarios=ScenarioOptions(delay_ticks=(0, 2)))
    subject = Subject(cast(Any, None), cast(Any, None), 1, cast(Any, None), 0.1, options)
    restricted = subject.restrict_resonance(3.0).options.scenarios
    assert (restricted.resonance_percent, restricted.damping, restricted.gain_percent) == (3.0, (1.0,), 0.0)
    assert restricted.delay_ticks == (0, 2)
