"""Recordings of an earlier revision of the law replay as they were made."""

from __future__ import annotations

from pathlib import Path

import pytest

import rtloop
from rtloop.recording.replay import replay as replay_module
from rtloop.recording.replay.replay import replay

OLD = Path(__file__).with_name("data") / "revision-1.mcap"
"""2500 ticks through all modes, with a pre-filter of 32 taps and a section that kept its memory throughout."""


def test_a_pre_filter_that_kept_its_memory_replays():
    recording = rtloop.load(OLD)
    assert "revision" not in recording.header["law"]
    verdict = replay(recording)
    assert (verdict.identical, verdict.ticks) == (True, 2500)


def test_without_regard_to_the_revision_it_would_not(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(replay_module, "FILLING_REVISION", 1)
    first = replay(rtloop.load(OLD)).first_difference
    assert first is not None
    assert (first["tick"], first["signal"]) == (400, "x_error_um")
