"""Text tables as programs write them: numbers are read exactly; a bad table is refused with the place of its fault."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtloop.interchange.formats.from_csv import ROWS_AT_ONCE, read_csv
from rtloop.interchange.formats.table import UnreadableData

TIME = np.arange(300) * 1e-4
VOLTS = np.sin(2 * np.pi * 50 * TIME)


def rows(delimiter: str, decimal: str = ".") -> str:
    """Return the lines of TIME and VOLTS."""
    lines = (f"{t!r}{delimiter}{v!r}" for t, v in zip(TIME.tolist(), VOLTS.tolist(), strict=True))
    return "\n".join(lines).replace(".", decimal) + "\n"


def german() -> bytes:
    """Return a file of a German spreadsheet, with a column of text."""
    body = rows(";", ",").replace("\n", ";gut\r\n")
    return ("\ufeffZeit;Piezo Out;Bemerkung\r\ns;V;\r\n" + body).encode()


WORDS = f"Messung für März\r\n\r\nZeit [s];Größe [V]\r\n{rows(';', ',')}"
SCOPE = f"Time,Channel A\n(s),(V)\n\n{rows(',')}"
WRITTEN = {
    "excel of a German": (german(), ["Zeit", "Piezo Out"], {"Zeit": "s", "Piezo Out": "V"}),
    "words above, cp1252": (WORDS.encode("cp1252"), ["Zeit [s]", "Größe [V]"], {}),
    "a scope": (SCOPE.encode(), ["Time", "Channel A"], {"Time": "s", "Channel A": "V"}),
    "tabs behind a comment": (f"% of MATLAB\n% t\tu\n{rows(chr(9))}".encode(), ["t", "u"], {}),
    "no names": (rows("  ").encode(), ["column_1", "column_2"], {}),
    "UTF-16": (f"t,u\n{rows(',')}".encode("utf-16"), ["t", "u"], {}),
    "quotes": (f'"t","u, filtered"\n{rows(",")}'.encode(), ["t", "u, filtered"], {}),
    "a timetable of MATLAB": (f"Time,u\n{rows(' sec,')}".encode(), ["Time", "u"], {"Time": "sec"}),
    "a delimiter at the end": (f"t;u\n{rows(';')}".replace("\n", ";\n").encode(), ["t", "u"], {}),
}


@pytest.mark.parametrize("case", WRITTEN)
def test_every_manner_of_writing_is_read_exactly(case: str, tmp_path: Path):
    content, names, units = WRITTEN[case]
    (tmp_path / "scan.csv").write_bytes(content)
    table = read_csv(tmp_path / "scan.csv")
    assert list(table.columns) == names
    assert [column.tobytes() for column in table.columns.values()] == [TIME.tobytes(), VOLTS.tobytes()]
    assert table.units == units


def test_the_dialect_is_reported(tmp_path: Path):
    (tmp_path / "scan.csv").write_bytes(german())
    about = read_csv(tmp_path / "scan.csv").about
    assert about["table"] == "columns separated by ';', decimal sign ',', utf-8, numbers from line 3 on"
    assert about["left out"] == "Bemerkung (text)"


def test_a_decimal_comma_that_comes_late(tmp_path: Path):
    at_rest = "".join(f"{k};0\n" for k in range(20_000))
    (tmp_path / "scan.csv").write_text("t;u\n" + at_rest + "".join(f"{k};0,5\n" for k in range(20_000, 40_000)))
    assert read_csv(tmp_path / "scan.csv").columns["u"].tolist() == [0.0] * 20_000 + [0.5] * 20_000


def test_a_decimal_comma_in_the_middle_alone_of_utf_16(tmp_path: Path):
    """Half of the file's bytes is an odd number: the sample of the middle must not begin there, within a character."""
    values = ["0"] * 20_000 + ["0,5"] * 20_000 + ["0"] * 20_000
    content = ("t;u\n" + "".join(f"0;{value}\n" for value in values) + "\n").encode("utf-16-le")
    assert len(content) // 2 % 2 == 1
    (tmp_path / "scan.csv").write_bytes(content)
    column = read_csv(tmp_path / "scan.csv").columns["u"]
    assert column.tolist() == [float(value.replace(",", ".")) for value in values]


def test_missing_numbers_are_nan(tmp_path: Path):
    (tmp_path / "scan.csv").write_text("t,u\n0,nan\n1,\n2,inf\n3,-inf\n4,1e-300\n5,NULL\n")
    column = read_csv(tmp_path / "scan.csv").columns["u"]
    assert np.array_equal(column, [np.nan, np.nan, np.inf, -np.inf, 1e-300, np.nan], equal_nan=True)


def test_an_empty_last_column_is_read_to_the_end_of_a_long_file(tmp_path: Path):
    """The file has several blocks of rows; a row that lacks a column behind the second block is an error."""
    full_rows = "0,1,\n" * (2 * ROWS_AT_ONCE)
    (tmp_path / "scan.csv").write_text("t,u,w\n" + full_rows)
    assert read_csv(tmp_path / "scan.csv").columns["u"].size == 2 * ROWS_AT_ONCE
    (tmp_path / "scan.csv").write_text("t,u,w\n" + full_rows + "0,1\n" * 200)
    with pytest.raises(UnreadableData, match=f"line {2 * ROWS_AT_ONCE + 2} has 2 columns"):
        read_csv(tmp_path / "scan.csv")


def test_dates_are_times(tmp_path: Path):
    (tmp_path / "scan.csv").write_text("".join(f"2024-03-01 23:59:59.{k:03d},{k}\n" for k in range(100)))
    table = read_csv(tmp_path / "scan.csv")
    assert table.time == "column_1"
    assert np.allclose(table.columns["column_1"], np.arange(100) * 1e-3, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("hello\nworld\n", "contains no table"),
        ("t,u\n", "contains no table"),
        (
            "t,u\n" + "0,1\n" * 200 + "0,on\n" + "0,1\n" * 200,
            r"column 'u': 'on' is not a number \(about line 202\)",
        ),
        ("t;u\n" + "0;1,5\n" * 200 + "0;1.23,5\n", r"column 'u': '1.23,5' is not a number \(about line 202\)"),
        ("t,u\n" + "0,1\n" * 200 + "\n  \n0,on\n" + "0,1\n" * 200, r"'on' is not a number \(about line 204\)"),
        ("t,u\n" + "0,1\n" * 200 + "0,1,2\n", "line 202 has 3 columns; allowed: 2, as in most lines"),
        (
            "t,u,w\n" + "0,1,2\n" * 200 + "0,1,\n0,1\n0,1,2\n",
            "line 203 has 2 columns; allowed: 3, as in most lines",
        ),
        ("t,u,w\n0,1,2\n\n" + "0,1,2\n" * 200 + "0,1,\n0,1\n0,1,2\n", "line 205 has 2 columns; allowed: 3"),
        ("t\tu\tw\n0\t1\t2\n\n" + "0\t1\t2\n" * 200 + "\t\t\n0\t1\n0\t1\t2\n", "line 205 has 2 columns; allowed: 3"),
        ("t\tu\tw\n0\t1\t2\n\t\t\n" + "0\t1\t2\n" * 200 + "0\t1\n0\t1\t2\n", "line 204 has 2 columns; allowed: 3"),
        ("t,u\n" + "0,1\n" * 200 + "\f\n" + "0,1\n" * 200, "line 202 has 1 column; allowed: 2"),
        ("t,u\n" + "0,1\n" * 200 + "\u00a0\n" + "0,1\n" * 200 + "x,1\n", "is not a number"),
        ("t,u\n" + "0,1\n" * 100 + "\n" + "0,1\n" * 100 + "0,1,2\n", "line 203 has 3 columns; allowed: 2"),
        ("2024-03-01 23:59:59,1\n" * 200 + "yesterday,1\n", r"no date \(about line 201\)"),
        ("2024-03-01 23:59:59,1\n" * 200 + "\nyesterday,1\n", r"no date \(about line 202\)"),
        ("2024-03-01 23:59:59,1\n" * ROWS_AT_ONCE + ",1\n", rf"no date \(about line {ROWS_AT_ONCE + 1}\)"),
        ("t,u\n" + "0,1\n" * 100 + "\0" * 100, "neither text nor another known kind"),
    ],
)
def test_text_that_is_no_table_names_the_place(text: str, message: str, tmp_path: Path):
    (tmp_path / "scan.csv").write_text(text)
    with pytest.raises(UnreadableData, match=message):
        read_csv(tmp_path / "scan.csv")


def test_zeros_beyond_the_examined_part_are_found(tmp_path: Path):
    with (tmp_path / "scan.csv").open("wb") as file:
        file.write(b"t,u\n" + b"0,1\n1,2\n" * 40_000 + bytes(100_000) + b"0,1\n1,2\n" * 120_000)
    with pytest.raises(UnreadableData, match="contains zero bytes, which are not text"):
        read_csv(tmp_path / "scan.csv")
