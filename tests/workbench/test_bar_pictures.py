"""Pictures of another law on a recording: each bar has the length of its figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rtloop
from tests.recording.real_loop import changed_configuration, record

TICKS = 3_000
LOWER_GAIN = ("gain = 0.016", "gain = 0.012")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the path of a recording of TICKS ticks of the paper's loop."""
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    return record(tmp_path_factory.mktemp("bars") / "run.mcap", changed_configuration(), TICKS)[0]


def bar_lengths(figure: Any) -> dict[str, dict[str, float]]:
    """Return the lengths of a picture's bars by label of the legend, then by name of the row."""
    (panel,) = figure.axes
    rows = [label.get_text() for label in panel.get_yticklabels()]
    return {
        bars.get_label(): dict(zip(rows, (bar.get_width() for bar in bars), strict=True)) for bars in panel.containers
    }


def test_the_picture_of_another_law_shows_the_largest_and_the_mean_difference(path: Path, tmp_path: Path):
    other = tmp_path / "other.toml"
    other.write_text(changed_configuration(("um_per_v = 10.0\n# offset", "um_per_v = 10.5\n# offset")))
    lengths = bar_lengths(rtloop.replay(path, config=other).plot())
    volts = rtloop.load(path)["x_adc_v"]
    assert set(lengths) == {"max", "rms"}
    assert lengths["max"]["x_position_um"] == np.max(np.abs(volts * 10.5 - volts * 10.0))
    assert lengths["rms"]["x_position_um"] == pytest.approx(0.5 * np.sqrt(np.mean(volts**2)), rel=1e-9)


def test_the_picture_of_a_resimulation_shows_both_runs(path: Path, tmp_path: Path):
    other = tmp_path / "other.toml"
    other.write_text(changed_configuration(LOWER_GAIN))
    lengths = bar_lengths(rtloop.replay(path, config=other, resimulate=True).plot())
    recorded, resimulated = lengths["recorded"], lengths["resimulated"]
    samples = rtloop.load(path)
    assert recorded["x: largest drive V"] == np.max(np.abs(samples["x_drive_v"]))
    assert recorded["x: largest error µm"] == np.max(np.abs(samples["x_error_um"]))
    assert recorded["x: rms error µm"] == pytest.approx(np.sqrt(np.mean(samples["x_error_um"] ** 2)), rel=1e-12)
    assert resimulated["x: rms error µm"] > 1.01 * recorded["x: rms error µm"]  # a lower gain follows more slowly
