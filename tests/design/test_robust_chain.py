"""`design auto --robust` from recordings to a loop with taps; refusals; plants with many modes or very fast poles."""

import json
import math
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.design.identification.dynamics.dynamics_fit import _limit_fast_rates
from rtloop.design.robust import certificate
from rtloop.design.robust import shape as shape_module
from rtloop.design.robust.options import ScenarioOptions
from rtloop.design.robust.scenarios import Family
from rtloop.errors import NoDesign
from rtloop.linear.transfer import Transfer
from tests.design.modal_rigs import RATE_HZ, SINE_S, STEPS_S, noisy_rig
from tests.recording.real_loop import record
from tests.soak.chain import run

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
PERIOD_S = 1e-4
SPEC = """
[specification]
overshoot_percent = 1.5
[specification.command]
reference_um = 18.0
command_um = 19.5
[scenarios]
resonance_percent = {percent}
[robust]
biquads = 1
restarts = 2
generations = 60
[shape]
taps = 30
points_per_tick = 3
[shape.scenarios]
resonance_percent = 1.0
damping = [1.0]
gain_percent = 0.0
[simulation]
steps_um = [10.0]
judged = false
"""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Return the paths of the recordings of deploy/own-stage-sine.toml and deploy/own-stage.toml."""
    folder = tmp_path_factory.mktemp("recorded")
    return [
        str(record(folder / f"{name}.mcap", (DEPLOY / f"{name}.toml").read_text(encoding="utf-8"), ticks)[0])
        for name, ticks in (("own-stage-sine", 25_000), ("own-stage", 10_000))
    ]


@pytest.fixture(autouse=True)
def reduced_proofs(monkeypatch) -> None:
    """Reduce the plants of all proofs to a few; other tests cover the proofs of the search and of the taps."""
    monkeypatch.setattr(certificate, "SWEEP_POINTS", 3)
    monkeypatch.setattr(certificate, "RANDOM_PLANTS", 10)
    monkeypatch.setattr(shape_module, "SWEEP_PLACES", 3)
    monkeypatch.setattr(shape_module, "PROOF_PLACES", 5)


def design_auto(recordings, folder, text: str):
    """Run `design auto --robust` with the specification `text`; return the result of the command."""
    (folder / "spec.toml").write_text(text, encoding="utf-8")
    arguments = [*recordings, "--robust", "--specs", folder / "spec.toml", "--out", folder / "made.toml", "--json"]
    return CliRunner().invoke(main, ["design", "auto", *map(str, arguments)])


@pytest.mark.usefixtures("few_simulated_steps")
def test_two_recordings_become_a_loop_with_taps_that_keeps_its_promise(recordings, tmp_path) -> None:
    """The step on the rig is as predicted; the interlocks are armed; stdout has JSON alone."""
    result = design_auto(recordings, tmp_path, SPEC.format(percent=3.0))
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["meets"]
    (axis,) = load(tmp_path / "made.toml").axes
    assert sum(axis.prefilter.taps) == pytest.approx(1.0, abs=1e-9)
    assert len(axis.prefilter.taps) == len(axis.prefilter.command_taps) == 30
    assert axis.interlocks.oscillation_swings > 0
    assert axis.model is not None
    assert axis.model.delay_ticks == 1
    promised = prepare(load(tmp_path / "made.toml")).checks[0].running
    trips, distances = run(tmp_path / "made.toml", promised)
    assert trips == []
    assert abs(distances["overshoot_percent"]) < 1.0
    assert abs(distances["settling_ms"]) < 0.15 * 1e3 * promised.settling_time_s + 0.1


def test_what_cannot_be_had_is_refused_and_nothing_is_written(recordings, tmp_path) -> None:
    """No mode of 800 Hz dies away in a thousandth of a millisecond."""
    search_lines = "restarts = 2\ngenerations = 60"
    text = SPEC.format(percent=3.0).replace(search_lines, "restarts = 1\ngenerations = 9\ndecay_ms = 0.001")
    refused = design_auto(recordings, tmp_path, text)
    assert refused.exit_code == 1, refused.output
    assert "allowed: up to 0.001" in refused.stderr
    assert "Use wider limits, smaller ranges in [scenarios]" in refused.stderr
    assert not (tmp_path / "made.toml").exists()


def test_a_disturbance_beyond_half_the_rate_is_refused_without_a_stated_range_too(recordings, tmp_path) -> None:
    text = SPEC.replace("[scenarios]\nresonance_percent = {percent}\n", "")
    text += "[specification.disturbance]\nlargest_um = 1.0\nerror_um = 0.1\nup_to_hz = 6000.0\n"
    refused = design_auto(recordings, tmp_path, text)
    assert refused.exit_code == 1, refused.output
    assert "up_to_hz: 6000 Hz; allowed: below half of controller.rate_hz, 5000 Hz" in refused.stderr
    assert "no controller" not in refused.stderr  # that message would blame the range of the resonance
    assert not (tmp_path / "made.toml").exists()


@pytest.mark.parametrize(
    ("line", "key"),
    [("overshoot_percent = 1.5", "overshoot_percent"), ("reference_um = 18.0\ncommand_um = 19.5", "reference_um")],
)
def test_a_specification_that_says_too_little_is_refused_first(recordings, tmp_path, line, key) -> None:
    text = SPEC.format(percent=3.0).replace(line, "").replace("[specification.command]\n\n", "")
    result = design_auto(recordings, tmp_path, text)
    assert result.exit_code == 78
    assert key in result.stderr
    assert "search" not in result.stderr


def test_a_reference_beyond_the_drive_is_refused_before_the_search(recordings, tmp_path) -> None:
    """The stage reaches 20 µm at 10 V."""
    limits, larger_limits = "reference_um = 18.0\ncommand_um = 19.5", "reference_um = 30.0\ncommand_um = 33.0"
    text = SPEC.format(percent=3.0).replace(limits, larger_limits)
    refused = design_auto(recordings, tmp_path, text)
    assert refused.exit_code == 1, refused.output
    assert "specification.command.reference_um: value is 30 µm; allowed: up to 20 µm" in refused.stderr
    assert "search" not in refused.stderr
    assert not (tmp_path / "made.toml").exists()


def test_a_controller_without_taps_is_written_all_the_same(recordings, tmp_path, monkeypatch) -> None:
    """The written loop is stable; the file names the reason, and the exit code shows that the design is incomplete."""
    reason = "shape: no taps settle within 2.7 ms"
    monkeypatch.setattr("rtloop.design.robust.chain.design_taps", Mock(side_effect=NoDesign(reason)))
    refused = design_auto(recordings, tmp_path, SPEC.format(percent=3.0))
    assert refused.exit_code == 1, refused.output
    assert reason in refused.stderr
    assert f"{tmp_path / 'made.toml'} is written with the controller that was found, but without taps" in refused.stderr
    configuration = load(tmp_path / "made.toml")
    (axis,) = configuration.axes
    assert (axis.prefilter.taps, axis.prefilter.command_taps) == ((), ())
    assert reason in configuration.text
    (check,) = prepare(configuration).checks
    assert check.running.stable


def without_stated_ranges(text: str) -> str:
    """Return the specification `text` without its [shape.scenarios]."""
    ranges = "[shape.scenarios]\nresonance_percent = 1.0\ndamping = [1.0]\ngain_percent = 0.0\n"
    assert ranges in text
    return text.replace(ranges, "")


def test_taps_are_first_tried_with_a_range_of_the_gain(recordings, tmp_path, monkeypatch) -> None:
    """Ranges that the specification states are the only ones."""
    design_taps = Mock(side_effect=NoDesign("shape: no taps settle within 2.7 ms"))
    monkeypatch.setattr("rtloop.design.robust.chain.design_taps", design_taps)

    def tried(text: str) -> list[tuple[float, float]]:
        design_taps.reset_mock()
        (tmp_path / "made.toml").unlink(missing_ok=True)
        assert design_auto(recordings, tmp_path, text).exit_code == 1
        scenarios = [call.args[0].options.scenarios for call in design_taps.call_args_list]
        return [(ranges.resonance_percent, ranges.gain_percent) for ranges in scenarios]

    stated = SPEC.format(percent=3.0)
    assert tried(stated) == [(1.0, 0.0)]
    assert tried(without_stated_ranges(stated)) == [(5.0, 1.5), (5.0, 0.0), (2.0, 0.0), (1.0, 0.0), (0.0, 0.0)]


@pytest.mark.parametrize(("settling_ms", "gain_percent"), [(1.2, 1.5), (1.1, 0.0)])
def test_taps_that_a_range_of_the_gain_makes_too_slow_are_not_taken(
    recordings, tmp_path, monkeypatch, settling_ms: float, gain_percent: float
) -> None:
    monkeypatch.setattr("rtloop.design.robust.chain.design_taps", Mock(return_value=Mock(settling_ms=1.15)))
    monkeypatch.setattr("rtloop.design.robust.chain.taps_provenance", lambda *_: [])
    monkeypatch.setattr("rtloop.design.robust.chain.taps_values", lambda _: {"taps": [1.0]})
    print_taps = Mock()
    monkeypatch.setattr("rtloop.cli.auto.print_taps", print_taps)
    text = without_stated_ranges(SPEC.format(percent=3.0))
    design_auto(recordings, tmp_path, text.replace("[specification]", f"[specification]\nsettling_ms = {settling_ms}"))
    assert print_taps.call_args.args[1].options.scenarios.gain_percent == gain_percent


def modal_transfer(hz, damping, gain) -> Transfer:
    """Return Σ g ω²/(s² + 2ζω s + ω²), added by numpy's polynomials."""
    omega = 2 * np.pi * np.array(hz)
    denominators = [np.poly1d([1.0, 2 * z * w, w**2]) for z, w in zip(damping, omega, strict=True)]
    numerator = np.poly1d([0.0])
    for i, w in enumerate(omega):
        other_factors = [factor for k, factor in enumerate(denominators) if k != i]
        numerator += math.prod(other_factors, start=np.poly1d([gain[i] * w**2]))
    poles = np.concatenate([factor.roots for factor in denominators])
    return Transfer.from_zpk(numerator.roots, poles, numerator.coeffs[0])


def test_of_many_light_modes_those_that_stand_out_move_by_themselves() -> None:
    hz, damping, gain = [200.0, 500.0, 900.0, 1500.0], [0.02, 0.02, 0.003, 0.02], [0.9, 0.02, 0.06, 0.02]
    family = Family(modal_transfer(hz, damping, gain), 1, ScenarioOptions(), PERIOD_S)
    assert family.leading == (0, 2)  # heights of the peaks, g/2ζ: 22, 0.5, 10, 0.5
    shifts = {scenario.resonance for scenario in family.corner_scenarios()}
    assert {(10.0, 0.0, -10.0, 0.0), (-10.0, 0.0, 10.0, 0.0), (10.0,) * 4, (-10.0,) * 4} <= shifts
    assert all(shift[1] == shift[3] == 0 or len(set(shift)) == 1 for shift in shifts)
    random_scenarios = family.random_scenarios(20, 0)  # each mode has a shift of its own here
    assert np.all([len(set(scenario.resonance)) == 4 for scenario in random_scenarios])
    bands = family.bands / (2 * np.pi)
    expected = [[110.0, np.sqrt(200 * 500)], [np.sqrt(500 * 900), np.sqrt(900 * 1500)]]
    np.testing.assert_allclose(bands, expected, rtol=1e-9)


def test_a_pole_beyond_reach_in_s_is_a_finite_one_that_answers_alike_at_the_ticks() -> None:
    """Identification models a delay of a part of a tick by a pole at z ≈ 0, here at −1e25 rad/s."""
    rates = np.array([-1e25, complex(-100.0, 5000.0), complex(-100.0, -5000.0)])
    residues = np.array([[0.3, 0.1 - 0.2j, 0.1 + 0.2j]])
    finite_rates, finite_residues = _limit_fast_rates(rates, residues, PERIOD_S)
    assert -20 / PERIOD_S < finite_rates[0].real < -10 / PERIOD_S
    np.testing.assert_array_equal(finite_rates[1:], rates[1:])
    z = np.exp(2j * np.pi * np.geomspace(1.0, 4900.0, 30) * PERIOD_S)

    def response(poles, modal_residues):
        return np.sum(modal_residues[0] / (z[:, None] - np.exp(poles * PERIOD_S)), axis=1)

    np.testing.assert_allclose(response(finite_rates, finite_residues), response(rates, residues), rtol=1e-5)


BOUC_WEN_ODD = 9


def test_an_actuator_that_is_no_sum_of_plays_gets_no_promise(tmp_path) -> None:
    """The refusal names the cause and the option that allows the design."""
    rig = noisy_rig(BOUC_WEN_ODD)
    assert rig.bouc_wen is not None
    sine = record(tmp_path / "sine.mcap", rig.configuration(sine=True), round(SINE_S * 1000))[0]
    steps = record(tmp_path / "steps.mcap", rig.configuration(sine=False), round(STEPS_S * RATE_HZ))[0]
    result = design_auto([str(sine), str(steps)], tmp_path, SPEC.format(percent=3.0))
    assert result.exit_code == 1
    assert "no sum of play operators describes the actuator" in result.stderr
    assert "simulation.residual_percent" in result.stderr
    assert not (tmp_path / "made.toml").exists()
    output = CliRunner().invoke(main, ["identify", "hysteresis", str(sine)]).stdout
    assert "no sum of play operators describes the actuator" in output
    assert "creep" not in output
