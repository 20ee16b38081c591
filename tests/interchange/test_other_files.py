"""A file with pointers to other files: values that only the user may read get into no recording."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli.import_file import import_command
from rtloop.interchange.formats.table import Hints, UnreadableData
from rtloop.interchange.reading import read_in_process
from rtloop.recording.load import load

ROWS = 50
TIME, DRIVE = np.arange(ROWS) * 1e-3, np.arange(ROWS) * 0.1
CANARY = 7_777_777.25
HEADER = b"MATLAB 7.3 MAT-file, written by a stranger"


@pytest.fixture
def canary(tmp_path: Path) -> Path:
    """A private file of CANARY values in HDF5, with the same values beside it as raw bytes."""
    path = tmp_path / "private" / "canary.h5"
    path.parent.mkdir()
    with h5py.File(path, "w") as file:
        file["data"] = np.full(ROWS, CANARY)
        file.create_group("group")["data"] = np.full(ROWS, CANARY)
    np.full(ROWS, CANARY).tofile(path.with_suffix(".raw"))
    return path


# Each function below writes one pointer to the canary under a name of a group.
def external_storage(place: Any, name: str, canary: Path) -> Any:
    raw = [(str(canary.with_suffix(".raw")), 0, ROWS * 8)]
    return place.create_dataset(name, (ROWS,), "<f8", external=raw)


def virtual(place: Any, name: str, canary: Path) -> Any:
    layout = h5py.VirtualLayout((ROWS,), "<f8")
    layout[:] = h5py.VirtualSource(str(canary), "data", (ROWS,))
    return place.create_virtual_dataset(name, layout)


def external_link(place: Any, name: str, canary: Path) -> None:
    place[name] = h5py.ExternalLink(str(canary), "/data")


def soft_link(place: Any, name: str, canary: Path) -> None:
    place.file.require_group("hidden")["door"] = h5py.ExternalLink(str(canary), "/group")
    place[name] = h5py.SoftLink("/hidden/door/data")


def soft_link_to_a_link(place: Any, name: str, canary: Path) -> None:
    place.file.require_group("hidden")["exit"] = h5py.ExternalLink(str(canary), "/data")
    place.file["hidden"]["hall"] = h5py.SoftLink("./exit")
    place[name] = h5py.SoftLink("/hidden/hall")


def linked_group(place: Any, name: str, canary: Path) -> None:
    place[name] = h5py.ExternalLink(str(canary), "/group")


def reference(place: Any, name: str, canary: Path) -> None:
    """Write references to a good dataset and to two datasets whose values are in the canary."""
    cells = place.file.require_group("#refs#")
    cells["a"] = DRIVE
    b, c = external_storage(cells, "b", canary), virtual(cells, "c", canary)
    place.create_dataset(name, (3, 1), h5py.ref_dtype)[:, 0] = [cells["a"].ref, b.ref, c.ref]


POINTERS = [external_storage, virtual, external_link, soft_link, soft_link_to_a_link, linked_group]
Pointer = Callable[[Any, str, Path], Any]


def write_scan(path: Path, canary: Path, *pointers: Pointer) -> Path:
    """Write a file with two columns and pointers to the canary; version 7.3 of MAT if its name ends in .mat."""
    is_mat = path.suffix == ".mat"
    with h5py.File(path, "w", userblock_size=512 if is_mat else 0) as file:
        scan = file.create_group("scan")
        for name, values in (("time", TIME), ("drive", DRIVE)):
            scan[name] = values
        for pointer in pointers:
            pointer(scan, pointer.__name__, canary)
            pointer(file, f"top_{pointer.__name__}", canary) if pointer is external_link else None
    if is_mat:
        data = bytearray(path.read_bytes())
        data[:128] = HEADER.ljust(116) + bytes(8) + b"\x00\x02IM"
        path.write_bytes(data)
    return path


@pytest.mark.parametrize("ending", ["h5", "mat"])
@pytest.mark.parametrize("pointer", [*POINTERS, reference])
def test_data_in_another_file_are_skipped_and_named(tmp_path: Path, canary: Path, ending: str, pointer: Pointer):
    table = read_in_process(write_scan(tmp_path / f"scan.{ending}", canary, pointer), Hints("scan"))
    columns = {name.rpartition("/")[2]: values for name, values in table.columns.items()}
    assert (columns["time"].tobytes(), columns["drive"].tobytes()) == (TIME.tobytes(), DRIVE.tobytes())
    assert not any(np.any(values == CANARY) for values in table.columns.values())
    expected_name = "#refs#" if pointer is reference and ending == "h5" else pointer.__name__
    assert any(expected_name in text for text in table.in_other_files), table.in_other_files


def test_links_within_a_file_are_followed(tmp_path: Path):
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        inner = file.create_group("b/inner")
        inner["time"], inner["raw"] = TIME, DRIVE
        inner["drive"] = h5py.SoftLink("raw")
        file["a"] = h5py.SoftLink("/b/inner")
        inner["lost"], inner["round"] = h5py.SoftLink("/b/none"), h5py.SoftLink("round")
    table = read_in_process(tmp_path / "scan.h5")
    assert {name: values.tobytes() for name, values in table.columns.items()} == {
        "time": TIME.tobytes(), "drive": DRIVE.tobytes()
    }  # fmt: skip
    assert table.in_other_files == ()
    assert table.about["left out"].count("a link without a target") == 2


def test_a_file_of_pointers_alone_is_refused(tmp_path: Path, canary: Path):
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        for pointer in POINTERS:
            pointer(file, pointer.__name__, canary)
    with pytest.raises(
        UnreadableData, match="two or more numbers; left out because their values are in other files: external_link"
    ):
        read_in_process(path)


@pytest.mark.parametrize("ending", ["h5", "mat"])
def test_an_import_names_skipped_columns(tmp_path: Path, canary: Path, ending: str):
    path = write_scan(tmp_path / f"scan.{ending}", canary, *POINTERS, reference)
    out = tmp_path / "scan.mcap"
    arguments = [str(path), "--all", "--group", "scan", "--rate", "1000", "--out", str(out), "--json"]
    result = CliRunner().invoke(import_command, arguments)
    assert result.exit_code == 0, result.output
    skipped = json.loads(result.stdout)["in_other_files"]
    for pointer in POINTERS:
        assert any(pointer.__name__ in text for text in skipped), skipped
        assert f"scan/{pointer.__name__}" in result.stderr
    recording = load(out)
    assert not any(np.any(recording[name] == CANARY) for name in recording.columns)
