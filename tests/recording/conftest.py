"""Fixtures of recordings: a recorder process on a hand-made loop, a disk that fails on demand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.recording.disk import Disk
from tests.recording.forging import Base, record_bases
from tests.recording.hand_made_loop import HandMadeLoop, RecorderProcess
from tests.recording.real_loop import eventful_configuration, record

EVENTFUL_TICKS = 25_000


@pytest.fixture(scope="session")
def base(tmp_path_factory: pytest.TempPathFactory) -> Base:
    """The parts of a good recording of one axis."""
    return record_bases(tmp_path_factory.mktemp("base"))[0]


@pytest.fixture(scope="session")
def eventful(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of EVENTFUL_TICKS ticks with saturation, limits, modes, a trip and references; tests only read it."""
    return record(tmp_path_factory.mktemp("eventful") / "run.mcap", eventful_configuration(), EVENTFUL_TICKS)[0]


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    """A disk that works until a test makes it fail."""
    return Disk(monkeypatch)


@pytest.fixture
def loop() -> HandMadeLoop:
    """A hand-made loop whose rings are empty."""
    return HandMadeLoop()


@pytest.fixture
def recorder(loop: HandMadeLoop) -> Iterator[RecorderProcess]:
    """A recorder process on `loop` that waits for its order."""
    with RecorderProcess(loop) as recorder:
        yield recorder
