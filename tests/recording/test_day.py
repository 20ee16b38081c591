"""A short `rtloop run`: recorded around events, in several files, under a quota."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from tests.command_line import answer, run
from tests.recording.real_loop import PAPER, schedule

TRIP_TICK, SECOND = 80_000, 10_000
CHANGES = (
    (TRIP_TICK, 'reference = { kind = "steps", levels = [75.0, 0.0], dwell_s = 5.0 }'),
    (110_000, 'reference = { kind = "sine", amplitude = 5.0, frequency_hz = 2.0 }'),
    (110_001, "reset_trip = true"),
)
AROUND = 'around = { before_s = 1.5, after_s = 2.0, on = ["trip"] }\n'
KEEP_MIB = 3.6


def configuration_text(recording: str = "") -> str:
    """Return the paper's configuration with a scheduled trip, and with these lines in [recording]."""
    return PAPER.replace("[recording]\n", f"[recording]\n{recording}") + schedule(*CHANGES)


def test_a_quota_leaves_the_files_around_a_trip(tmp_path: Path):
    config = tmp_path / "day.toml"
    config.write_text(configuration_text(f"{AROUND}rotate_s = 3.0\nkeep_gib = {KEEP_MIB / 1024}\n"))
    folder = tmp_path / "recordings"
    report = answer("run", config, "--unpaced", "--duration", 21, "--out", folder, code=1)  # The run trips.
    notes = [note for note in report["notes"] if "keep_gib" in note]
    assert re.fullmatch(
        r"\d+ files? of recordings \(\S+ MiB\) removed because of recording.keep_gib or .*min_free_mib", *notes
    )
    paths = sorted(folder.glob("*.mcap"))
    assert (report["error"], report["recordings"]) == (None, [str(path) for path in paths])
    assert (3 <= len(paths) < 7, paths[-1].stem.endswith("-0007")) == (True, True)
    assert sum(path.stat().st_size for path in paths) <= KEEP_MIB * 2**20
    ticks = np.concatenate([load(path)["tick"] for path in paths])
    (trip,) = report["trips"]
    assert TRIP_TICK < trip["tick"] < TRIP_TICK + SECOND
    assert np.isin(np.arange(trip["tick"] - 15_000, trip["tick"] + 20_000), ticks).all()
    assert replay(load(folder / "*-000[34].mcap")).identical


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        (
            'around = { on = ["x_positon_um > 3"] }',
            "no signal 'x_positon_um'; did you mean x_position_um?; allowed: tick,",
        ),
        ('around = { on = ["x_error_um"] }', "'x_error_um': not a condition; allowed: trip, mode, command, late, or a"),
        ("around = { on = [] }", "at least 1 item"),
        ("around = { before_s = 5.0 }", "recording.around.on: missing"),
        (
            'around = { on = ["trip"], before_s = -1.0 }',
            "recording.around.before_s: -1.0: must be greater than or equal to 0",
        ),
        ('around = { on = ["trip"], before_s = 600.0 }', "before_s: 600 s at 10000 Hz with 23 signals needs"),
        ("keep_gib = 0", "recording.keep_gib"),
    ],
)
def test_check_refuses_an_invalid_setting_of_recordings(tmp_path: Path, setting: str, expected: str):
    config = tmp_path / "day.toml"
    config.write_text(configuration_text(f"{setting}\n"))
    result = run("check", config)
    assert (result.exit_code, expected in result.stderr) == (78, True), result.stderr
