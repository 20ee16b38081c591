"""The commands `identify` and `design` on recordings of the real law on the simulated rig: results, files, refusals.

Oracles: the rig's own plays and poles, and a second run of the designed configuration.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

import rtloop
from rtloop.cli import main
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.design.identification.axis_recording import AxisRecording, jumps
from rtloop.hil.stages.hysteresis import RESIDUAL_WEIGHTS_UM_PER_V, THRESHOLDS_V
from tests.design.rigs import slow_sine
from tests.kernel.oracle import Hysteresis
from tests.recording.real_loop import record
from tests.service.test_run import ROOT, run
from tests.stage_text import one_axis, simulated_stage

DEPLOY = ROOT / "deploy"

CHIRP = """kind = "chirp"
amplitude = 2.0
start_hz = 5.0
end_hz = 2000.0
duration_s = 1.0
offset = 0.0
logarithmic = true"""


def loop_text(omega_rad_s: float, damping: float, limit_um: float, reference: str) -> str:
    """Return the configuration of a slow loop on a stage with one mode, with a limit of the command."""
    return f"""[loop]
rate_hz = 10000
{simulated_stage(omega_rad_s, damping, 4.3, seed=5, latency_ticks=1)}
[driver.plant.sensor]
noise_um = 0.01
{one_axis()}
[axis.limits]
command_um = {limit_um}
[axis.controller]
kind = "pid"
ki_per_s = 15.0
[axis.reference]
{reference}
"""


def invoke(*arguments: str | Path) -> Result:
    """Run the rtloop command line in this process and return its result."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def report(*arguments: str | Path) -> dict[str, Any]:
    """Run a command with --json, assert success and return the parsed output."""
    result = invoke(*arguments, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def change_config(folder: Path, name: str, *changes: tuple[str, str]) -> Path:
    """Replace (old, new) texts of a shipped configuration, write it into the folder and return its path."""
    text = (DEPLOY / name).read_text()
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / name
    path.write_text(text)
    return path


def record_config(config: Path, duration_s: float, folder: Path) -> Path:
    """Record the real law on the simulated rig in this process; return the path of the recording."""
    return record(folder / f"{config.stem}.mcap", config.read_text(), round(duration_s * loop_rate_hz(config)))[0]


def loop_rate_hz(config: Path) -> float:
    return tomllib.loads(config.read_text())["loop"]["rate_hz"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder for the files that the tests of this module share."""
    return tmp_path_factory.mktemp("identify")


@pytest.fixture(scope="module")
def sine(folder: Path) -> Path:
    """Return the path of a recording of 25 s of the slow sine."""
    return record_config(DEPLOY / "characterise.toml", 25, folder)


@pytest.fixture(scope="module")
def step(folder: Path) -> Path:
    """Return the path of a recording of the step, made by `rtloop run` in a process."""
    code, summary, _ = run(DEPLOY / "step-response.toml", "--duration", "1", "--unpaced", "--out", folder)
    assert code == 0
    return Path(summary["recording"])


@pytest.fixture(scope="module")
def section(folder: Path, sine: Path) -> Path:
    """Return the path of the TOML file with the [axis.feedforward] identified from the slow sine."""
    out = folder / "hysteresis.toml"
    result = report("identify", "hysteresis", sine, "--out", out, "--plot", folder / "hysteresis.png")
    assert result["invertible"]
    assert result["max_error_percent"] < 0.2
    assert (folder / "hysteresis.png").read_bytes().startswith(b"\x89PNG")
    return out


def test_the_hysteresis_of_a_recorded_run_is_the_rigs(section: Path) -> None:
    """The oracle: plays stepped one by one with the rig's own weights, times D(0) of eq (5)."""
    written = tomllib.loads(section.read_text())["axis"]["feedforward"]
    drive = slow_sine()[::10]
    model, truth = (
        hysteresis.run(drive)
        for hysteresis in (
            Hysteresis(written["thresholds_v"], written["weights_um_per_v"]),
            Hysteresis(THRESHOLDS_V, 1.01086419 * np.array(RESIDUAL_WEIGHTS_UM_PER_V)),
        )
    )
    assert np.abs(model - truth).max() < 0.01 * np.ptp(truth)


def test_the_dynamics_of_a_recorded_step(folder: Path, step: Path, section: Path) -> None:
    out, plot = folder / "dynamics.toml", folder / "dynamics.png"
    result = report("identify", "dynamics", step, "--hysteresis", section, "--out", out, "--plot", plot)
    light = min(result["modes"], key=lambda mode: mode["damping"])
    assert light["frequency_hz"] == pytest.approx(595.50, rel=0.005)
    assert light["damping"] == pytest.approx(0.00735, rel=0.2)
    assert result["static_gain"] == pytest.approx(1.0, abs=0.01)
    text = out.read_text()
    assert "[axis.feedforward]" in text
    assert re.search(r"SHA-256 [0-9a-f]{16}", text)
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_the_dynamics_of_a_loop_that_stays_closed(tmp_path: Path) -> None:
    """The reference excites the closed loop. A reference at rest is refused, and a limited command as the input."""
    omega = 2 * np.pi * 320.0
    text = loop_text(omega, 0.01, 42.0, CHIRP)
    path = record(tmp_path / "chirp.mcap", text, 10_000)[0]
    model = report("identify", "dynamics", path, "--order", "2", "--delay", "1", "--out", tmp_path / "model.toml")
    (mode,) = model["modes"]
    assert mode["frequency_hz"] == pytest.approx(320.0, rel=0.002)
    assert mode["damping"] == pytest.approx(0.01, rel=0.1)
    assert model["loop"] == {"from_tick": 0, "to_tick": 10_000, "outside": ["x_reference_um", "x_feed_um"]}
    printed = invoke("identify", "dynamics", path, "--order", "2", "--delay", "1").stdout
    assert "; ticks 0 to 9999, moved by x_reference_um" in printed.replace("\n", " ")  # 10,000 ticks, the first is 0
    assert "instrumental variables" in model["method"]
    assert "instrumental variables" in (tmp_path / "model.toml").read_text()
    assert invoke("export", path, "--to", "mat", "--out", tmp_path / "chirp.mat").exit_code == 0
    assert invoke("import", tmp_path / "chirp.mat", "--out", tmp_path / "again.mcap").exit_code == 0
    copy = report("identify", "dynamics", tmp_path / "again.mcap", "--input", "drive", "--order", "2", "--delay", "2")
    assert copy["modes"][0]["frequency_hz"] == pytest.approx(mode["frequency_hz"], rel=1e-5)
    open_loop = invoke("identify", "dynamics", path, "--loop", "open", "--order", "2", "--delay", "1")
    assert "instrumental variables" not in open_loop.output
    sine_text = text.replace(CHIRP, 'kind = "sine"\namplitude = 8.0\nfrequency_hz = 2.0')
    limited = record(tmp_path / "limited.mcap", sine_text.replace("command_um = 42.0", "command_um = 2.0"), 4000)[0]
    for message, *arguments in (
        ("a limit or a ramp changed the command at tick", limited, "--input", "command"),
        ("the recording has no x_wobble", path, "--outside", "x_wobble"),
        ("an imported recording has no model of the hysteresis; use --hysteresis FILE", tmp_path / "again.mcap"),
    ):
        result = invoke("identify", "dynamics", *arguments)
        assert (result.exit_code, message in result.stderr) == (1, True), result.output
    held_text = text.replace(CHIRP, 'kind = "hold"\nvalue = 8.0')
    for cause, ticks in (("no external excitation: the reference is constant", 17_000), ("needs at least 0.04 s", 300)):
        constant = record(tmp_path / f"{ticks}.mcap", held_text, ticks)[0]
        result = invoke("identify", "dynamics", path, "--order", "2", "--delay", "1", "--compare", constant)
        assert (result.exit_code, cause in result.stderr) == (1, True), result.output


def test_what_the_compensation_in_use_leaves(section: Path) -> None:
    result = report("design", "compensation", DEPLOY / "paper.toml", "--actuator", section, "--command-um", "40")
    for row in result["bounds"]:
        simulated = row["simulated_um"]
        assert max(simulated.values()) <= row["xi_um"] * (1 + 1e-9)
        assert simulated["worst_case"] == pytest.approx(row["xi_um"])


def test_an_inverse_leaves_only_the_dead_band_of_its_own_model(tmp_path: Path) -> None:
    """An inverse compensates its own model fully if the model has no dead band; eq (4) has one below 0.095 V."""
    same, different, paper = tmp_path / "same.toml", tmp_path / "other.toml", DEPLOY / "paper.toml"
    model = "[axis.feedforward]\nthresholds_v = [0.0, 1.0]\nweights_um_per_v = [{}, 0.3]\n"
    same.write_text(model.format(1.3))
    different.write_text(model.format(1.4))
    for config, actuator, is_same in ((same, same, True), (paper, paper, True), (same, different, False)):
        arguments = ("design", "compensation", config, "--actuator", actuator, "--command-um", "5")
        result = report(*arguments)
        assert result["same_model"] == is_same
        assert (result["bounds"][0]["xi_um"] < 1e-9) == (config is actuator is same)
        assert ("warning: the actuator equals the model" in invoke(*arguments).stderr) == is_same


def test_of_several_axes_the_compensation_is_that_of_the_first_as_its_help_says(tmp_path: Path) -> None:
    actuator = tmp_path / "two.toml"
    axis = '[[axis]]\nname = "{}"\n[axis.feedforward]\nthresholds_v = [0.0]\nweights_um_per_v = [{}]\n'
    actuator.write_text(axis.format("x", 2.0) + axis.format("y", 3.0))
    arguments = ("design", "compensation", DEPLOY / "two-axis.toml", "--actuator", actuator)
    weights = [report(*arguments, *option)["weights"] for option in ((), ("--axis", "x"), ("--axis", "y"))]
    assert weights[0] == weights[1] != weights[2]
    assert "[default: the first axis]" in invoke("design", "compensation", "--help").stdout


@pytest.mark.parametrize(
    "arguments",
    [
        ("design", "auto", "none.mcap", "none.mcap", "--specs", "none.toml"),
        ("identify", "hysteresis", "none.mcap"),
        ("identify", "dynamics", "none.mcap"),
        ("identify", "response", "none.mcap"),
        ("ctl", "--socket", "none.sock", "response", "x"),
        ("ctl", "--socket", "none.sock", "learn", "x", "scan.txt"),
    ],
)
def test_an_existing_file_is_refused_before_the_work(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """The command refuses before it reads a recording or connects to a service: neither of them exists here."""
    out = tmp_path / "precious"
    out.write_text("precious")
    (tmp_path / "scan.txt").write_text("0.0\n1.0\n")
    result = invoke(*(tmp_path / argument if "." in argument else argument for argument in arguments), "--out", out)
    assert (result.exit_code, out.read_text()) == (73, "precious"), result.output
    assert f"{out}: exists already" in result.stderr


def test_an_existing_file_is_not_overwritten(section: Path, sine: Path) -> None:
    before = section.read_text()
    result = invoke("identify", "hysteresis", sine, "--out", section)
    assert result.exit_code == 73
    assert f"{section}: exists already" in result.stderr
    assert section.read_text() == before


@pytest.mark.parametrize(
    ("kind", "name", "duration_s", "old", "new", "messages"),
    [
        (
            "dynamics", "step-response.toml", 0.3, "position_um = 60.0", "position_um = 30.0",
            ("tripped at tick", "position"),
        ),
        (
            "hysteresis", "characterise.toml", 25, 'truth = "residual"',
            'truth = "residual"\n[driver.plant.adc]\nrange_v = 4.0', ("saturated: the reading stays at",),
        ),
        ("hysteresis", "characterise.toml", 25, "amplitude = 10.0", "amplitude = 0.01", ("too little excitation",)),
    ],
)  # fmt: skip
def test_a_run_that_shows_too_little_is_refused(tmp_path: Path, kind, name, duration_s, old, new, messages) -> None:
    """The run tripped, its ADC of ±4 V reads ±40 µm of ±43 µm, or its drive is too small."""
    recording = record_config(change_config(tmp_path, name, (old, new)), duration_s, tmp_path)
    result = invoke("identify", kind, recording, "--json")
    assert result.exit_code == 1
    assert all(message in json.loads(result.stdout)["error"] for message in messages)


def test_a_drive_that_is_no_slow_sine_is_named(tmp_path: Path, sine: Path, step: Path) -> None:
    """`design auto` refuses swapped recordings; `identify hysteresis` warns of a step and of a controller's drive."""
    out = tmp_path / "out.toml"
    swapped = invoke("design", "auto", step, sine, "--specs", DEPLOY / "own-stage-spec.toml", "--out", out)
    assert swapped.exit_code == 1
    assert f"the two recordings seem to be swapped: {step} has steps of the drive, {sine} has none" in swapped.stderr
    assert not out.exists()
    closed = record_config(DEPLOY / "paper.toml", 1, tmp_path)
    for recording, cause in ((closed, "a controller computed the drive"), (step, "the drive has steps"), (sine, None)):
        identified = invoke("identify", "hysteresis", recording)
        warnings = [line for line in identified.stderr.splitlines() if line.startswith("warning: ")]
        assert [line for line in warnings if f"{cause}" in line] == warnings
        assert len(warnings) == (0 if cause is None else 1), identified.output


@pytest.mark.parametrize("more", [(), ("--robust",)])
def test_an_imported_step_is_refused_because_it_has_no_configuration(
    tmp_path: Path, sine: Path, step: Path, more
) -> None:
    out, imported = tmp_path / "out.toml", tmp_path / "step.mcap"
    assert invoke("export", step, "--to", "mat", "--out", tmp_path / "step.mat").exit_code == 0
    assert invoke("import", tmp_path / "step.mat", "--out", imported).exit_code == 0
    arguments = ("design", "auto", sine, imported, "--specs", DEPLOY / "own-stage-spec.toml", "--out", out, *more)
    result = invoke(*arguments)
    assert (result.exit_code, out.exists()) == (1, False), result.output
    assert f"{imported}: an imported recording has no configuration" in result.stderr
    assert "Record the step with `rtloop run`" in result.stderr


@pytest.mark.parametrize(
    ("drive_v", "is_stepped"),
    [
        (np.sin(np.arange(200)), False),  # a sine with six samples in a period is never slow and has no step
        (np.repeat([0.0, 5.0, 0.0], 100), True),
        (np.repeat(np.linspace(0.0, 1.0, 11), 20), False),  # a staircase in tenths of its span
        (np.linspace(0.0, 1.0, 200), False),
    ],
)
def test_a_step_is_a_change_between_two_rests(drive_v: Any, is_stepped: bool) -> None:
    run = AxisRecording("made", 1e-3, drive_v, drive_v, drive_v, True, "", "")
    assert jumps(run) == is_stepped


def test_mistakes_end_with_their_exit_codes(tmp_path: Path, sine: Path, section: Path) -> None:
    broken = tmp_path / "broken.toml"
    broken.write_text("[axis.feedforward]\nthresholds_v = [0.0, 1.0]\nweights_um_per_v = [1.0, -2.0]\n")
    unequal = tmp_path / "unequal.toml"
    unequal.write_text("[axis.feedforward]\nthresholds_v = [0.0, 1.0]\nweights_um_per_v = [1.0]\n")
    missing, paper = tmp_path / "nothing.mcap", DEPLOY / "paper.toml"
    for code, message, *arguments in (
        (66, "nothing.mcap", "identify", "hysteresis", missing),
        (66, "no axis 'y'; select one of x", "identify", "hysteresis", sine, "--axis", "y"),
        (2, "numbers separated by commas", "identify", "hysteresis", sine, "--thresholds", "a,b"),
        (78, "allowed: ascending numbers, 0 or more", "identify", "hysteresis", sine, "--thresholds", "2,1"),
        (78, "needs another recording for the validation", "identify", "dynamics", sine, "--criterion", "validation"),
        (78, "allowed: every partial sum above 0", "design", "compensation", broken, "--actuator", section),
        (78, "thresholds and", "design", "compensation", paper, "--actuator", unequal),
    ):
        result = invoke(*arguments)
        assert (result.exit_code, message in result.stderr) == (code, True), (arguments, result.output)
        assert "Traceback" not in result.output


@pytest.mark.usefixtures("few_simulated_steps")
def test_one_command_makes_a_configuration_that_runs_as_promised(folder: Path, sine: Path, step: Path) -> None:
    """`design auto` writes a configuration; its step on the rig follows the step promised for the identified model.

    The position agrees within 5 % of the step at each promised time, the settling time within 1.5 ms.
    """
    out = folder / "my.toml"
    result = invoke("design", "auto", sine, step, "--specs", DEPLOY / "paper-spec.toml", "--out", out, "--json")
    verdict = json.loads(result.stdout)
    assert result.exit_code == (0 if verdict["meets"] else 1)
    text = out.read_text()
    prepared = prepare(parse(text, "my", folder, str(out)))
    running = prepared.checks[0].running
    assert running is not None
    assert running.stable
    stepping = out.with_name("stepping.toml")
    reference = tomllib.loads(text)["axis"][0]["reference"]
    assert (reference["kind"], reference["levels"]) == ("steps", [10.0, 0.0])
    stepping.write_text(text.replace("levels = [10.0, 0.0]", "levels = [0.0, 20.0]"))
    stepping.write_text(re.sub(r"dwell_s = [0-9.]+", "dwell_s = 0.5", stepping.read_text()))
    code, summary, _ = run(stepping, "--duration", "1", "--unpaced", "--out", folder)
    assert code == 0
    assert summary["trips"] == []
    recording = rtloop.load(summary["recording"])
    position = recording["x_true_position_um"][5000:] / 20
    for time_s, promised in zip(running.step_times_s, running.step_position, strict=True):
        assert position[round(time_s * 10_000)] == pytest.approx(promised, abs=0.05)
    outside_band = np.flatnonzero(np.abs(position / np.mean(position[-500:]) - 1) > 0.05)
    settling_s = (outside_band[-1] + 1) * 1e-4
    print(f"settling {1e3 * settling_s:.2f} ms, promised {1e3 * running.settling_time_s:.2f} ms")
    assert settling_s == pytest.approx(running.settling_time_s, abs=1.5e-3)
    assert 100 * (position.max() - 1) < running.overshoot_percent + 3.0
