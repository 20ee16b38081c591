"""Hands a recording on as CSV, Parquet or npz: every float64 exactly, block by block, never over an existing file."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.errors import MissingExtra, OutputError
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.parts import Files, find_files
from rtloop.recording.load import Recording, load

FORMATS = ("csv", "parquet", "npz")
PASS_BYTES = 512 << 20
"""Memory for the columns of one pass of the npz export."""
ROW_GROUP = 1 << 18

Progress = Callable[[int], None]


def export(files: Files, to: str, output: Path | str | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Write a recording as `to`, one of FORMATS; `progress` is told the ticks so far.

    Returns {recording, output, ticks, bytes, problems}. Raises RecordingError, OutputError, MissingExtra.
    """
    writers = {"csv": _write_csv, "parquet": _write_parquet, "npz": _write_npz}
    if to not in writers:
        raise RecordingError(f"export to {to!r}: possible are {', '.join(FORMATS)}")
    recording = load(files)
    path = find_files(files)[0]
    target = path.with_suffix(f".{to}") if output is None else Path(output)
    with _new_file(target) as part:
        ticks = writers[to](recording, part, progress or (lambda _: None))
    size = target.stat().st_size
    return {
        "recording": str(path),
        "output": str(target),
        "ticks": ticks,
        "bytes": size,
        "problems": recording.problems,
    }


@contextmanager
def _new_file(target: Path) -> Iterator[Path]:
    """A name to write to, which becomes `target` when all went well and disappears otherwise."""
    part = target.with_name(target.name + ".part")
    if target.exists():
        raise OutputError(f"{target} exists already; it is not overwritten")
    try:
        yield part
        os.replace(part, target)
    except OSError as error:
        raise OutputError(f"{target}: {error.strerror or error}") from None
    finally:
        part.unlink(missing_ok=True)


def _write_csv(recording: Recording, path: Path, progress: Progress) -> int:
    """One line of names, then one line a tick; `float()` of each field gives the recorded number."""
    ticks = 0
    with path.open("w", encoding="ascii", newline="") as file:
        file.write(",".join(recording.columns) + "\n")
        for rows in recording.blocks():
            file.writelines(",".join(map(repr, row)) + "\n" for row in rows.tolist())
            ticks += len(rows)
            progress(ticks)
    return ticks


def _write_parquet(recording: Recording, path: Path, progress: Progress) -> int:
    """A column of doubles a signal, its unit in the field's metadata, header and events in the file's."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtra("export to Parquet needs pyarrow: pip install 'rtloop[parquet]'") from None
    fields = [
        pyarrow.field(name, pyarrow.float64(), nullable=False, metadata={"unit": unit})
        for name, unit in recording.units.items()
    ]
    about = {"rtloop.header": json.dumps(recording.header), "rtloop.events": json.dumps(recording.events)}
    schema = pyarrow.schema(fields, metadata=about)
    ticks = 0
    try:
        with pyarrow.parquet.ParquetWriter(path, schema, compression="zstd") as writer:
            for rows in _grouped(recording, recording.columns):
                columns = [np.ascontiguousarray(rows[:, index]) for index in range(rows.shape[1])]
                writer.write_table(pyarrow.Table.from_arrays([pyarrow.array(c) for c in columns], schema=schema))
                ticks += len(rows)
                progress(ticks)
    except pyarrow.ArrowException as error:
        raise OutputError(f"{path}: {error}") from None
    return ticks


def _write_npz(recording: Recording, path: Path, progress: Progress) -> int:
    """An array a signal, and `header_json` and `events_json`; several passes where memory asks for it."""
    ticks = sum(len(rows) for rows in recording.blocks(["tick"]))
    at_once = max(PASS_BYTES // (8 * max(ticks, 1)), 1)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for name, value in (("header_json", recording.header), ("events_json", recording.events)):
            _add_array(archive, name, np.array(json.dumps(value)))
        for start in range(0, len(recording.columns), at_once):
            names = recording.columns[start : start + at_once]
            blocks = list(recording.blocks(names)) or [np.empty((0, len(names)))]
            for index, name in enumerate(names):
                _add_array(archive, name, np.concatenate([rows[:, index] for rows in blocks]))
            progress(ticks * (start + len(names)) // len(recording.columns))
    return ticks


def _add_array(archive: zipfile.ZipFile, name: str, array: np.ndarray[Any, Any]) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)


def _grouped(recording: Recording, names: Sequence[str]) -> Iterator[np.ndarray[Any, Any]]:
    """The blocks, joined to about ROW_GROUP rows."""
    waiting: list[np.ndarray[Any, Any]] = []
    for rows in recording.blocks(names):
        waiting.append(rows)
        if sum(map(len, waiting)) >= ROW_GROUP:
            yield np.concatenate(waiting)
            waiting = []
    if waiting:
        yield np.concatenate(waiting)
