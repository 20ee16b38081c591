"""A position that fell as its drive rose is recognised: on computed motions, and on loops that trip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.recording.views.motion import Motion
from tests.paper_configuration import TEXT

TICKS = 400
RUNAWAY_V = 9.0 * np.expm1(np.linspace(0.0, 3.0, TICKS)) / np.expm1(3.0)
OSCILLATION_V = 4.0 * np.sin(0.2 * np.arange(TICKS))
DRIVES = {"runaway": RUNAWAY_V, "downwards": -RUNAWAY_V, "oscillation": OSCILLATION_V}
SENSOR = "[driver.plant.sensor]\num_per_v = 10.0"


def is_opposed(drive_v: np.ndarray, position_um: np.ndarray, blocks: int = 1) -> bool:
    """Return whether Motion, fed with the samples in `blocks` parts, finds that drive and position ran away opposed."""
    motion = Motion()
    for drive, position in zip(np.array_split(drive_v, blocks), np.array_split(position_um, blocks), strict=True):
        motion.add(drive, position)
    return motion.ran_away_opposed()


@pytest.mark.parametrize("blocks", [1, 7])
@pytest.mark.parametrize(("name", "um_per_v", "expected"), [
    ("runaway", -4.3, True), ("downwards", -4.3, True), ("runaway", 4.3, False), ("downwards", 4.3, False),
    ("oscillation", -4.3, False), ("oscillation", 4.3, False),
])  # fmt: skip
def test_only_a_drive_that_runs_away_against_its_position_is_opposed(name, um_per_v, expected, blocks):
    """Offsets of 1 m and 5 V do not change the answer."""
    noise_um = np.random.default_rng(3).normal(0.0, 0.02, TICKS)
    position_um = um_per_v * DRIVES[name] + noise_um
    assert is_opposed(DRIVES[name], position_um, blocks) is expected
    assert is_opposed(5.0 + DRIVES[name], 1e6 + position_um, blocks) is expected


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_the_correlation_must_be_below_minus_a_half(share):
    """A position of which `share` of the variance follows −drive has a coefficient of −√share: −0.55 and −0.84.

    The rest is a fast wave that correlates with no drive; with a share of 0.2 the coefficient would be −0.45.
    """
    centred = (RUNAWAY_V - RUNAWAY_V.mean()) / RUNAWAY_V.std()
    wave = np.sqrt(2.0) * np.sin(2.0 * np.pi * np.arange(TICKS) / 5.0)
    position_um = -np.sqrt(share) * centred + np.sqrt(1.0 - share) * wave
    assert np.corrcoef(RUNAWAY_V, position_um)[0, 1] < -0.5
    assert is_opposed(RUNAWAY_V, position_um)
    assert not is_opposed(RUNAWAY_V, -np.sqrt(0.2) * centred + np.sqrt(0.8) * wave)


@pytest.mark.parametrize("position_um", [np.zeros(TICKS), np.full(TICKS, np.nan), np.full(TICKS, np.inf)])
def test_a_position_that_is_constant_or_not_finite_is_not_opposed(position_um):
    assert not is_opposed(RUNAWAY_V, position_um)
    assert not Motion().ran_away_opposed()


@pytest.mark.parametrize(("old", "new", "is_named"), [
    (SENSOR, SENSOR.replace("10.0", "-10.0"), True),
    ("gain = 0.016", "gain = 0.1\nallow_unstable = true", False),
], ids=["wrong sign", "right sign, oscillates"])  # fmt: skip
def test_the_summary_of_a_trip_names_a_wrong_sign_and_blames_no_right_one(old, new, is_named, tmp_path: Path):
    assert TEXT.count(old) == 1
    (tmp_path / "loop.toml").write_text(TEXT.replace(old, new).replace('specification = "paper-spec.toml"', ""))
    command = ["run", str(tmp_path / "loop.toml"), "--duration", "0.5", "--unpaced", "--out", str(tmp_path)]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 1, result.output
    assert "trip" in result.stdout
    sentence = "the position of axis x fell as its drive rose. Check the sign of its um_per_v"
    assert (sentence in " ".join(result.stdout.split())) is is_named
