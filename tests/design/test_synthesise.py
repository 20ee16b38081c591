"""Synthesis turns the paper's data into the paper's controller; errors name the requirement that cannot be met."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.analysis.closed_loop import continuous_loop, realise_transfer
from rtloop.analysis.step_response import position_after_step
from rtloop.cli import main
from rtloop.design.paper import PAPER_C, PAPER_D
from rtloop.design.synthesis.hinf.augment import Matrices, augment
from rtloop.design.synthesis.synthesise import synthesise
from rtloop.design.synthesis.weights import PAPER_WEIGHTS, tracking_weight
from rtloop.laws.shipped.options import TransferControllerOptions
from tests.design.plants import dense_norm

SPEC = Path(__file__).resolve().parents[2] / "deploy" / "paper-spec.toml"
TEXT = SPEC.read_text(encoding="utf-8")
PAPER = synthesise(PAPER_D, PAPER_WEIGHTS, order=5)


def numbers_of_eq_20(controller) -> dict[str, float]:
    """Return the numbers that eq (20) prints: gain, and the coefficients of each factor."""
    zeros, poles = np.sort_complex(controller.zeros), np.sort_complex(controller.poles)
    real = poles[poles.imag == 0].real
    upper_zeros, pair = zeros[zeros.imag > 0], poles[poles.imag > 0][0]
    first, second = upper_zeros[np.argsort(np.abs(upper_zeros))]
    return {
        "gain": controller.gain, "far zero": -zeros[zeros.imag == 0].real[0],
        "zeros 1, s": -2 * first.real, "zeros 1, 1": abs(first) ** 2,
        "zeros 2, s": -2 * second.real, "zeros 2, 1": abs(second) ** 2,
        "far pole": -real[0], "pole": -real[1], "slow pole": -real[2],
        "poles, s": -2 * pair.real, "poles, 1": abs(pair) ** 2,
    }  # fmt: skip


EQ_20 = {
    "gain": 0.016, "far zero": 7.9e6, "zeros 1, s": 971, "zeros 1, 1": 4.6e5, "zeros 2, s": 43, "zeros 2, 1": 1.4e7,
    "far pole": 8.8e4, "pole": 974, "slow pole": 1, "poles, s": 1153, "poles, 1": 1.6e7,
}  # fmt: skip


@pytest.mark.parametrize("name", EQ_20)
def test_the_papers_controller_from_the_papers_data(name) -> None:
    """Reduced from order 11 to 5 by residualisation: each number of eq (20) within 7 %."""
    assert (PAPER.full.order, PAPER.controller.order) == (11, 5)
    assert numbers_of_eq_20(PAPER.controller)[name] == pytest.approx(EQ_20[name], rel=0.07)


def test_the_step_is_that_of_the_printed_controller() -> None:
    computed, printed = continuous_loop(PAPER.controller, PAPER_D), continuous_loop(PAPER_C, PAPER_D)
    assert computed.is_stable
    times = np.linspace(0, 0.03, 301)
    assert max(abs(position_after_step(computed, t) - position_after_step(printed, t)) for t in times) < 0.02


def test_truncation_has_no_direct_part_and_residualisation_has() -> None:
    assert PAPER.full.high_frequency_gain == 0
    assert synthesise(PAPER_D, PAPER_WEIGHTS, order=5, reduction="truncate").controller.high_frequency_gain == 0
    assert PAPER.controller.high_frequency_gain == pytest.approx(0.016, rel=0.07)
    assert PAPER.controller.dc_gain == pytest.approx(PAPER.full.dc_gain, rel=1e-9)


def test_the_order_is_the_lowest_that_loses_little() -> None:
    """The oracle of the reported norm is a dense grid of frequencies."""
    standard = augment(PAPER_D, PAPER_WEIGHTS)
    for loss, order in ((0.1, 5), (0.005, 8), (1e-5, 10)):
        synthesis = synthesise(PAPER_D, PAPER_WEIGHTS, largest_loss=loss)
        a, b, c, d = realise_transfer(synthesis.controller)
        norm = dense_norm(*standard.close_loop(Matrices(a, b[:, None], c[None], np.array([[d]]))))
        assert synthesis.controller.order == order
        assert norm == pytest.approx(synthesis.achieved, rel=1e-4)
        assert norm <= (1 + loss) * synthesis.hinf.gamma * (1 + 1e-5)


def test_poles_at_1_beside_1e5_survive() -> None:
    """Synthesis at once over eight decades: the full controller keeps its γ, the reduced one its static gain."""
    weights = PAPER_WEIGHTS._replace(tracking=tracking_weight(1e-5, 1e3, 0.0))
    synthesis = synthesise(PAPER_D, weights, order=6)
    assert synthesis.hinf.achieved <= 1.002 * synthesis.hinf.gamma
    assert synthesis.controller.dc_gain == pytest.approx(synthesis.full.dc_gain, rel=1e-8)


def run(*arguments: str):
    """Run `rtloop design synthesise` in this process; return the result of the command."""
    return CliRunner().invoke(main, ["design", "synthesise", *arguments])


def test_the_command_writes_a_section_that_a_configuration_reads(tmp_path) -> None:
    out = tmp_path / "controller.toml"
    result = run(str(SPEC), "--out", str(out), "--json")
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert report["gamma_opt"] == pytest.approx(1.6761, abs=2e-3)
    text = out.read_text(encoding="utf-8")
    assert "from paper-spec.toml" in text
    assert "γ_opt = 1.676" in text
    controller = TransferControllerOptions.model_validate(tomllib.loads(text)["axis"][0]["controller"]).transfer()
    assert [[root.real, root.imag] for root in controller.poles] == report["poles"]
    assert controller.gain == report["gain"]
    printed = run(str(SPEC))
    assert printed.exit_code == 0
    reread = TransferControllerOptions.model_validate(tomllib.loads(printed.stdout)["axis"]["controller"]).transfer()
    assert reread.poles.tolist() == controller.poles.tolist()
    assert reread.zeros.tolist() == controller.zeros.tolist()


@pytest.mark.parametrize(
    ("old", "new", "code", "message"),
    [
        ('rule = "printed"', 'rule = "implied"', 1, "Relax the hardest requirement: disturbance"),
        ("command_um = 40.0", "command_um = 30.0", 1, "allowed: at least 39.5305 µm, or a smaller reference_um"),
        ("settling_ms = 3.0  ", "settling_ms = 0.003  ", 1, "tracking (ten times slower)"),
        ("order = 5 ", "order = 4 ", 78, "the loop is unstable or has max |S| above 3; use a higher order"),
        ("order = 5 ", "order = 12 ", 78, "0 modes that are not stable: 0 to 11"),
        ("static_error_percent = 0.1", "static_error_percent = 0.0", 78, "greater than 0"),
        ("settling_ms = 3.0  ", "settling_mS = 3.0  ", 78, "did you mean settling_ms?"),
        ("settling_ms = 3.0  ", "# ", 78, "specification.settling_ms, bandwidth_hz: both missing"),
        ("\n[plant]", "\n[plants]", 78, "did you mean plant?"),
        ("gain = -20.7", "gain = 0.0", 1, "the plant's gain at 0 Hz is 0"),
        (
            "[1.0, 55.0, 1.4e7]",
            "[1.0, 0.0, 1.4e7]",
            1,
            "imaginary-axis zero: the path from w to y has a zero at ω = 3741.66",
        ),
        (
            "numerator = [[1.0, -1.22e5],",
            "numerator = [[1.0, 1.0], [1.0, -1.22e5],",
            78,
            "allowed: fewer zeros than poles",
        ),
        ("settling_ms = 3.0  ", "settling_ms = ", 78, "not valid TOML"),
    ],
)
def test_bad_specifications_say_what_would_help(tmp_path, old, new, code, message) -> None:
    spec = tmp_path / "spec.toml"
    assert TEXT.count(old) == 1
    spec.write_text(TEXT.replace(old, new), encoding="utf-8")
    result = run(str(spec))
    assert result.exit_code == code, result.stderr
    assert message in result.stderr
    assert "Traceback" not in result.output


def test_a_plant_that_no_command_stabilises_is_named(tmp_path) -> None:
    """A zero of the plant cancels the unstable mode."""
    spec = tmp_path / "spec.toml"
    start, end = TEXT.index("gain = -20.7"), TEXT.index("[specification]")
    plant = "gain = 1.2e6\nnumerator = [[1.0, -5.0]]\ndenominator = [[1.0, -5.0], [1.0, 300.0], [1.0, 4e3]]\n"
    spec.write_text(TEXT[:start] + plant + TEXT[end:], encoding="utf-8")
    result = run(str(spec))
    assert result.exit_code == 1
    assert "the mode at s = 5 rad/s, which is not stable" in result.stderr


def test_missing_files_and_folders(tmp_path) -> None:
    assert run(str(tmp_path / "none.toml")).exit_code == 66
    (tmp_path / "file").write_text("")
    assert run(str(SPEC), "--out", str(tmp_path / "file" / "c.toml")).exit_code == 73


def test_the_cross_check_names_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "slycot", None)
    result = run(str(SPEC), "--cross-check")
    assert result.exit_code == 78
    assert "pip install 'rtloop[slycot]'" in result.stderr
