"""Settings of all tests: no hypothesis example fails because the machine is busy, and Ctrl-C reaches child processes.

Processes compute with one thread each, as the command line does.
"""

from __future__ import annotations

import os
import signal

import pytest
from hypothesis import settings
from xdist.remote import Producer
from xdist.scheduler import LoadFileScheduling

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything imports numpy

settings.register_profile("patient", deadline=None)
settings.load_profile("patient")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # what a shell starts in the background inherits that
    signal.signal(signal.SIGINT, signal.default_int_handler)

PAGE = "tests/panel/page"
"""Folder of the tests that run in a browser."""
LONG_FILES = ("tests/syscalls/", "tests/service/test_recovery", "tests/campaigns/test_page", "tests/panel/web/")
"""Files that take long; they begin early, so that no process ends long after the others."""


class OneBrowser(LoadFileScheduling):
    """Each worker runs whole files, and one worker runs all tests in a browser.

    Two browsers that draw at once, each with a loop behind it, take more than two cores: every click then waits.
    """

    def _split_scope(self, nodeid: str) -> str:
        """Return the files whose tests run one after the other: `nodeid`'s own, or all of the browser."""
        return PAGE if nodeid.startswith(PAGE) else super()._split_scope(nodeid)


@pytest.hookimpl(optionalhook=True)  # `-p no:xdist` is allowed
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> OneBrowser:
    """Return the scheduler of the workers, whatever --dist says."""
    return OneBrowser(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the tests in a browser, which take longest, one after the other; then run LONG_FILES."""
    items.sort(key=lambda item: (not item.nodeid.startswith(PAGE), not item.nodeid.startswith(LONG_FILES)))


@pytest.fixture
def few_simulated_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `design verify` simulate one run of steps in place of many, for tests that look at other figures.

    All runs are simulated in tests/design/test_simulated.py, and for the report in tests/design/test_verify.py.
    """
    from rtloop.design.verification import simulation

    for name in ("CYCLES", "DRAWS", "MORE_DRAWS"):
        monkeypatch.setattr(simulation, name, 1)
