"""Files of laboratories' programs: each gives its numbers, names and units, or asks; none is read in silence."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rtloop.interchange.binding import Binding, bind
from rtloop.interchange.columns import ColumnSelection
from rtloop.interchange.formats.table import AmbiguousData, UnreadableData
from rtloop.interchange.reading import read_in_process
from tests.command_line import run
from tests.interchange.layouts import BODY, HEAD, LAYOUTS, QUESTIONS, Layout, N, Question, T, U, X, rows


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


@pytest.mark.parametrize("question", QUESTIONS, ids=lambda question: question.ambiguity)
def test_each_answer_settles_its_question(question: Question, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """An answer gives a recording, or one other fault; the first answer that lists columns leads to a recording."""
    monkeypatch.setattr("rtloop.interchange.isolated_reader.read_table", read_in_process)
    path = write(tmp_path, question)
    asked = run("import", path, "--all").stderr
    options = [line.strip().partition("   ")[0].partition("  ")[0] for line in asked.splitlines()[1:]]
    assert len(options) >= 2, asked
    for number, option in enumerate(options):
        arguments = shlex.split(option.replace("SIGNAL", "signal").replace("HZ", "1000").replace("COLUMN", "u"))
        result = run("import", path, *arguments, "--all", "--out", tmp_path / f"{number}.mcap")
        assert result.exit_code in (0, 1, 65), result.output
        assert result.stderr.splitlines()[:1] != asked.splitlines()[:1], option


def test_two_clocks_are_two_groups_of_their_own_length(tmp_path: Path):
    slow = 0.002 + 4 * T[:20]
    cells = [f"{t:.4f},{x:.4f}" for t, x in zip(slow, X, strict=False)] + [","] * (len(T) - 20)
    path = tmp_path / "scan.csv"
    path.write_text("Time [s],u [V],Time [s],x [um]\n" + rows(T, U, cells))
    fast = read(path)
    assert_allclose(fast.table.columns["u [V]"], U)
    assert fast.table.about["other groups"] == "'Time [s] (2)' (20 rows, 2 columns)"
    for answer in ("group", "clock"):
        other = read(path, **{answer: "Time [s] (2)"})
        assert_allclose(other.table.columns["x [um]"], X[:20])
        assert other.require_time().rate_hz == 2500.0


def test_a_table_with_cells_of_several_lines_loses_no_row(tmp_path: Path):
    path = tmp_path / "scan.csv"
    path.write_text("Time [s],note,u [V]\n" + rows(T, ['"first\nsecond"'] * len(T), U))
    binding = read(path)
    assert_allclose(binding.table.columns["u [V]"], U)
    assert binding.require_time().rate_hz == 10_000.0


def test_a_unit_behind_some_values_alone_is_refused(tmp_path: Path):
    path = tmp_path / "scan.csv"
    path.write_text("Time [s],u\n" + rows(T, [f"{u:.4f} V" if k > 30 else f"{u:.4f}" for k, u in enumerate(U)]))
    with pytest.raises(UnreadableData, match="some values have a unit behind them, others have none"):
        read(path)


@pytest.mark.parametrize(
    ("content", "note"),
    [
        (HEAD + "scale,1,1\n" + BODY, "left out between names and numbers: line 2, 'scale,1,1'"),
        (
            HEAD + "offset,0\ngain,1\n" + BODY,
            "left out between names and numbers: line 2, 'offset,0'; line 3, 'gain,1'",
        ),
        (HEAD + BODY + "the end\n", "1 line below the numbers left out: 'the end'"),
        (HEAD + BODY + ",,\n,,\n", "2 rows without a value at the end left out"),
        (HEAD + BODY.replace("0.0030,", ",,\n0.0030,"), "1 row without any value left out"),
        (HEAD + rows(T, U, ["OVER" if k < 2 else "1.5" for k in range(N)]), "x [um]: 2 values missing: 2 × 'OVER'"),
        ("t,u\n" + rows(T, U), "the time 't' has no known unit; s is assumed"),
        ("timestamp,u\n" + rows([str(1_700_000_000_000 + k) for k in range(N)], U), "the values count ms since 1970"),
    ],
)
def test_each_loss_and_each_assumption_is_named(content: str, note: str, tmp_path: Path):
    (tmp_path / "scan.csv").write_text(content)
    binding = read(tmp_path / "scan.csv")
    notes = [*binding.notes, *binding.require_time().notes]
    assert any(note in text for text in notes), notes
    assert len(binding.require_time().deadline_ns) == N


@pytest.mark.parametrize(
    ("form", "rate_hz"), [("{:.6f}", 51_200.0), ("{:.6g}", 51_200.0), ("{:.5f}", 12_800.0), ("{:.4f}", 3_000.0)]
)
def test_a_rounded_clock_has_even_samples(form: str, rate_hz: float, tmp_path: Path):
    count = 5000
    (tmp_path / "scan.csv").write_text(
        "Time [s],u\n" + rows([form.format(k / rate_hz) for k in range(count)], [1.5] * count)
    )
    base = read(tmp_path / "scan.csv").require_time()
    assert base.rate_hz == rate_hz
    assert np.abs(base.deadline_ns - np.arange(count) * 1e9 / rate_hz).max() <= 1
