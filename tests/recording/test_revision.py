"""Recordings of rtloop 0.1.0, whose law was laid out otherwise, replay as they were made, unless with a pre-filter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rtloop
from rtloop.commands.replay import replay_on_the_rig, replay_with_other_law
from rtloop.recording.errors import RecordingError
from rtloop.recording.replay.earlier import as_of_today
from rtloop.recording.replay.replay import replay
from rtloop.recording.replay.whatif import recorded_law
from tests.recording.tamper import rewrite

DATA = Path(__file__).with_name("data")
OLD = DATA / "revision-1.mcap"
"""2500 ticks through all modes, with a pre-filter of 32 taps and a section."""
PLAIN = DATA / "earlier-0.1.0.mcap"
"""1000 ticks without one: all modes, limits of command and slew, a trip and its reset, and at three ticks another
controller, of orders 16, 8 and 8."""
SWAPPED_AT = 620
PAPER = Path(__file__).parents[2] / "deploy" / "paper.toml"


def test_without_a_prefilter_it_is_identical():
    report = replay(rtloop.load(PLAIN))
    assert (report.identical, report.ticks, report.snapshots) == (True, 1000, 3)


@pytest.mark.parametrize(
    ("table", "field"),
    [
        ("state", "controller"),
        ("state", "model_plays_v"),
        ("state", "inverse_plays_um"),
        ("state", "late_count"),
        ("state", "applied_command_um"),
        ("coefficients", "c"),
        ("coefficients", "model_weights_um_per_v"),
    ],
)
def test_a_changed_bit_of_a_snapshot_is_found(tmp_path: Path, table: str, field: str):
    law = rtloop.load(PLAIN).header["law"]
    fields = {
        name: [(one, kind, *map(tuple, shape)) for one, kind, *shape in law[name]] for name in law if name != "sha256"
    }
    types = {name: np.dtype(found) for name, found in fields.items()}
    begin = 8 + (types["coefficients"].itemsize if table == "state" else 0) + types[table].fields[field][1]

    def change(data: bytearray) -> None:
        if int.from_bytes(data[:8], "little") == SWAPPED_AT:
            data[begin] ^= 1

    report = replay(rtloop.load(rewrite(PLAIN, tmp_path / "run.mcap", law=change)))
    assert report.first_difference is not None
    assert report.first_difference["tick"] >= SWAPPED_AT


def test_a_snapshot_of_another_length_is_refused(tmp_path: Path):
    changed = rewrite(PLAIN, tmp_path / "run.mcap", law=lambda data: data.append(0))
    with pytest.raises(RecordingError, match=r"tick 0: 12529 bytes, but 1 axes take 12528"):
        replay(rtloop.load(changed))


@pytest.mark.parametrize("use", [replay, lambda recording: recorded_law(as_of_today(recording))])
def test_with_a_prefilter_it_is_refused_with_the_version_that_made_it(use):
    with pytest.raises(RecordingError, match=r"recorded by rtloop 0\.1\.0 with a pre-filter.*; replay it with that"):
        use(rtloop.load(OLD))


def test_another_law_is_compared_with_what_was_recorded():
    report = replay_with_other_law([PLAIN], PAPER)
    assert report["signals"]["x_position_um"]["max"] == 0.0
    assert report["signals"]["x_command_um"]["max"] > 0.0
    report = replay_on_the_rig([PLAIN], None)
    assert report["axes"][0]["recorded"] != report["axes"][0]["resimulated"]


def test_its_signals_are_there():
    recording = rtloop.load(OLD)
    assert np.array_equal(recording["tick"], np.arange(2500))
    assert set(recording["mode"]) == {0, 1, 2, 3}
