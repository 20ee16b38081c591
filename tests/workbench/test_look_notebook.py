"""docs/notebooks/look.ipynb: every cell runs, and its slices, settling times and figures agree with the file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.workbench.notebook import Names, execute_notebook

RATE_HZ = 10_000
HEIGHT_UM = 20.0


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Names]:
    """Yield the names that the notebook's cells define."""
    pytest.importorskip("pandas", reason="pandas is not installed (extra `data`)")
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra `plot`)").use("agg")
    before = Path.cwd()
    try:
        yield execute_notebook("look.ipynb", tmp_path_factory.mktemp("notebook"))
    finally:
        os.chdir(before)


def test_a_slice_has_the_ticks_of_its_time(names: Names):
    ticks = np.arange(0.2 * RATE_HZ, 0.22 * RATE_HZ + 1)
    for name, step in names["steps"].items():
        column_um = names["runs"][name]["x_position_um"]
        assert np.array_equal(step["tick"], ticks)
        assert np.array_equal(step["x_position_um"], column_um[ticks.astype(int)])


def test_the_settling_time_is_that_of_the_last_sample_outside(names: Names):
    """The settling time agrees with a loop over the positions, and is near the median over the run's steps."""
    for name, run in names["runs"].items():
        position_um, settled = run["x_position_um"], 0
        for tick in range(2000, 2201):
            if abs(position_um[tick]) > 0.05 * HEIGHT_UM:
                settled = tick + 1 - 2000
        assert names["settled_ms"][name] == pytest.approx(1e3 * settled / RATE_HZ, abs=1e-6)
        assert names["settled_ms"][name] == pytest.approx(names["results"][name].steps["x"].settling_time_ms, abs=0.3)
    assert names["settled_ms"]["robust"] < names["settled_ms"]["paper"]


def test_the_recording_is_the_file_that_mcap_reads(names: Names):
    with names["files"]["paper"].open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    topics = {channel.topic: number for number, channel in summary.channels.items()}
    assert summary.statistics.channel_message_counts[topics["/ticks"]] == len(names["run"]) == 5000


def test_pictures_have_the_curves_of_both_runs(names: Names):
    (axes,) = names["figure"].axes
    assert [line.get_label() for line in axes.lines] == ["paper", "robust"]
    assert {line.get_xdata().size for line in axes.lines} == {201}
