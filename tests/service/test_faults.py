"""The two most important faults, injected into real processes; `make faults` runs all faults."""

from __future__ import annotations

import pytest

from tests.faults import hardware, processes
from tests.faults.fault import Fault, measure

pytestmark = pytest.mark.system

CHOSEN = ("loop SIGSTOP", "driver raises in write")
FAULTS = {fault.name: fault for fault in (*processes.FAULTS, *hardware.FAULTS)}


@pytest.mark.parametrize("fault", [FAULTS[name] for name in CHOSEN], ids=CHOSEN)
def test_ends_safe_and_accounted(fault: Fault):
    row = measure(fault)
    if row.skipped:
        pytest.skip(row.skipped)
    assert row.problems == []
