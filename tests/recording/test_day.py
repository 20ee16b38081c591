"""A short day of `rtloop run`: recorded around events, in several files, under a quota."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from tests.recording.real_loop import PAPER

TRIPPING, SECOND = 80_000, 10_000
CHANGES = (
    (TRIPPING, 'reference = { kind = "steps", levels = [75.0, 0.0], dwell_s = 5.0 }'),
    (110_000, 'reference = { kind = "sine", amplitude = 5.0, frequency_hz = 2.0 }'),
    (110_001, "reset_trip = true"),
)
AROUND = 'around = { before_s = 1.5, after_s = 2.0, on = ["trip"] }\n'
KEEP_MIB = 3.6


def text(recording: str = "") -> str:
    changes = "".join(f"\n[[schedule]]\nat_tick = {tick}\n{what}\n" for tick, what in CHANGES)
    return PAPER.replace("[recording]\n", f"[recording]\n{recording}") + changes


def rtloop(*arguments: object) -> tuple[int, str]:
    """Exit code and output of a command."""
    result = CliRunner().invoke(main, [str(one) for one in arguments])
    return result.exit_code, result.stdout


def test_a_quota_leaves_what_is_around_a_trip(tmp_path: Path):
    config = tmp_path / "day.toml"
    config.write_text(text(f"{AROUND}rotate_s = 3.0\nkeep_gib = {KEEP_MIB / 1024}\n"))
    folder = tmp_path / "recordings"
    code, output = rtloop("run", config, "--unpaced", "--duration", 21, "--out", folder, "--json")
    report = json.loads(output)
    assert code == 1  # it tripped
    assert report["error"] is None
    said = [one for one in report["notes"] if "keep_gib" in one]
    assert re.fullmatch(r"\d+ files? of recordings, \S+ MiB, removed by recording.keep_gib", *said)
    left = sorted(folder.glob("*.mcap"))
    assert [str(path) for path in left] == report["recordings"]
    assert 3 <= len(left) < 7
    assert left[-1].stem.endswith("-0007")
    assert sum(path.stat().st_size for path in left) <= KEEP_MIB * 2**20
    ticks = np.concatenate([load(path)["tick"] for path in left])
    (trip,) = report["trips"]
    assert TRIPPING < trip["tick"] < TRIPPING + SECOND
    assert np.isin(np.arange(trip["tick"] - 15_000, trip["tick"] + 20_000), ticks).all()
    assert replay(load(folder / "*-000[34].mcap")).identical


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (
            'around = { on = ["x_positon_um > 3"] }',
            "no signal 'x_positon_um'; did you mean x_position_um?; there are tick,",
        ),
        ('around = { on = ["x_error_um"] }', "'x_error_um': no condition; allowed: trip, mode, command, late, or a"),
        ("around = { on = [] }", "at least 1 item"),
        ("around = { before_s = 5.0 }", "recording.around.on: missing"),
        (
            'around = { on = ["trip"], before_s = -1.0 }',
            "recording.around.before_s: -1.0: must be greater than or equal to 0",
        ),
        ('around = { on = ["trip"], before_s = 600.0 }', "recording.around.before_s: 600: at 10000 Hz and 23 signals"),
        ("keep_gib = 0", "recording.keep_gib"),
    ],
)
def test_what_cannot_be_recorded_is_refused_at_the_check(tmp_path: Path, said: str, expected: str):
    config = tmp_path / "day.toml"
    config.write_text(text(f"{said}\n"))
    result = CliRunner().invoke(main, ["check", str(config)])
    assert result.exit_code == 78
    assert expected in result.stderr
