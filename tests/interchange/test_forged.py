"""Recordings that claim to be imported, with headers that no import writes, are refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.recording.errors import RecordingError
from rtloop.recording.file.writer import Writer
from rtloop.recording.load import load
from tests.recording.hand_made_loop import final_message, make_header

IMPORTED: dict[str, Any] = {
    "file": "a.mat", "sha256": "0", "time": "t [s]", "mapping": {"u": "U"}, "units": {"u": "V"}, "notes": []
}  # fmt: skip
GOOD: dict[str, Any] = {
    "columns": ["tick", "deadline_ns", "u"], "axes": [], "observed": [], "law": None, "imported": IMPORTED
}  # fmt: skip


def write_file(folder: Path, **changes: Any) -> Path:
    """Write an imported recording of five ticks with changes to its header. Returns its path."""
    header = make_header(**{**GOOD, **changes})
    writer = Writer(folder / "a.mcap", header, 0)
    writer.write_ticks(np.column_stack([np.arange(5.0)] * len(header["columns"])))
    writer.finish(lambda logged: final_message(5, logged))
    return folder / "a.mcap"


def test_a_valid_header_is_accepted(tmp_path: Path):
    recording = load(write_file(tmp_path))
    assert recording["u"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert recording.units == {"tick": "1", "deadline_ns": "ns", "u": "V"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"columns": ["deadline_ns", "tick", "u"]}, "must be tick and deadline_ns"),
        ({"imported": IMPORTED | {"units": {"v": "V"}}}, "imported.units: there is no column"),
        ({"imported": IMPORTED | {"units": {"u": 3}}}, "imported.units.u: 3"),
        ({"imported": IMPORTED | {"notes": ["\x1b[2J"]}}, "imported.notes.0"),
        ({"imported": {}}, "imported.file: .*required"),
        ({"imported": None}, "imported: None"),
        ({"law": {}}, "law: .*none"),
    ],
)
def test_a_forged_header_is_refused(changes: dict[str, Any], message: str, tmp_path: Path):
    with pytest.raises(RecordingError, match=message):
        load(write_file(tmp_path, **changes))
