"""Recordings of a version whose law was laid out otherwise say so; their signals are there as ever."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rtloop
from rtloop.recording.errors import RecordingError
from rtloop.recording.replay.replay import replay
from rtloop.recording.replay.whatif import recorded_law

OLD = Path(__file__).with_name("data") / "revision-1.mcap"
"""2500 ticks through all modes, from before laws were plug-ins."""


@pytest.mark.parametrize("use", [replay, recorded_law])
def test_a_law_that_is_laid_out_otherwise_is_said_to_be_with_the_version_that_made_it(use):
    with pytest.raises(RecordingError, match=r"recorded by rtloop 0\.1\.0, whose law is laid out differently"):
        use(rtloop.load(OLD))


def test_its_signals_are_there():
    recording = rtloop.load(OLD)
    assert np.array_equal(recording["tick"], np.arange(2500))
    assert set(recording["mode"]) == {0, 1, 2, 3}
