"""What all tests share: no example fails because the machine was busy, and Ctrl-C reaches what they start.

Processes compute with one thread each, as the command line does.
"""

from __future__ import annotations

import os
import signal

import pytest
from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything imports numpy

settings.register_profile("patient", deadline=None)
settings.load_profile("patient")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # what a shell starts in the background inherits that
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def few_simulated_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """`design verify` simulates four steps of each height, in one run, for a test that looks at other things.

    All of them are simulated in tests/design/test_simulated.py, and for the report in tests/design/test_verify.py.
    """
    for name in ("CYCLES", "DRAWS", "MORE_DRAWS"):
        monkeypatch.setattr(f"rtloop.design.verification.simulation.{name}", 1)
