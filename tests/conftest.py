"""What all tests share: no example fails because the machine was busy, and real processes are tested one at a time."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("patient", deadline=None)
settings.load_profile("patient")

HERE = Path(__file__).parent
PROCESSES = {"service", "engine", "recording", "drivers", "experiments", "doctor"}
"""Folders whose tests start processes and wait for clocks: in a parallel run, one worker has them all."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Group them for `pytest -n 2 --dist loadgroup`."""
    for item in items:
        if item.path.relative_to(HERE).parts[0] in PROCESSES:
            item.add_marker(pytest.mark.xdist_group("processes"))
