"""A law that takes too long to build is given up, and the next one is built all the same."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.errors import ConfigError, UnavailableError
from rtloop.service.changing.building import Builder
from tests.paper_configuration import PAPER, TEXT, UNSTABLE


def configuration(text: str = TEXT):
    return parse(text, "paper", PAPER.parent, "paper.toml")


def test_what_is_built_beside_is_what_is_built_here():
    builder = Builder(build_s=60.0)
    try:
        built, expected = builder.prepare(configuration()), prepare(configuration())
        assert built.plan.coefficients.tobytes() == expected.plan.coefficients.tobytes()
        assert np.array_equal(built.plan.table, expected.plan.table)
        assert built.configuration == expected.configuration
        with pytest.raises(ConfigError, match="unstable"):
            builder.prepare(configuration(TEXT.replace(*UNSTABLE)))
        pid = builder.pid
        builder.build_s = 0.0
        with pytest.raises(UnavailableError, match="longer than 0 s"):
            builder.prepare(configuration())
        assert builder.pid is None
        builder.build_s = 60.0
        assert builder.prepare(configuration()).plan.axes == ("x",)
        assert builder.pid not in (pid, None)
    finally:
        builder.end()
    assert builder.pid is None


def test_one_that_is_expected_waits_before_the_first_change():
    builder = Builder(build_s=60.0)
    try:
        builder.start()
        pid = builder.pid
        assert pid is not None
        assert builder.prepare(configuration()).plan.axes == ("x",)
        assert builder.pid == pid
    finally:
        builder.end()


def test_a_configuration_survives_the_way():
    here = configuration()
    assert pickle.loads(pickle.dumps(here)) == here
