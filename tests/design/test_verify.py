"""Verification of the paper's loop: golden values of an independent computation, verdicts, robustness, report files."""

import json
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.analysis.closed_loop import continuous_loop, discrete_loop
from rtloop.analysis.perturbation import changes as robust_changes
from rtloop.analysis.perturbation import maker, until_unstable, with_damping_changed, with_gain_changed
from rtloop.cli import main
from rtloop.design.paper import PAPER_C, PAPER_D
from rtloop.design.synthesis.specification import SensorOptions, SpecificationOptions
from rtloop.design.verification.judgement import Limit, described, held_up_to, specified
from rtloop.design.verification.robustness import delay_margin_us, delay_ticks_tolerated, until_missed
from rtloop.linear.discretise import discretise
from rtloop.linear.transfer import Transfer

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
PAPER_LOOP = continuous_loop(PAPER_C, PAPER_D)
RUNNING = discretise(PAPER_C, 1e-4, "tustin", 595.5)


def run(*arguments: str):
    return CliRunner().invoke(main, ["design", "verify", *arguments])


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The paper's configuration, with its pages."""
    out = tmp_path_factory.mktemp("verification")
    result = run(str(DEPLOY / "paper.toml"), "--out", str(out), "--json")
    assert result.exit_code == 1, result.stderr  # the answer is no
    return json.loads(result.stdout), out


@pytest.mark.parametrize(
    ("name", "value", "tolerance", "met", "claim"),
    [
        ("static_error_percent", 0.166384, 1e-5, False, "negligible"),
        ("settling_ms", 4.14, 5e-3, False, "< 2 ms"),
        ("overshoot_percent", 0.66, 5e-3, False, "0 %"),
        ("peak_command", 1.3555, 2e-3, False, "≤ 1"),
        ("disturbance_hz", 2.9, 0.05, False, "negligible"),
        ("max_re_pole", -32.0636, 1e-3, None, None),
        ("crossover_hz", 94.53, 0.05, None, None),
        ("phase_margin_deg", 75.54, 0.05, None, None),
        ("gain_margin", 2.529, 5e-3, None, None),
        ("max_sensitivity", 1.6685, 2e-3, None, None),
        ("modulus_margin", 1 / 1.6685, 1e-3, None, None),
        ("sensitivity_1hz", 0.0105855, 1e-6, None, None),
    ],
)
def test_the_papers_table_eqs_5_and_20(report, name, value, tolerance, met, claim) -> None:
    """In continuous time, recomputed independently from the printed factors; verdicts against section III.E.2."""
    row = next(row for row in report[0]["axes"][0]["rows"] if row["name"] == name)
    assert row["continuous"] == pytest.approx(value, abs=tolerance)
    assert (row["continuous_met"], row["claim"]) == (met, claim)


def test_the_resonance_may_move_by(report) -> None:
    """−3.9 … +2.4 % in continuous time; at 10 kHz narrower upwards, whatever the delay."""
    shifts = report[0]["axes"][0]["resonance_shift_percent"]
    assert shifts["continuous"] == pytest.approx([-3.9, 2.4], abs=0.05)
    assert list(shifts) == ["continuous", "0", "1", "2"]
    for ticks in (0, 1, 2):
        down, up = shifts[str(ticks)]
        assert down < -5
        assert 1 < up < 2
        for percent, stable in ((up - 0.02, True), (up + 0.02, False), (down + 0.02, True), (down - 0.02, False)):
            moved = robust_changes(PAPER_D)["resonance"].apply(PAPER_D, percent)
            assert discrete_loop(RUNNING, moved, ticks).is_stable == stable


def test_the_report_is_complete_and_stands_alone(report) -> None:
    found, out = report
    assert not found["meets"]
    assert {path.name for path in out.iterdir()} == {
        "verify.json", "verify.html", "x-bode.png", "x-sensitivity.png", "x-step.png",
    }  # fmt: skip
    for picture in out.glob("*.png"):
        assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    html = (out / "verify.html").read_text(encoding="utf-8")
    assert html.count("data:image/png;base64,") == 3
    assert not re.search(r'(src|href)="(?!data:)', html)
    assert "MISSED" in html
    assert json.loads((out / "verify.json").read_text(encoding="utf-8"))["axes"][0]["name"] == "x"


def test_the_terminal_shows_required_achieved_verdict_and_claim() -> None:
    result = run(str(DEPLOY / "paper.toml"))
    assert result.exit_code == 1
    line = next(line for line in result.stdout.splitlines() if line.startswith("settling"))
    assert re.split(r"\s{2,}", line.strip()) == [
        "settling (5 %)", "≤ 3 ms", "4.13851 ms", "MISSED", "4.06032 ms", "MISSED", "< 2 ms",
    ]  # fmt: skip
    assert "at 10000 Hz, 2 samples of delay" in result.stdout
    assert "the loop misses static error" in result.stdout


def test_a_specification_that_is_met(tmp_path) -> None:
    spec = tmp_path / "modest.toml"
    spec.write_text("[specification]\nsettling_ms = 5.0\novershoot_percent = 3.0\nstatic_error_percent = 0.2\n")
    result = run(str(DEPLOY / "paper.toml"), "--spec", str(spec), "--json")
    assert result.exit_code == 0, result.stderr
    axis = json.loads(result.stdout)["axes"][0]
    assert axis["meets"]
    limits = axis["robustness_percent"]["resonance"]
    assert limits["running"][0] <= limits["running_missed"][0] < 0 < limits["running_missed"][1] <= limits["running"][1]


def test_faults_of_the_user(tmp_path, monkeypatch) -> None:
    assert run(str(tmp_path / "none.toml")).exit_code == 66
    assert run(str(DEPLOY / "paper.toml"), "--spec", str(tmp_path / "none.toml")).exit_code == 66
    spec = tmp_path / "spec.toml"
    spec.write_text("[specification.claims]\nspeed = 'fast'\n")
    unknown = run(str(DEPLOY / "paper.toml"), "--spec", str(spec))
    assert unknown.exit_code == 78
    assert "claims: speed is not known" in unknown.stderr
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    missing = run(str(DEPLOY / "paper.toml"), "--out", str(tmp_path / "out"))
    assert missing.exit_code == 78
    assert "pip install 'rtloop[plot]'" in missing.stderr


def test_delay_margin_is_phase_margin_over_crossover() -> None:
    """75.54° at 94.53 Hz, eqs (5) and (20); as it runs, 21 samples and no more."""
    assert delay_margin_us(PAPER_LOOP) == pytest.approx(1e6 * 75.54 / 360 / 94.53, rel=1e-3)
    ticks = delay_ticks_tolerated(lambda ticks: discrete_loop(RUNNING, PAPER_D, ticks))
    assert discrete_loop(RUNNING, PAPER_D, ticks).is_stable
    assert not discrete_loop(RUNNING, PAPER_D, ticks + 1).is_stable
    assert ticks == int(delay_margin_us(discrete_loop(RUNNING, PAPER_D)) / 100)


def test_the_gain_may_rise_by_the_gain_margin() -> None:
    change = robust_changes(PAPER_D)["gain"]
    assert until_unstable(maker(PAPER_C), PAPER_D, change).up == pytest.approx(100 * (2.529 - 1), abs=0.5)
    assert until_unstable(maker(PAPER_C), PAPER_D, change).down is None
    assert with_gain_changed(PAPER_D, 50).dc_gain == pytest.approx(1.5 * PAPER_D.dc_gain)


def test_damping_changes_alone() -> None:
    halved = with_damping_changed(PAPER_D, -50)
    light = halved.poles[np.argmin(-halved.poles.real / np.abs(halved.poles))]
    assert -light.real / abs(light) == pytest.approx(0.5 * 27.5 / math.sqrt(1.4e7))
    assert abs(light) == pytest.approx(math.sqrt(1.4e7))
    assert halved.dc_gain == pytest.approx(PAPER_D.dc_gain)


def test_an_unstable_loop_tolerates_nothing_and_meets_nothing() -> None:
    loud = with_gain_changed(PAPER_D, 400)
    asked = SpecificationOptions(overshoot_percent=50.0)
    assert until_unstable(maker(PAPER_C), loud, robust_changes(loud)["gain"]) == (0.0, 0.0)
    values = specified(continuous_loop(PAPER_C, loud), asked)
    assert all(math.isnan(value) for value in values.values())
    limit = Limit(50.0, True)
    assert not limit.met(values["overshoot_percent"])
    gain = robust_changes(loud)["gain"]
    assert until_missed(maker(RUNNING), loud, gain, asked, {"overshoot_percent": limit}) == (0.0, 0.0)


def test_noise_of_a_first_order_loop_in_closed_form() -> None:
    """An integrator as the plant, k as the controller: x⁺ = (1 − kT)x − kT n has rms n·√(kT/(2 − kT))."""
    integrator = Transfer.from_factors(1, [], [[1, 0]])
    loop = discrete_loop(discretise(Transfer.from_zpk([], [], 500.0), 1e-3), integrator)
    found = described(loop, SensorOptions(noise_um=0.1, resolution_um=0.0))
    assert found["noise_x_nm"] == pytest.approx(100 * math.sqrt(0.5 / 1.5), rel=1e-9)
    assert SensorOptions(resolution_um=0.012).deviation_um == pytest.approx(0.012 / math.sqrt(12))


def test_how_far_the_sensitivity_is_held_in_closed_form() -> None:
    """S = s/(s + k) stays below m up to k·m/√(1 − m²)."""
    loop = continuous_loop(Transfer.from_zpk([], [], 50.0), Transfer.from_factors(1, [], [[1, 0]]))
    assert held_up_to(loop, 0.1) == pytest.approx(50 * 0.1 / math.sqrt(0.99) / 2 / math.pi, rel=1e-9)
    assert held_up_to(loop, 1.1) == math.inf
    lag = continuous_loop(Transfer.from_zpk([], [], 4.0), Transfer.from_factors(1, [], [[1, 1]]))
    assert held_up_to(lag, 0.1) == 0.0


def test_the_sensors_lag_is_in_the_loop_that_runs() -> None:
    seen = SensorOptions(bandwidth_hz=1000.0).seen_through(PAPER_D)
    assert seen.order == PAPER_D.order + 1
    assert abs(seen.response([2000j * math.pi])[0] / PAPER_D.response([2000j * math.pi])[0]) == pytest.approx(
        math.sqrt(0.5)
    )
