"""`rtloop campaign search` and `campaign boundary` on rigs whose worst value is known.

The sensor has an offset of 0 to 1 µm. The loop moves the sensor's signal to the reference, so the stage stands off the
reference by the offset: after a step of 10 µm, 0.1 µm are a static error of 1 %.
"""

from __future__ import annotations

from pathlib import Path

import pytest

import rtloop
from tests.campaigns.campaign_files import STEPS, write_campaign
from tests.command_line import answer, run

KEY = "driver.plant.sensor.offset_um"
PAPER_ERROR_PERCENT = 0.2
"""The static error of the paper's loop without an offset is below this."""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the path of a campaign with an uncertain offset of the sensor, and 5 % as limit of the static error.

    The loop enters with the offset as its error, which has decayed when a level ends.
    """
    steps = STEPS.replace("dwell_s = 0.03", "dwell_s = 0.5")
    uncertain = f'"{KEY}" = {{ uniform = [0.0, 1.0] }}'
    return write_campaign(tmp_path_factory.mktemp("offset"), uncertain=uncertain, experiments=steps)


def test_the_boundary_is_the_offset_that_costs_the_allowed_error(campaign: Path):
    result = answer("campaign", "boundary", campaign, KEY, "--tolerance", 0.001, "--jobs", 1)
    assert result["key"] == KEY
    assert result["low"] is None
    assert result["high"] == pytest.approx(0.5, abs=0.1 * PAPER_ERROR_PERCENT)
    assert "static_error_percent" in result["high_cause"]
    text = run("campaign", "boundary", campaign, KEY, "--tolerance", 0.001, "--jobs", 1)
    assert text.exit_code == 0, text.output
    words = " ".join(text.stdout.split())
    assert words.startswith(f"{KEY}: no failure down to the end of the range … {result['high']:.6g} (")
    assert f"tried: {result['rigs']} rigs" in words


def test_the_worst_rig_has_the_largest_offset(campaign: Path, tmp_path: Path):
    arguments = ("campaign", "search", campaign, "--rigs", 60, "--jobs", 1, "--figure", "steps.static_error_percent")
    result = answer(*arguments, "--out", tmp_path, "--record")
    worst = result["worst"]
    assert worst["values"][KEY] == pytest.approx(1.0, abs=0.03)
    assert result["figure"] == worst["figures"]["steps.static_error_percent"]
    assert result["figure"] == pytest.approx(10.0 * worst["values"][KEY], abs=PAPER_ERROR_PERCENT)
    (path,) = map(Path, result["recordings"])
    assert path.parent == tmp_path / "worst"
    samples = rtloop.load(path)
    off_um = abs(samples["x_true_position_um"][-50:].mean() - 10.0)
    assert off_um == pytest.approx(worst["values"][KEY], abs=0.1 * PAPER_ERROR_PERCENT)


def test_the_text_of_a_search_names_the_rig_and_what_it_missed(campaign: Path):
    text = run("campaign", "search", campaign, "--rigs", 20, "--jobs", 1, "--figure", "steps.static_error_percent")
    assert text.exit_code == 0, text.output
    lines = [line.split() for line in text.stdout.splitlines() if line.strip()]
    assert lines[0][:2] == ["worst", "of"]
    assert lines[0][4] == "steps.static_error_percent"
    cells = {line[0]: line[-1] for line in lines}
    assert float(lines[0][5]) == pytest.approx(10.0 * float(cells[KEY]), abs=PAPER_ERROR_PERCENT)
    assert lines[-1][0] == "missed:"
    assert "steps.static_error_percent" in text.stdout.splitlines()[-1]
