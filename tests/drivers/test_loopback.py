"""The drivers' self-test: its figures on simulated wires of known gain, offset, noise and delay, and its command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from rtloop.cli import main
from rtloop.doctor.loopback import measure_pair
from tests.drivers.comedi_board import new_board, output_v, stub_library
from tests.stage_text import one_axis, wired

pytestmark = pytest.mark.system

DWELL, SETTLING = 100, 50
LSB_V = 20.0 / 65535
CONFIG = f"""
[loop]
rate_hz = 1000
[driver]
kind = "comedi"
device = "{{device}}"
library = "{{library}}"
{wired("ai0", "ao0")}
{one_axis()}
[axis.limits]
drive_v = {{drive_v}}
"""


def staircase() -> np.ndarray:
    """Return a drive in V of levels 0, 1, 0, −1 V, DWELL ticks each, with ramps of 20 ticks between them."""
    levels = np.tile([0.0, 1.0, 0.0, -1.0], 5)
    corners = np.arange(levels.size) * DWELL
    return np.interp(
        np.arange(levels.size * DWELL), np.ravel([corners, corners + DWELL - 20], "F"), np.repeat(levels, 2)
    )


def wire(drive_v: np.ndarray, gain: float, offset_v: float, delay: int, noise_v: float = 0.0) -> np.ndarray:
    """Return the input in V at the end of a wire with these properties."""
    delayed = np.concatenate([np.full(delay, drive_v[0]), drive_v[: drive_v.size - delay]])
    return gain * delayed + offset_v + np.random.default_rng(5).normal(0.0, noise_v, drive_v.size)


@pytest.mark.parametrize("delay", [1, 2, 17])
@pytest.mark.parametrize(("gain", "offset_v"), [(1.0, 0.0), (0.43, -0.2), (-2.0, 3.0)])
def test_a_wire_without_noise_is_measured_exactly(gain, offset_v, delay):
    pair = measure_pair(staircase(), wire(staircase(), gain, offset_v, delay), SETTLING)
    assert pair.gain == pytest.approx(gain, rel=1e-9)
    assert pair.offset_v == pytest.approx(offset_v, abs=1e-9)
    assert pair.noise_v == pytest.approx(0.0, abs=1e-9)
    assert pair.delay_ticks == delay


def test_noise_is_its_deviation_and_does_not_hide_the_delay():
    pair = measure_pair(staircase(), wire(staircase(), 1.0, 0.1, 3, noise_v=0.05), SETTLING)
    settled = 20 * 30
    assert pair.noise_v == pytest.approx(0.05, rel=5 / np.sqrt(2 * settled))
    assert pair.gain == pytest.approx(1.0, abs=5 * 0.05 / np.sqrt(settled * 0.5))
    assert pair.delay_ticks == 3


@pytest.mark.parametrize("noise_v", [0.0, 0.01])
def test_an_input_that_does_not_follow_has_no_delay(noise_v):
    pair = measure_pair(staircase(), wire(staircase(), 0.0, 0.7, 0, noise_v), SETTLING)
    assert pair.gain == pytest.approx(0.0, abs=0.005)
    assert pair.delay_ticks is None


def test_a_constant_drive_is_refused():
    with pytest.raises(ValueError, match="the drive did not rest at two different voltages"):
        measure_pair(np.zeros(100), np.zeros(100), 10)


@pytest.fixture
def selftest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Return a function that runs the self-test on a new board at one rate; it returns result and board."""
    monkeypatch.setattr("rtloop.doctor.selftest.MAX_RATE_TRIALS", 1)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))

    def command(*arguments: str, drive_v: float = 10.0, um_per_v: float = 10.0) -> tuple[Result, Path]:
        device, config = new_board(tmp_path / "comedi0"), tmp_path / "bench.toml"
        text = CONFIG.format(device=device, library=stub_library(), drive_v=drive_v)
        assert text.count("um_per_v = 10.0") == 1
        config.write_text(text.replace("um_per_v = 10.0", f"um_per_v = {um_per_v}"))
        return CliRunner().invoke(main, ["drivers", "--selftest", str(config), *arguments]), device

    return command


def test_a_wire_passes_and_the_output_is_parked(selftest, tmp_path):
    limits = ("--gain-tolerance", "0.001", "--offset-tolerance", str(2 * LSB_V))
    result, device = selftest("--loopback", *limits, "--json")
    report = json.loads(result.stdout)
    assert (result.exit_code, report["passed"]) == (0, True), result.stderr
    pair = report["axes"][0]
    assert abs(pair["gain"] - 1.0) < 0.001
    assert abs(pair["offset_v"]) < 2 * LSB_V
    assert pair["delay_ticks"] == 1
    assert json.loads((tmp_path / "run" / "bench.host.json").read_text())["wire_ticks"] == {"x": 1}
    assert "ao0 from -1 V to 1 V, at most 1000 V/s" in result.stderr
    assert output_v(device, 0) == pytest.approx(0.0, abs=LSB_V)
    reached = [rate["rate_hz"] for rate in report["rates"] if rate["missed_share"] <= 0.01]
    assert report["highest_rate_hz"] == max(reached, default=None)
    assert report["rates"][0]["rate_hz"] == 1000.0


def test_a_failed_loopback_is_exit_1_and_limits_of_axis_and_range_hold(selftest):
    """The loopback fails by a tolerance below the step of a code; the drive stays within ±0.5 V."""
    result, device = selftest("--loopback", "--gain-tolerance", "1e-9", drive_v=0.5)
    assert result.exit_code == 1, result.output
    assert not (device.parent / "run").exists()  # a failed loopback writes no note of the host
    assert "no loopback" in result.stdout
    assert "ao0 from -0.5 V to 0.5 V" in result.stderr
    assert output_v(device, 0) == pytest.approx(0.0, abs=LSB_V)
    assert output_v(device, 1) == pytest.approx(7.0, abs=LSB_V)  # wired to no axis


def test_without_the_option_loopback_there_is_no_verdict(selftest):
    result, _ = selftest("--amplitude", "0.5")
    assert result.exit_code == 0, result.output
    assert "no verdict" in result.stdout
    assert "sign" not in result.stdout


def test_a_position_that_falls_as_the_drive_rises_fails_without_a_loopback_too(selftest):
    """The board's wire has gain 1: the scale alone is the slope."""
    result, _ = selftest("--amplitude", "0.5", um_per_v=-5.0)
    assert result.exit_code == 1, result.output
    assert "x: the sign is wrong: the position falls by 5 µm per volt of drive" in " ".join(result.stdout.split())


def test_a_loopback_of_a_wire_says_nothing_about_the_sign_of_the_sensor(selftest):
    limits = ("--gain-tolerance", "0.001", "--offset-tolerance", str(2 * LSB_V))
    result, _ = selftest("--loopback", *limits, um_per_v=-5.0)
    assert result.exit_code == 0, result.output
    assert "sign" not in result.stdout


@pytest.mark.parametrize("amplitude", ["0", "nan", "-1"])
def test_an_invalid_amplitude_is_refused_before_an_output_moves(selftest, amplitude):
    result, device = selftest("--amplitude", amplitude)
    assert result.exit_code == 2
    assert "Invalid value for '--amplitude'" in result.stderr
    assert output_v(device, 0) == pytest.approx(7.0, abs=LSB_V)
