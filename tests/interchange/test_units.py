"""Units are converted by name, and mappings of columns to signals are read and checked."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from rtloop.errors import ConfigError
from rtloop.interchange.columns import ColumnSelection, extend_selection, find_mapping, read_mapping
from rtloop.interchange.formats.table import Table, UnreadableData
from rtloop.interchange.mapping import axis_names, default_signal_name, map_column, signal_name
from rtloop.interchange.units import UnknownUnit, factor_between, is_unit

HERE = Path("scan.csv")
NAMES = ('"Model Root"/Piezo/Out1', "Sensor (nm)", "Piezo Out", "raw", "pos_nm", "b/raw2")
TABLE = Table(
    {name: np.array([0.0, 1.0, 3.0]) for name in NAMES},
    {"Piezo Out": "mV"},
    about={"left out": "Remark (text)"},
)


@pytest.mark.parametrize(
    ("source", "target", "factor"),
    [
        ("nm", "µm", Fraction(1, 1000)),
        ("mV", "V", Fraction(1, 1000)),
        ("m", "um", Fraction(10**6)),
        ("V·µm/V", "nm", Fraction(1000)),
        ("μm", "µm", Fraction(1)),
        ("Å", "nm", Fraction(1, 10)),
        ("kHz", "1/s", Fraction(1000)),
        ("m/s²", "µm/s^2", Fraction(10**6)),
        ("mm²", "m²", Fraction(1, 10**6)),
        ("1/ms²", "s^-2", Fraction(10**6)),
        ("Volts", "mV", Fraction(1000)),
        ("min", "s", Fraction(60)),
    ],
)
def test_units_are_converted_by_name(source: str, target: str, factor: Fraction):
    assert factor_between(source, target) == factor


@pytest.mark.parametrize(("source", "target"), [("V", "µm"), ("furlong", "m"), ("m/", "m²"), ("s", "Hz")])
def test_units_of_different_kinds_are_refused(source: str, target: str):
    with pytest.raises(UnknownUnit):
        factor_between(source, target)


def test_units_are_recognised():
    assert all(map(is_unit, ("V", "µm/V", "%", "°C", "ms", "1/s")))
    assert not any(map(is_unit, ("", "measured", "1", "/", "x", "Out 1")))


@pytest.mark.parametrize(
    ("signal", "source", "expected"),
    [
        ("x_drive_v", "Piezo Out", [0.0, 0.001, 0.003]),
        ("x_drive_v", "piezo out [V] * 20", [0.0, 20.0, 60.0]),
        ("x_drive_v", "Piezo/Out1 [mV]", [0.0, 0.001, 0.003]),
        ("x_position_um", "Sensor", [0.0, 0.001, 0.003]),
        ("x_position_um", "raw [V] * 2.5 µm/V - 3 µm", [-3.0, -0.5, 4.5]),
        ("x_position_um", "raw [mV] * -250 nm/mV + 1", [1.0, 0.75, 0.25]),
        ("x_position_um", "raw * 0.25 µm/mV", [0.0, 0.25, 0.75]),
        ("x_position_um", "raw * -0.0e5 µm/mV", [0.0, 0.0, 0.0]),
        ("x_position_um", "pos_nm", [0.0, 0.001, 0.003]),
        ("temperature", "raw2 [°C]", [0.0, 1.0, 3.0]),
        ("temperature", "raw2 [°C] + 3 °C", [3.0, 4.0, 6.0]),
        ("temperature", "raw2 [parsec] + 3 parsec", [3.0, 4.0, 6.0]),
        ("temperature", "raw [V] * 20 K/V - 500 mK", [-0.5, 19.5, 59.5]),
        ("temperature", "Piezo Out * 20 K/V + 1 K", [1000.0, 1020.0, 1060.0]),
    ],
)
def test_a_mapping_converts(signal: str, source: str, expected: list[float]):
    assert map_column(TABLE, HERE, signal, source).values(TABLE).tolist() == expected


@pytest.mark.parametrize(
    ("source", "unit"),
    [
        ("raw", ""),
        ("raw [°C] + 3 °C", "°C"),
        ("raw [V] * 20 K/V", "K"),
        ("raw * 20 K/V", "K"),
        ("raw * 0.1 ms", "ms"),
        ("Piezo Out * 20 K/V", "mV·K/V"),
        ("raw [m/s] * 2 s/V", "m·s/s/V"),
    ],
)
def test_a_signal_without_a_known_unit_gets_that_of_its_mapping(source: str, unit: str):
    assert map_column(TABLE, HERE, "temperature", source).unit == unit


def test_assumptions_about_units_are_reported():
    assert "column 'raw' has no known unit; V is assumed" in str(
        map_column(TABLE, HERE, "temperature", "raw * 20 K/V").assumption
    )
    assert "column 'raw' has no known unit; µm is assumed" in str(
        map_column(TABLE, HERE, "x_position_um", "raw").assumption
    )
    assert "column 'Piezo Out' has the unit mV in the file; V is used" in str(
        map_column(TABLE, HERE, "x_drive_v", "Piezo Out [V]").assumption
    )
    assert map_column(TABLE, HERE, "x_drive_v", "Piezo Out [mV]").assumption is None


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            "Piezo Out",
            "x_position_um from column 'Piezo Out': mV cannot be converted to µm; write the unit in brackets",
        ),
        ("Piezo Out * 2 µm/A", "mV · µm/A cannot be converted to µm"),
        ("raw [parsec]", "unit 'parsec' is not known"),
        ("raw [V] * 1e400 µm/V", "x_position_um from column 'raw': factor 1e400; allowed: 0, or a magnitude"),
        ("raw [V] * 1e-320 µm/V", "factor 1e-320; allowed: 0, or a magnitude from 1e-99 to 1e"),
        ("raw [V] * -.01e-400 µm/V", "factor -.01e-400; allowed: 0, or a magnitude from 1e-99 to 1e"),
        (
            "Piezo Uot",
            r"no column 'Piezo Uot'; the columns of the file include 'Piezo Out'.*\(left out: Remark \(text\)\)",
        ),
    ],
)
def test_an_impossible_mapping_names_the_reason(source: str, message: str):
    with pytest.raises(UnreadableData, match=message):
        map_column(TABLE, HERE, "x_position_um", source)


def test_an_offset_of_another_kind_than_the_column_is_refused():
    with pytest.raises(UnreadableData, match="temperature from column 'raw': µm cannot be converted to °C"):
        map_column(TABLE, HERE, "temperature", "raw [°C] + 3 µm")


def test_a_name_that_fits_several_columns_is_refused():
    table = Table({"a/Out1": np.zeros(2), "b/Out1": np.zeros(2)})
    with pytest.raises(UnreadableData, match="'Out1' is ambiguous; give the whole name, one of: 'a/Out1', 'b/Out1'"):
        map_column(table, HERE, "x_drive_v", "Out1")


def test_names():
    assert signal_name("drive_v") == "x_drive_v"
    assert signal_name("y_drive_v") == "y_drive_v"
    assert [default_signal_name(name) for name in ("Größe (µm)", "1", "tick", '"Model Root"/A')] == [
        "Grosse", "column_1", "file_tick", "Model_Root_A"
    ]  # fmt: skip
    assert axis_names(["x_drive_v", "long_name_position_um", "temperature"]) == ["x", "long_name"]
    assert axis_names(["x_drive_v", "x_true_position_um", "x_2_drive_v"]) == ["x", "x_2"]


def test_the_mapping_beside_the_data(tmp_path: Path):
    data = tmp_path / "scan.mat"
    assert find_mapping(data) is None
    (tmp_path / "map.toml").write_text('rate_hz = 100.0\nkeep = ["T"]\n[signals]\nx_drive_v = "U [V]"\n')
    assert find_mapping(data) == tmp_path / "map.toml"
    selection = read_mapping(tmp_path / "map.toml")
    assert selection == ColumnSelection(signals={"x_drive_v": "U [V]"}, keep=("T",), rate_hz=100.0)
    (tmp_path / "scan.map.toml").write_text("all = true\n")
    assert find_mapping(data) == tmp_path / "scan.map.toml"
    assert extend_selection(["x_drive_v=a=b", "A = 1", "T"], ColumnSelection()) == ColumnSelection(
        signals={"x_drive_v": "a=b", "A": "1"}, keep=("T",)
    )


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("signals = 3", "signals: input should be a valid dict"),
        ("tiem = 't'", "tiem: extra inputs are not permitted"),
        ("rate_hz = 0.0", "rate_hz: input should be greater than or equal to 0.001"),
        ("[signals]\n'x y' = 'a'", "signals: 'x y'; allowed: a name of up to 100 letters, digits and _"),
        ("[", "not valid TOML"),
    ],
)
def test_a_wrong_mapping_file_names_the_key(text: str, fault: str, tmp_path: Path):
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(ConfigError, match="1 fault") as caught:
        read_mapping(tmp_path / "map.toml")
    assert fault in str(caught.value)
