"""A law that takes too long to build is given up, and the next one is built all the same."""

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
    return parse(text, "paper", PAPER.parent, "paper.toml")


@pytest.fixture
def beside() -> Iterator[LimitedProcess]:
    process = LimitedProcess(limit_s=60.0)
    yield process
    process.end()
    assert process.pid is None


def test_what_is_built_beside_is_what_is_built_here(beside: LimitedProcess):
    built, expected = beside.run(prepare, configuration()), prepare(configuration())
    assert built.plan.coefficients.tobytes() == expected.plan.coefficients.tobytes()
    assert np.array_equal(built.plan.table, expected.plan.table)
    assert built.configuration == expected.configuration
    with pytest.raises(ConfigError, match="unstable"):
        beside.run(prepare, configuration(TEXT.replace(*UNSTABLE)))
    pid = beside.pid
    beside.limit_s = 0.0
    with pytest.raises(UnavailableError, match="longer than 0 s"):
        beside.run(prepare, configuration())
    assert beside.pid is None
    beside.limit_s = 60.0
    assert beside.run(prepare, configuration()).plan.axes == ("x",)
    assert beside.pid not in (pid, None)


def test_one_that_is_expected_waits_before_the_first_change(beside: LimitedProcess):
    beside.prepare_ahead(prepare)
    pid = beside.pid
    assert pid is not None
    assert beside.run(prepare, configuration()).plan.axes == ("x",)
    assert beside.pid == pid


def test_the_time_that_the_process_takes_to_start_does_not_count(beside: LimitedProcess):
    """The interpreter, its imports and the compiler take a second; the function takes nothing."""
    beside.limit_s = 0.1
    assert beside.run(len, "law", compiles=True) == 3


def test_a_configuration_survives_the_way():
    here = configuration()
    assert pickle.loads(pickle.dumps(here)) == here
