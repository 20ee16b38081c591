"""Files of laboratories' programs: each gives its numbers, names and units, or asks; none is read in silence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rtloop.interchange.binding import Binding, bind
from rtloop.interchange.columns import ColumnSelection
from rtloop.interchange.formats.table import AmbiguousData
from rtloop.interchange.reading import read_in_process
from tests.interchange.layouts import LAYOUTS, QUESTIONS, Layout, Question, T


def read(path: Path, **answers: Any) -> Binding:
    """Return the reading of a file, by the answers to its questions."""
    selection = ColumnSelection(all=True, **answers)
    return bind(read_in_process(path, selection.hints), path, selection)


def write(folder: Path, case: Layout | Question) -> Path:
    """Write a file. Returns its path."""
    path = folder / case.name
    path.write_bytes(case.content)
    return path


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: f"{layout.program}: {layout.layout}")
def test_a_layout_gives_its_numbers_names_units_and_rate(layout: Layout, tmp_path: Path):
    binding = read(write(tmp_path, layout))
    for name, (unit, values) in layout.columns.items():
        assert name in binding.table.columns, list(binding.table.columns)
        assert_allclose(binding.table.columns[name], values, rtol=1e-9, atol=1e-9)
        assert binding.units[name] == unit
    if layout.rate_hz is None:
        assert binding.time_base is None
        return
    base = binding.require_time()
    assert base.rate_hz == pytest.approx(layout.rate_hz, rel=1e-6)
    steps = np.diff(base.deadline_ns)
    assert np.all(np.abs(steps - 1e9 / layout.rate_hz) <= 1.5)
    assert len(steps) == len(T) - 1


@pytest.mark.parametrize("question", QUESTIONS, ids=lambda question: question.ambiguity)
def test_a_file_with_two_readings_asks_for_the_option_that_decides(question: Question, tmp_path: Path):
    path = write(tmp_path, question)
    with pytest.raises(AmbiguousData) as caught:
        read(path)
    lines = [line.strip() for line in str(caught.value).splitlines()[1:]]
    for option in question.options:
        assert any(line.partition("  ")[0].endswith(option) for line in lines), str(caught.value)
