"""Strictly proper textbook plants of one and two modes: from a specification to a configuration that runs."""

import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from rtloop.cli import main
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.design.synthesis.synthesise import synthesise
from rtloop.design.synthesis.weights import PAPER_WEIGHTS
from rtloop.linear.transfer import Transfer

RATE_HZ = 10_000.0
HALF_RATE_RAD_S = math.pi * RATE_HZ
ONE_MODE = [(800.0, 0.02)]
TWO_MODES = [(800.0, 0.02), (1600.0, 0.02)]
NOT_STRONGLY_STABILISABLE = Transfer.from_zpk([10.0], [50.0, -100.0], 50.0)
"""A real pole between a zero and infinity, all on the right: every stabilising controller is unstable (Youla, Bongiorno
& Lu, Automatica 10, 1974)."""


def quadratic_factors(modes: list[tuple[float, float]]) -> list[list[float]]:
    """Return the coefficients of s² + 2ζω s + ω² for each mode (Hz, ζ)."""
    return [[1.0, 4 * math.pi * hz * damping, (2 * math.pi * hz) ** 2] for hz, damping in modes]


def write_specification(
    folder: Path, modes: list[tuple[float, float]], settling_ms: float = 3.0, delay_ticks: int = 0
) -> Path:
    """Write a specification like the paper's for a plant of static gain 1; return the path of the file."""
    denominator = quadratic_factors(modes)
    path = folder / "spec.toml"
    path.write_text(
        f'[plant]\nform = "factors"\ngain = {math.prod(factor[-1] for factor in denominator)!r}\nnumerator = []\n'
        f"denominator = {denominator}\ndelay_ticks = {delay_ticks}\n"
        f"[specification]\novershoot_percent = 0.0\nstatic_error_percent = 0.1\nsettling_ms = {settling_ms}\n"
        "[specification.disturbance]\nlargest_um = 3.285\nerror_um = 0.1\n"
        "[specification.command]\nreference_um = 40.0\ncommand_um = 40.0\n",
        encoding="utf-8",
    )
    return path


def run(*arguments: str | Path) -> Result:
    """Run the rtloop command line in this process and return its result."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.mark.parametrize("modes", [ONE_MODE, TWO_MODES], ids=["one mode", "two modes"])
@pytest.mark.parametrize("delay_ticks", [0, 3])
def test_what_is_written_passes_check(tmp_path, modes, delay_ticks) -> None:
    """`prepare` raises an error for every fault that `check` refuses. Warnings are errors in tests: none is printed."""
    out = tmp_path / "written.toml"
    result = run("design", "synthesise", write_specification(tmp_path, modes, 8.0, delay_ticks), "--out", out)
    assert result.exit_code == 0, result.output
    (check,) = prepare(load(out)).checks
    assert check.running is not None
    assert check.running.stable
    assert check.running.delay_ticks == delay_ticks


@pytest.mark.parametrize("modes", [ONE_MODE, TWO_MODES], ids=["one mode", "two modes"])
def test_roots_far_beyond_the_rate_are_not_written_and_the_band_is_kept(tmp_path, modes) -> None:
    """The oracle is the controller with all its roots: its gain at 0 Hz and its response up to half the rate."""
    result = run("design", "synthesise", write_specification(tmp_path, modes), "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    zeros, poles = (np.array([complex(*root) for root in report[name]]) for name in ("zeros", "poles"))
    assert max(np.abs(zeros).max(), np.abs(poles).max()) < 1000 * HALF_RATE_RAD_S
    denominator = quadratic_factors(modes)
    plant = Transfer.from_factors(math.prod(factor[-1] for factor in denominator), [], denominator)
    weights = PAPER_WEIGHTS._replace(disturbance=Transfer.from_zpk([-1.0], [-1000.0], 0.1 / 3.285))
    reference = synthesise(plant, weights).controller
    s = 1j * np.concatenate([[0.0], np.geomspace(1.0, HALF_RATE_RAD_S, 500)])
    written = Transfer.from_zpk(zeros, poles, report["gain"]).response(s)
    error = np.abs(written - reference.response(s)) / np.abs(reference.response(s))
    assert error[0] < 1e-6
    assert error.max() < 2e-3


def test_a_plant_that_only_an_unstable_controller_stabilises() -> None:
    """The search for the order begins at the number of unstable modes, which reduction keeps."""
    synthesis = synthesise(NOT_STRONGLY_STABILISABLE, PAPER_WEIGHTS)
    assert np.sum(synthesis.full.poles.real > 0) == 1
    assert np.sum(synthesis.controller.poles.real > 0) == 1
    assert np.isfinite(synthesis.achieved)


def test_the_file_holds_an_axis_that_a_running_service_can_take_the_controller_from(tmp_path) -> None:
    """`rtloop ctl controller` reads the axis of a whole configuration."""
    out = tmp_path / "written.toml"
    spec = write_specification(tmp_path, ONE_MODE)
    assert run("design", "synthesise", spec, "--out", out, "--axis", "z").exit_code == 0
    (axis,) = load(out).axes
    assert axis.name == "z"
    assert axis.controller is not None
    section = tomllib.loads(run("design", "synthesise", spec).stdout)["axis"]["controller"]
    assert section["poles"] == [list(root) for root in axis.controller.poles]


def test_what_does_not_run_is_refused_with_what_would_help(tmp_path) -> None:
    """The loop cannot settle within 2 ms behind 16 samples of delay."""
    spec = write_specification(tmp_path, ONE_MODE, 2.0, 16)
    result = run("design", "synthesise", spec)
    assert result.exit_code == 1
    assert "settling" in result.stderr
    assert "Traceback" not in result.output


def test_a_plant_of_repeated_poles_gets_a_rig_that_takes_them(tmp_path) -> None:
    out, spec = tmp_path / "written.toml", write_specification(tmp_path, ONE_MODE)
    text = spec.read_text(encoding="utf-8")
    start, end = text.index("gain ="), text.index("[specification]")
    plant = (
        "gain = 1e24\nnumerator = []\ndenominator = [[1.0, 1e6], [1.0, 1e6], [1.0, 2000.0, 1e6], [1.0, 1000.0, 1e6]]\n"
    )
    spec.write_text(text[:start] + plant + text[end:], encoding="utf-8")
    result = run("design", "synthesise", spec, "--out", out)
    assert result.exit_code == 0, result.output
    assert prepare(load(out)).checks[0].running is not None
