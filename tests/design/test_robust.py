"""Robust controllers: scenarios, search, proof and command, compared with plants that scipy samples independently."""

import contextlib
import json
import tomllib

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import signal

from rtloop.analysis.closed_loop import sampled_plant
from rtloop.cli import main
from rtloop.design.robust import certificate
from rtloop.design.robust.certificate import certify
from rtloop.design.robust.controller import build_candidates, point_bounds, point_transfer
from rtloop.design.robust.objective import Objective, Walls
from rtloop.design.robust.options import ScenarioOptions
from rtloop.design.robust.scenarios import Family, Scenario, light_modes
from rtloop.design.robust.search import find_robust_controller, minimise
from rtloop.design.robust.section import robust_configuration
from rtloop.design.synthesis.hinf.assumptions import NoController
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.design.toml_text import write_section
from rtloop.linear.discretise import discretise_controller
from rtloop.linear.transfer import Transfer
from tests.stage_text import resonance

PERIOD_S = 1e-4
OMEGA, RATIO = 2 * np.pi * 600.0, 0.01
STAGE = Transfer.from_factors(OMEGA**2, [], [[1.0, 2 * RATIO * OMEGA, OMEGA**2]])
WALLS = Walls(2.0, 3.0, 0.1, 5.0)
RANGE = ScenarioOptions(resonance_percent=8.0, damping=(0.5, 2.0), gain_percent=5.0)
SPEC = f"""
[plant]
{resonance(OMEGA, RATIO)}delay_ticks = 0
[specification]
overshoot_percent = 0.5
[specification.disturbance]
largest_um = 1.0
error_um = 0.1
up_to_hz = 5.0
[specification.command]
reference_um = 20.0
command_um = 21.0
[scenarios]
resonance_percent = 8.0
damping = [0.5, 2.0]
gain_percent = 5.0
[robust]
biquads = 1
restarts = 2
generations = 80
"""


def sample_stage(gain_percent: float, shift_percent: float, factor: float, delay_ticks: int):
    """Return numerator and denominator of G(z) of the changed stage, by scipy."""
    omega, damping = OMEGA * (1 + shift_percent / 100), RATIO * factor
    changed_stage = ([(1 + gain_percent / 100) * omega**2], [1.0, 2 * damping * omega, omega**2])
    numerator, denominator, _ = signal.cont2discrete(changed_stage, PERIOD_S, method="zoh")
    return np.trim_zeros(numerator[0], "f"), np.append(denominator, np.zeros(delay_ticks))


def evaluate(polynomials, z):
    """Return the value of the quotient of two polynomials (numerator, denominator) at z."""
    return np.polyval(polynomials[0], z) / np.polyval(polynomials[1], z)


def matched_polynomials(controller: Transfer):
    """Return numerator and denominator of C(z), discretised from the controller by "matched"."""
    discrete = discretise_controller(controller, PERIOD_S, "matched")
    return discrete.gain * np.real(np.poly(discrete.zeros)), np.real(np.poly(discrete.poles))


def loop_polynomial(controller, plant):
    """Return the characteristic polynomial of the closed loop."""
    return np.polyadd(np.polymul(controller[1], plant[1]), np.polymul(controller[0], plant[0]))


def noise_gain(controller, plant) -> float:
    """Return the rms of v per rms of white noise: the norm of the impulse response of C/(1 + L)."""
    numerator, denominator = np.polymul(controller[0], plant[1]), loop_polynomial(controller, plant)
    numerator = np.concatenate([np.zeros(denominator.size - numerator.size), numerator])
    return float(np.linalg.norm(signal.lfilter(numerator, denominator, np.eye(1, 20_000)[0])))


def peak_sensitivity(controller, plant) -> float:
    """Return max |S| on a dense grid."""
    z = np.exp(1j * np.linspace(1e-3, np.pi, 100_000))
    return float(np.max(1 / np.abs(1 + evaluate(controller, z) * evaluate(plant, z))))


def decay_ms(controller, plant) -> float:
    """Return the time constant (ms) of the slowest closed-loop mode between 0.55 and 1.85 times the resonance."""
    poles = np.roots(loop_polynomial(controller, plant))
    relative_omega = np.abs(np.angle(poles)) / PERIOD_S / OMEGA
    radii = np.abs(poles[(relative_omega > 0.55) & (relative_omega < 1.85)])
    return float(np.max(-1e3 * PERIOD_S / np.log(radii), initial=0.0))


def random_point(random) -> np.ndarray:
    """Return a random point of the search for a controller with two biquads, within the bounds."""
    low, high = point_bounds(2)
    return np.clip(np.array([-3.0, -3.0, *([-1.0, 0.5, -0.8, -0.5] * 2)]) + 0.4 * random.standard_normal(10), low, high)


@pytest.mark.parametrize("delay_ticks", [0, 1, 3])
def test_a_scenario_is_the_plant_with_its_resonance_damping_gain_and_delay_changed(delay_ticks) -> None:
    family = Family(STAGE, 0, RANGE, PERIOD_S)
    changed = sampled_plant(family.plant(Scenario((7.0,), 0.5, -4.0, delay_ticks)), PERIOD_S, delay_ticks)
    z = np.exp(2j * np.pi * np.geomspace(1.0, 4900.0, 60) * PERIOD_S)
    np.testing.assert_allclose(changed.response(z), evaluate(sample_stage(-4.0, 7.0, 0.5, delay_ticks), z), rtol=1e-8)


def test_modes_that_are_damped_or_beyond_half_the_rate_do_not_move() -> None:
    poles = [*np.roots([1, 0.02 * 3000, 3000.0**2]), *np.roots([1, 2000, 2000.0**2]), *np.roots([1, 500, 4e4**2])]
    model = Transfer.from_zpk([], poles, 1.0)
    assert np.abs(light_modes(model, PERIOD_S)) == pytest.approx([3000.0])
    changed = Family(model, 0, RANGE, PERIOD_S).plant(Scenario((5.0,), 1.0, 0.0, 0))
    assert sorted(np.abs(changed.poles)) == pytest.approx([2000.0] * 2 + [3150.0] * 2 + [4e4] * 2)
    assert changed.dc_gain == pytest.approx(model.dc_gain, rel=1e-12)


def test_two_modes_move_by_themselves_in_every_combination() -> None:
    model = Transfer.from_zpk([], [*np.roots([1, 30, 3000.0**2]), *np.roots([1, 80, 8000.0**2])], 1.0)
    resonances = {scenario.resonance for scenario in Family(model, 2, RANGE, PERIOD_S).corner_scenarios()}
    assert {(-8.0, 8.0), (8.0, -8.0), (0.0, 8.0), (0.0, 0.0)} <= resonances
    assert {scenario.delay_ticks for scenario in Family(model, 2, RANGE, PERIOD_S).corner_scenarios()} == {2}
    two_delays = RANGE.model_copy(update={"delay_ticks": (0, 1)})
    assert {scenario.delay_ticks for scenario in Family(model, 2, two_delays, PERIOD_S).corner_scenarios()} == {0, 1}
    sweep = Family(model, 2, two_delays, PERIOD_S).sweep_scenarios(3)
    swept = [(scenario.delay_ticks, scenario.resonance[0]) for scenario in sweep]
    assert set(swept) == {(ticks, percent) for ticks in (0, 1) for percent in (-8.0, 0.0, 8.0)}


def test_a_search_finds_the_minimum_of_a_bent_valley_and_its_seed_alone_decides(tmp_path, monkeypatch) -> None:
    """Numpy's global generator and files in the working directory do not change the result."""

    def rosenbrock(points):
        return np.sum(100 * (points[:, 1:] - points[:, :-1] ** 2) ** 2 + (1 - points[:, :-1]) ** 2, axis=1)

    monkeypatch.chdir(tmp_path)
    (tmp_path / "cma_signals.in").write_text("{'timeout': 0}")
    points = []
    for number in range(2):
        np.random.seed(number)
        points.append(minimise(rosenbrock, np.zeros(4), 0.5, 800, np.random.default_rng(3)).point)
    assert points[0] == pytest.approx(np.ones(4), abs=1e-4)
    assert np.array_equal(*points)
    assert [path.name for path in tmp_path.iterdir()] == ["cma_signals.in"]


def test_a_search_that_finds_nothing_better_stays_where_it_started() -> None:
    result = minimise(lambda points: np.sum(points**2, axis=1), np.zeros(3), 1.0, 2, np.random.default_rng(1))
    assert (result.point.tolist(), result.cost) == ([0.0, 0.0, 0.0], 0.0)


def test_what_is_written_is_the_controller_that_was_searched() -> None:
    """C(z) by "matched" and by state matrices equals the searched C(z) at every frequency."""
    rng, z = np.random.default_rng(5), np.exp(1j * np.linspace(0.01, 3.1, 200))
    for _ in range(50):
        point = random_point(rng)
        numerator, denominator = matched_polynomials(point_transfer(point, PERIOD_S))
        np.testing.assert_allclose(
            evaluate((numerator, denominator), z), build_candidates(point[None]).response(z)[0], rtol=1e-7
        )  # fmt: skip
        a, b, c, d = (part[0] for part in build_candidates(point[None]).matrices())
        state_quotient = signal.ss2tf(a, b[:, None], c[None], np.array([[d]]))
        np.testing.assert_allclose(
            evaluate((state_quotient[0][0], state_quotient[1]), z), evaluate((numerator, denominator), z), rtol=1e-5
        )


def test_what_is_searched_is_the_worst_of_the_closed_loops() -> None:
    """The oracle has poles from polynomials of L and |S| from their ratio, one plant after the other."""
    family = Family(STAGE, 1, RANGE, PERIOD_S)
    scenarios = [family.nominal, Scenario((8.0,), 0.5, 5.0, 1), Scenario((-8.0,), 2.0, -5.0, 3)]
    objective = Objective(family, scenarios, WALLS, 2)
    rng, stable_count = np.random.default_rng(8), 0
    for _ in range(20):
        point = random_point(rng)
        point[:2] = rng.uniform(-8.0, -4.0), -0.5
        measures = objective.measure(point[None])
        controller = matched_polynomials(point_transfer(point, PERIOD_S))
        radii, decays, peaks, sensitivities_5hz = [], [], [], []
        for scenario in scenarios:
            plant = sample_stage(scenario.gain, scenario.resonance[0], scenario.damping, scenario.delay_ticks)
            radii.append(np.abs(np.roots(loop_polynomial(controller, plant))).max())
            decays.append(1e-3 * decay_ms(controller, plant))
            peaks.append(np.max(1 / np.abs(1 + evaluate(controller, objective.z) * evaluate(plant, objective.z))))
            z_5hz = np.exp(2j * np.pi * 5.0 * PERIOD_S)
            sensitivities_5hz.append(1 / np.abs(1 + evaluate(controller, z_5hz) * evaluate(plant, z_5hz)))
        assert measures.radius[0] == pytest.approx(max(radii), abs=1e-6)
        if max(radii) < 0.9999:
            stable_count += 1
            assert measures.decay_s[0] == pytest.approx(max(decays), rel=1e-4)
            assert measures.disturbance[0] == pytest.approx(max(sensitivities_5hz), rel=1e-6)
            assert measures.sensitivity[0] == pytest.approx(max(peaks), rel=1e-6)
    assert stable_count >= 3


@pytest.fixture(scope="module", autouse=True)
def reduced_proofs():
    """Reduce the plants of a proof to a few: each plant takes some ten milliseconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certificate, "SWEEP_POINTS", 5)
        patch.setattr(certificate, "RANDOM_PLANTS", 10)
        yield


@pytest.fixture(scope="module")
def solution(reduced_proofs):
    """Return the controller designed for SPEC, with its proof."""
    return find_robust_controller(DesignOptions.model_validate(tomllib.loads(SPEC)))


def test_a_controller_damps_the_resonance_and_keeps_its_walls_wherever_the_plant_lies(solution) -> None:
    """Plants between the scenarios: all stable, max |S| ≤ 2, the disturbance held, the resonance damped."""
    controller, random = matched_polynomials(solution.controller), np.random.default_rng(1)
    z_5hz = np.exp(2j * np.pi * 5.0 * PERIOD_S)
    for _ in range(20):
        plant = sample_stage(random.uniform(-5, 5), random.uniform(-8, 8), np.exp(random.uniform(*np.log([0.5, 2]))), 0)
        assert np.abs(np.roots(loop_polynomial(controller, plant))).max() < 1
        assert peak_sensitivity(controller, plant) <= 2.0 + 1e-9
        assert noise_gain(controller, plant) <= 3.0 + 1e-9
        assert 1 / np.abs(1 + evaluate(controller, z_5hz) * evaluate(plant, z_5hz)) <= 0.1 + 1e-9
        assert decay_ms(controller, plant) < 1e3 / (0.5 * RATIO * OMEGA) / 5  # uncontrolled, it decays in 53 ms


def test_a_proof_is_what_its_worst_plants_do(solution) -> None:
    proof, controller = solution.certificate, matched_polynomials(solution.controller)
    for figure, value_of in (
        (proof.noise_gain, noise_gain),
        (proof.sensitivity, peak_sensitivity),
        (proof.decay_ms, decay_ms),
    ):
        scenario = figure.scenario
        plant = sample_stage(scenario.gain, scenario.resonance[0], scenario.damping, scenario.delay_ticks)
        assert figure.value == pytest.approx(value_of(controller, plant), rel=1e-5)


def test_a_proof_names_the_plant_that_is_worst() -> None:
    """An integrator on a lightly damped mode is worst where the damping is least and the gain highest."""
    family = Family(STAGE, 0, RANGE, PERIOD_S)
    controller = discretise_controller(Transfer.from_zpk([-1e4], [0.0, -1e4 * 1.0001], 45.0), PERIOD_S, "matched")
    proof = certify(controller, family, WALLS)
    assert proof.radius.scenario.damping == 0.5
    assert proof.radius.scenario.gain == 5.0
    unstable = discretise_controller(Transfer.from_zpk([-1e4], [0.0, -1e4 * 1.0001], 200.0), PERIOD_S, "matched")
    assert "unstable with" in certify(unstable, family, WALLS).violations(WALLS, None)[0]


@pytest.mark.parametrize(("restarts", "continued"), [(1, 1), (2, 2), (5, 3)])
def test_the_lines_of_progress_count_the_searches_that_are_continued(restarts, continued) -> None:
    raw, lines = tomllib.loads(SPEC), []
    raw["robust"] |= {"generations": 4, "restarts": restarts}
    with contextlib.suppress(NoController):
        find_robust_controller(DesignOptions.model_validate(raw), lines.append)
    counts = [line.partition(":")[0] for line in lines if line.startswith("continued search")]
    assert counts == [f"continued search {number} of {continued}" for number in range(1, continued + 1)]


def test_what_cannot_be_is_refused_with_what_misses() -> None:
    raw = tomllib.loads(SPEC)
    raw["robust"] |= {"decay_ms": 0.05, "generations": 20, "restarts": 1}
    with pytest.raises(NoController, match=r"slowest mode around a resonance.* allowed: up to 0.05"):
        find_robust_controller(DesignOptions.model_validate(raw))


def test_a_search_without_a_disturbance_names_the_limits_that_it_misses() -> None:
    """The error due to the disturbance is 0 then, and its limit stays as it is for the next round."""
    raw = tomllib.loads(SPEC)
    del raw["specification"]["disturbance"]
    raw["robust"] |= {"largest_sensitivity": 1.01, "generations": 10, "restarts": 1}
    with pytest.raises(NoController, match=r"the best controller found misses limits: .*allowed: up to 1\.01"):
        find_robust_controller(DesignOptions.model_validate(raw))


@pytest.mark.parametrize(
    ("section", "key", "value", "message"),
    [
        ("scenarios", "damping", [], "damping"),
        ("scenarios", "damping", [-1.0], "factors from 0.01 to 10"),
        ("scenarios", "resonance_percent", float("nan"), "resonance_percent"),
        ("scenarios", "delay_ticks", [-1], "0 to 16 samples"),
        ("robust", "largest_sensitivity", 0.5, "greater than 1"),
        ("plant", "gain", -1.0, "a gain at 0 Hz above 0"),
    ],
)
def test_a_specification_that_cannot_be_is_a_clear_error(tmp_path, section, key, value, message) -> None:
    raw = tomllib.loads(SPEC)
    raw[section] |= {key: value}
    (tmp_path / "spec.toml").write_text(write_section("", raw))
    result = CliRunner().invoke(main, ["design", "robust", str(tmp_path / "spec.toml")])
    assert result.exit_code == 78
    assert message in result.stderr
    assert "Traceback" not in result.stderr


def test_the_command_puts_the_controller_into_a_configuration_and_keeps_its_words(tmp_path, solution) -> None:
    (tmp_path / "spec.toml").write_text(SPEC)
    design, out = DesignOptions.model_validate(tomllib.loads(SPEC)), tmp_path / "made.toml"
    text = robust_configuration(solution, design, "spec.toml", SPEC, "z", "spec.toml")
    out.write_text(text.replace("gain = ", "# a word of mine\ngain = ", 1))
    arguments = ["design", "robust", str(tmp_path / "spec.toml"), "--config", str(out)]
    result = CliRunner().invoke(main, [*arguments, "--axis", "z", "--out", str(out), "--json"])
    assert result.exit_code == 0, result.stderr
    report, axis = json.loads(result.stdout), tomllib.loads(out.read_text())["axis"][0]
    assert axis["controller"]["zeros"] == report["zeros"] == tomllib.loads(text)["axis"][0]["controller"]["zeros"]
    assert axis["controller"]["method"] == "matched"
    assert report["worst"]["sensitivity"]["value"] <= 2.0
    assert "# a word of mine" in out.read_text()
    assert out.read_text().count("# Found by") == 1
    missing = CliRunner().invoke(main, [*arguments, "--axis", "nowhere"])
    assert missing.exit_code == 78
    assert "axis: 'nowhere' is unknown; allowed: z" in missing.stderr


def test_the_command_prints_the_section_and_beside_it_the_worst_figures(tmp_path, solution, monkeypatch) -> None:
    """The section goes to stdout, the figures to stderr; with --out, a configuration that runs is written."""
    monkeypatch.setattr("rtloop.design.robust.search.find_robust_controller", lambda design, progress: solution)
    (tmp_path / "spec.toml").write_text(SPEC)
    arguments = ["design", "robust", str(tmp_path / "spec.toml")]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    controller = tomllib.loads(result.stdout)["axis"]["controller"]
    roots = {name: [complex(*pair) for pair in controller[name]] for name in ("zeros", "poles")}
    written = matched_polynomials(Transfer.from_zpk(roots["zeros"], roots["poles"], controller["gain"]))
    (sensitivity,) = (line for line in result.stderr.splitlines() if line.startswith("  max |S| "))
    worst = float(sensitivity.split()[2])
    peaks = [peak_sensitivity(written, sample_stage(gain, shift, factor, 0))
             for gain in (-5.0, 0.0, 5.0) for shift in (-8.0, 0.0, 8.0) for factor in (0.5, 1.0, 2.0)]  # fmt: skip
    assert max(peaks) == pytest.approx(worst, rel=0.02)
    out = tmp_path / "made.toml"
    written_too = CliRunner().invoke(main, [*arguments, "--out", str(out)])
    assert written_too.exit_code == 0, written_too.output
    assert f"{out} is written" in written_too.stdout
    assert tomllib.loads(out.read_text())["axis"][0]["controller"] == controller
