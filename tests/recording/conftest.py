"""The recorder's process beside a loop made by hand."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.recording.forging import Base, bases
from tests.recording.hand_made_loop import HandMadeLoop, RecorderProcess


@pytest.fixture(scope="session")
def base(tmp_path_factory: pytest.TempPathFactory) -> Base:
    """A good recording taken apart."""
    return bases(tmp_path_factory.mktemp("base"))[0]


@pytest.fixture
def loop() -> HandMadeLoop:
    """A loop whose rings are empty."""
    return HandMadeLoop()


@pytest.fixture
def recorder(loop: HandMadeLoop) -> Iterator[RecorderProcess]:
    """A recorder that waits for its order."""
    recorder = RecorderProcess(loop)
    yield recorder
    recorder.process.kill()
    recorder.process.communicate()
