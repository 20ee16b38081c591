"""Another law compared with a recording: on its inputs, and in closed loop with the rig."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtloop.errors import ConfigError
from rtloop.recording.load import load
from rtloop.workbench.other_law import replay_on_the_rig, replay_with_other_law
from tests.recording.real_loop import TWO_AXES, changed_configuration, eventful_configuration, record

TICKS = 12_000
LOWER_GAIN = ("gain = 0.016", "gain = 0.012")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of TICKS ticks of the paper's loop."""
    return record(tmp_path_factory.mktemp("whatif") / "run.mcap", changed_configuration(), TICKS)[0]


def write_configuration(folder: Path, text: str) -> Path:
    """Write the configuration of the other law. Returns its path."""
    file = folder / "other.toml"
    file.write_text(text)
    return file


def test_the_same_law_commands_the_same(path: Path, tmp_path: Path):
    report = replay_with_other_law([path], write_configuration(tmp_path, changed_configuration()))
    assert (report["ticks"], report["trip"]) == (TICKS, None)
    names = ("position_um", "error_um", "command_um", "demand_v", "drive_v")
    assert set(report["signals"]) == {f"x_{name}" for name in names}
    assert all(figures["max"] == figures["rms"] == 0.0 for figures in report["signals"].values())


def test_another_law_differs_in_its_outputs_but_not_in_its_inputs(path: Path, tmp_path: Path):
    signals = replay_with_other_law([path], write_configuration(tmp_path, changed_configuration(LOWER_GAIN)))["signals"]
    assert signals["x_position_um"]["max"] == signals["x_error_um"]["max"] == 0.0
    command = signals["x_command_um"]
    assert 0.0 < command["rms"] < command["max"]
    assert 0 <= command["at_tick"] < TICKS


def test_another_scale_of_the_sensor_differs_exactly(path: Path, tmp_path: Path):
    text = changed_configuration(("um_per_v = 10.0\n# offset", "um_per_v = 10.5\n# offset"))
    report = replay_with_other_law([path], write_configuration(tmp_path, text))
    volts = load(path)["x_adc_v"]
    difference = np.abs(volts * 10.5 - volts * 10.0)
    figures = report["signals"]["x_position_um"]
    assert (figures["max"], figures["at_tick"]) == (difference.max(), int(difference.argmax()))
    assert figures["rms"] == pytest.approx(np.sqrt(np.mean(difference**2)), rel=1e-12)


def test_the_first_trip_of_another_law_is_reported(path: Path, tmp_path: Path):
    text = changed_configuration(("position_um = 60.0", "position_um = 15.0"))
    report = replay_with_other_law([path], write_configuration(tmp_path, text))
    expected = int(np.argmax(np.abs(load(path)["x_position_um"]) > 15.0))
    assert report["trip"] == {"tick": expected, "causes": ["position"]}


def test_the_recorded_law_on_its_rig_gives_the_recorded_figures(path: Path):
    report = replay_on_the_rig([path], None)
    [axis], errors = report["axes"], load(path)["x_error_um"]
    figures = axis["recorded"]
    assert (report["ticks"], axis["resimulated"]) == (TICKS, figures)
    assert figures["rms_error_um"] == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-12)
    assert (figures["max_abs_error_um"], figures["steps"]["steps"]) == (np.abs(errors).max(), 5)


def test_recorded_commands_are_executed_on_the_rig(tmp_path: Path):
    path = record(tmp_path / "run.mcap", eventful_configuration(), 16_000)[0]
    report = replay_on_the_rig([path], write_configuration(tmp_path, eventful_configuration()))
    assert report["trips"]["recorded"] is not None
    assert report["trips"]["recorded"] == report["trips"]["resimulated"]
    assert report["axes"][0]["recorded"] == report["axes"][0]["resimulated"]


def test_the_figures_of_another_law_on_the_rig_differ(path: Path, tmp_path: Path):
    report = replay_on_the_rig([path], write_configuration(tmp_path, changed_configuration(LOWER_GAIN)))
    before, after = report["axes"][0]["recorded"], report["axes"][0]["resimulated"]
    assert before["steps"]["settling_time_ms"] < after["steps"]["settling_time_ms"]
    assert before["rms_error_um"] < after["rms_error_um"]


def test_a_configuration_that_does_not_fit_is_refused(path: Path, tmp_path: Path):
    faster = write_configuration(tmp_path, changed_configuration(("rate_hz = 10000", "rate_hz = 20000")))
    with pytest.raises(ConfigError, match=r"loop\.rate_hz: value is 20000 Hz; allowed: the recording's rate, 10000 Hz"):
        replay_with_other_law([path], faster)
    with pytest.raises(ConfigError, match="axis: value is x, y; allowed: the recording's axes, x"):
        replay_on_the_rig([path], write_configuration(tmp_path, TWO_AXES))
