"""Random bytes never lead the exchange with a node outside its arrays; its kernels run as plain Python here."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from tests.drivers.processes import ENVIRONMENT

pytestmark = pytest.mark.system

SOAK = pytest.mark.soak


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        ("udp", 600),
        ("udp with a key", 600),
        ("serial", 100),
        pytest.param("udp", 100_000, marks=SOAK),
        pytest.param("serial", 10_000, marks=SOAK),
    ],
)
def test_no_frame_leads_outside_an_array(kind: str, count: int):
    environment = os.environ | ENVIRONMENT | {"NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-m", "tests.drivers.node_fuzz", kind, "1", str(count)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    counts = json.loads(done.stdout)
    assert min(counts[name] for name in ("lost", "reordered", "duplicated", "invalid", "foreign", "held")) > 0
