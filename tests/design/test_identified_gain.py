"""Imported data of another program, up to the controller's file: drive gain, delay convention, verdict of the design.

The rows come from scipy's discretised plant, whose gain, delay, resonance and damping are known.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

import rtloop
from rtloop.design.identification.axis_recording import trip_remedy
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.design.identification.frequency_response import recording_response
from rtloop.errors import ConfigError, RtloopError
from tests.command_line import answer, run

RATE_HZ, RESONANCE_HZ, DAMPING, GAIN_UM_PER_V = 20_000, 620.0, 0.03, 3.5
SPEC = """
[specification]
overshoot_percent = 1.0
settling_ms = 6.0
static_error_percent = 0.2
[controller]
rate_hz = 20000
[weights]
disturbance_rule = "none"
"""


def simulate_rows(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return drive (V) and position (µm), (count,) each, by scipy; each position is sampled before its row's drive."""
    random = np.random.default_rng(3)
    omega = 2 * np.pi * RESONANCE_HZ
    plant = signal.cont2discrete(([omega**2], [1.0, 2 * DAMPING * omega, omega**2]), 1 / RATE_HZ, "zoh")
    drive_v = signal.lfilter([0.5], [1.0, -0.5], random.normal(0.0, 0.5, count))
    position_um = signal.lfilter(plant[0].ravel(), plant[1], GAIN_UM_PER_V * drive_v)
    return drive_v, position_um + random.normal(0.0, 0.005, count)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the rows (npz), a specification, and recording, model and output per delay convention."""
    folder = tmp_path_factory.mktemp("rows")
    drive_v, position_um = simulate_rows(6000)
    time_s = np.arange(drive_v.size) / RATE_HZ
    np.savez(folder / "rows.npz", t=time_s, drive_v=drive_v, position_um=position_um)
    maps = ["--map", "x_drive_v=drive_v [V]", "--map", "x_position_um=position_um [µm]"]
    for name, options in (("together", []), ("first", ["--position-first"])):
        result = run("import", folder / "rows.npz", *maps, *options, "--out", folder / f"{name}.mcap")
        assert result.exit_code == 0, result.output
        result = run(
            "identify", "dynamics", folder / f"{name}.mcap", "--input", "drive", "--order", "2", "--out",
            folder / f"{name}.toml",
        )  # fmt: skip
        assert result.exit_code == 0, result.output
        (folder / f"{name}.txt").write_text(" ".join(result.stdout.split()), encoding="utf-8")
    (folder / "spec.toml").write_text(SPEC, encoding="utf-8")
    return folder


def sections(path: Path) -> dict:
    """Return the [axis] table of a TOML file."""
    return tomllib.loads(path.read_text(encoding="utf-8"))["axis"]


def test_the_gain_of_a_drive_without_hysteresis_is_written_as_the_feedforward(folder: Path) -> None:
    feedforward = sections(folder / "first.toml")["feedforward"]
    assert feedforward["thresholds_v"] == [0.0]
    assert feedforward["weights_um_per_v"] == pytest.approx([GAIN_UM_PER_V], rel=1e-3)
    output = (folder / "first.txt").read_text(encoding="utf-8")
    assert "µm/V is the only weight of [axis.feedforward], which then has no hysteresis" in output
    assert "hysteresis model" not in output


def test_the_delay_of_an_import_follows_the_stated_order_of_position_and_drive(folder: Path) -> None:
    """The rows have no delay. If position and drive counted as sampled together, the delay would be one sample."""
    together, first = (sections(folder / f"{name}.toml")["model"]["delay_ticks"] for name in ("together", "first"))
    assert (together, first) == (1, 0)
    for ending, verb in (("toml", "count as"), ("txt", "were")):
        convention = f"drive and position of a row {verb} sampled at the same time"
        assert convention in (folder / f"together.{ending}").read_text(encoding="utf-8")
        assert convention not in (folder / f"first.{ending}").read_text(encoding="utf-8")
    assert "rtloop import --position-first" in (folder / "together.txt").read_text(encoding="utf-8")


def test_a_mapping_file_states_the_order_too(folder: Path) -> None:
    (folder / "order.map.toml").write_text(
        'position_first = true\n[signals]\nx_drive_v = "drive_v [V]"\nx_position_um = "position_um [µm]"\n',
        encoding="utf-8",
    )
    result = run("import", folder / "rows.npz", "--mapping", folder / "order.map.toml", "--out", folder / "order.mcap")
    assert result.exit_code == 0, result.output
    assert rtloop.load(folder / "order.mcap").header["imported"]["position_first"] is True


def test_the_identified_gain_reaches_the_controllers_file_by_itself(folder: Path) -> None:
    result = run(
        "design", "synthesise", folder / "spec.toml", "--model", folder / "first.toml", "--out", folder / "made.toml"
    )
    assert result.exit_code == 0, result.output
    table = tomllib.loads((folder / "made.toml").read_text(encoding="utf-8"))
    (axis,) = table["axis"]
    for plays in (axis["feedforward"], table["driver"]["plant"]["hysteresis"]):
        assert plays["thresholds_v"] == [0.0]
        assert plays["weights_um_per_v"] == pytest.approx([GAIN_UM_PER_V], rel=1e-3)
    assert axis["model"] == sections(folder / "first.toml")["model"]
    assert "placeholder" not in result.stderr
    repeated = run(
        "design", "synthesise", folder / "spec.toml", "--model", folder / "made.toml", "--out", folder / "again.toml"
    )
    assert (folder / "again.toml").read_text() == (folder / "made.toml").read_text(), repeated.output


def test_synthesis_prints_the_verdict_of_check_and_explains_gamma(folder: Path) -> None:
    """The default weight misses this specification by the factor γ; a lenient tracking weight meets it."""
    strict = "the loop misses static error; settling (5 %)"
    lenient = SPEC + '[weights.tracking]\nform = "zpk"\ngain = 0.99\nzeros = [[-600.0, 0.0]]\npoles = [[-0.1, 0.0]]\n'
    for name, text, expected in (("strict", SPEC, strict), ("lenient", lenient, "the loop meets its specification")):
        spec, out = folder / f"{name}.toml", folder / f"{name}-made.toml"
        spec.write_text(text, encoding="utf-8")
        result = run("design", "synthesise", spec, "--model", folder / "first.toml", "--out", out)
        assert result.exit_code == 0, result.output
        (verdict,) = [line for line in result.stdout.splitlines() if line.startswith(f"{spec}: ")]
        assert expected in verdict
        assert verdict.removeprefix(f"{spec}: ") in " ".join(run("check", out).stdout.split())
        assert "fails" not in result.stderr
        assert "is the smallest γ that a controller reaches" in result.stderr
        assert expected in answer("design", "synthesise", spec, "--model", folder / "first.toml")["verdict"]


def test_a_file_without_a_model_is_refused(folder: Path) -> None:
    (folder / "empty.toml").write_text("[axis.feedforward]\nthresholds_v = [0.0]\nweights_um_per_v = [1.0]\n")
    with pytest.raises(ConfigError, match=r"axis\.model: missing"):
        rtloop.design(folder / "spec.toml", model=folder / "empty.toml")
    refused = run("design", "synthesise", folder / "spec.toml", "--model", folder / "none.toml")
    assert refused.exit_code == 66, refused.output


def test_a_short_recording_gives_a_response_of_lower_resolution() -> None:
    """1 s gives segments of 0.5 s, a resolution of 2 Hz; the oracle is scipy's response. 399 samples are too few."""
    drive_v, position_um = simulate_rows(RATE_HZ)
    estimate = recording_response(Excitation("short", drive_v, position_um, 1 / RATE_HZ))
    assert estimate.resolution_hz == pytest.approx(2.0)
    assert np.diff(estimate.hz) == pytest.approx(2.0)
    omega = 2 * np.pi * RESONANCE_HZ
    plant = signal.cont2discrete(([omega**2], [1.0, 2 * DAMPING * omega, omega**2]), 1 / RATE_HZ, "zoh")
    compared = estimate.is_trusted & (estimate.hz > 20.0) & (estimate.hz < 500.0)
    _, expected = signal.freqz(plant[0].ravel(), plant[1], estimate.hz[compared], fs=RATE_HZ)
    assert np.median(np.abs(estimate.response[compared] / expected / GAIN_UM_PER_V - 1)) < 0.02
    with pytest.raises(RtloopError, match=r"needs at least 0\.02 s"):
        recording_response(Excitation("too short", drive_v[:399], position_um[:399], 1 / RATE_HZ))


def test_a_comparison_with_a_short_recording_states_its_resolution(folder: Path) -> None:
    printed = run(
        "identify", "dynamics", folder / "first.mcap", "--input", "drive", "--order", "2", "--compare",
        folder / "first.mcap",
    ).stdout  # fmt: skip
    resolution = "resolution 6.67 Hz (a resolution of 1.25 Hz needs 1.6 s of excitation)"
    assert resolution in " ".join(printed.split())


def test_the_advice_after_a_trip_fits_its_cause() -> None:
    """Wider interlocks do not help a saturated sensor, and a smaller drive does not prevent a late tick."""
    assert "help only inside the converter's range" in trip_remedy(["sensor_range"])
    assert "interlocks.position_um" in trip_remedy(["position"])
    assert "A smaller drive does not prevent this trip" in trip_remedy(["late"])
    assert trip_remedy(["late", "stale"]).count("A smaller drive") == 1
