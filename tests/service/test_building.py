"""A law is built in a limited process: a build over the time limit is aborted, and the next build succeeds."""

from __future__ import annotations

import pickle
from collections.abc import Iterator

import numpy as np
import pytest

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.errors import ConfigError, UnavailableError
from rtloop.laws.limited.process import LimitedProcess
from tests.paper_configuration import PAPER, TEXT, UNSTABLE


def configuration(text: str = TEXT):
    """Return the parsed configuration of `text`, by default the paper's."""
    return parse(text, "paper", PAPER.parent, "paper.toml")


@pytest.fixture
def limited_process() -> Iterator[LimitedProcess]:
    """Yield a process with a time limit of 60 s, and check that its end leaves no process."""
    process = LimitedProcess(limit_s=60.0)
    yield process
    process.end()
    assert process.pid is None


def test_what_is_built_beside_is_what_is_built_here(limited_process: LimitedProcess):
    built, expected = limited_process.run(prepare, configuration()), prepare(configuration())
    assert built.plan.coefficients.tobytes() == expected.plan.coefficients.tobytes()
    assert np.array_equal(built.plan.table, expected.plan.table)
    assert built.configuration == expected.configuration
    with pytest.raises(ConfigError, match="unstable"):
        limited_process.run(prepare, configuration(TEXT.replace(*UNSTABLE)))
    pid = limited_process.pid
    limited_process.limit_s = 0.0
    with pytest.raises(UnavailableError, match=r"processor time .*was stopped"):
        limited_process.run(prepare, configuration())
    assert limited_process.pid is None
    limited_process.limit_s = 60.0
    assert limited_process.run(prepare, configuration()).plan.axes == ("x",)
    assert limited_process.pid not in (pid, None)


def test_one_that_is_expected_waits_before_the_first_change(limited_process: LimitedProcess):
    limited_process.prepare_ahead(prepare)
    pid = limited_process.pid
    assert pid is not None
    assert limited_process.run(prepare, configuration()).plan.axes == ("x",)
    assert limited_process.pid == pid


def test_the_time_that_the_process_takes_to_start_does_not_count(limited_process: LimitedProcess):
    """The interpreter, its imports and the compiler take a second to load; the function takes no time."""
    limited_process.limit_s = 0.1
    assert limited_process.run(len, "law", compiles=True) == 3


def test_a_configuration_survives_the_way():
    original = configuration()
    assert pickle.loads(pickle.dumps(original)) == original
