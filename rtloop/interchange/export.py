"""Export of a recording as CSV, Parquet, npz, HDF5 or MAT: every float64 exactly, never over an existing file."""

from __future__ import annotations

import errno
import json
import os
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from rtloop.errors import MissingExtra, OutputError, output_errors
from rtloop.foundation.arrays import Real
from rtloop.foundation.trusted import replace_file
from rtloop.interchange.hdf5_signals import append_rows, create_dataset, descriptor_path
from rtloop.interchange.to_csv import write_csv
from rtloop.interchange.to_mat import write_mat
from rtloop.recording.columns import describe_signal
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.run_readers import RecordingPaths, find_files
from rtloop.recording.load import Recording, load
from rtloop.recording.views.selection import ALL_SIGNALS, Selection

EXPORT_SUFFIXES = {"csv": ".csv", "parquet": ".parquet", "npz": ".npz", "mat": ".mat", "hdf5": ".h5"}
"""Formats, and the suffixes of their files."""
PASS_BYTES = 512 << 20
"""Memory for the columns of one pass of the npz export."""
ROW_GROUP = 1 << 18

ReportTicks = Callable[[int], None]


def export(
    files: RecordingPaths,
    to: str,
    output: Path | str | None = None,
    progress: ReportTicks | None = None,
    selection: Selection = ALL_SIGNALS,
) -> dict[str, object]:
    """Write the selected signals and ticks of a recording in format `to`, a key of EXPORT_SUFFIXES.

    `progress` receives the number of ticks written; for npz, whose columns are written one after the other, the number
    of all ticks times the share of columns written; for mat, only the final number. `output` is by default a file
    beside the recording, with its name and the format's suffix. Returns {recording, output, ticks, bytes, problems};
    the problems are texts on damaged parts of the recording, which are left out. Raises RecordingError for an unknown
    format, an unreadable recording, a pattern that fits no signal, a limited time span without ticks and a MAT file
    above 2 GiB; OutputError if the output exists or cannot be written; MissingExtra if the format's package is missing.
    An incomplete output is removed.
    """
    if to not in EXPORT_SUFFIXES:
        raise RecordingError(f"export to {to!r}; allowed: {', '.join(EXPORT_SUFFIXES)}")
    recording, report_ticks = load(files), progress or (lambda _: None)
    path = find_files(files)[0]
    target = path.with_suffix(EXPORT_SUFFIXES[to]) if output is None else Path(output)
    writers = {"csv": _write_csv, "parquet": _write_parquet, "npz": _write_npz, "hdf5": _write_hdf5}
    with _new_file(target) as part:
        if to == "mat":
            ticks = write_mat(recording, part, target, selection)
            report_ticks(ticks)
        else:
            ticks = writers[to](recording, part, selection, report_ticks)
    size = target.stat().st_size
    return {
        "recording": str(path),
        "output": str(target),
        "ticks": ticks,
        "bytes": size,
        "problems": recording.problems,
    }


@contextmanager
def _new_file(target: Path) -> Iterator[IO[bytes]]:
    """Yield a new file `target`.part, open for writing; rename it to `target` if the block succeeds, else remove it.

    An old `target`.part is replaced. Raises OutputError if `target` exists, the file cannot be made, or the block
    raises OSError.
    """
    part = target.with_name(target.name + ".part")
    if os.path.lexists(target):
        raise OutputError(f"{target}: exists already and is not overwritten; use another name, or remove the file")
    with output_errors(part):
        fd = replace_file(part)
    try:
        with output_errors(target):
            with os.fdopen(fd, "w+b") as file:
                yield file
            os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)


def _write_csv(recording: Recording, file: IO[bytes], selection: Selection, progress: ReportTicks) -> int:
    """Write a line of names, then a line for each tick; `float()` of each field gives the recorded number.

    Returns the number of ticks.
    """
    names = selection.selected_names(recording)
    return write_csv(file, names, selection.read_blocks(recording, names), progress)


def _write_parquet(recording: Recording, file: IO[bytes], selection: Selection, progress: ReportTicks) -> int:
    """Write a column of doubles for each signal, with `unit` in its metadata; write header and events, as JSON, to the
    file's metadata rtloop.header and rtloop.events.

    Returns the number of ticks. Raises OSError if pyarrow fails, MissingExtra without pyarrow.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtra("export to Parquet needs pyarrow: pip install 'rtloop[parquet]'") from None
    names, units = selection.selected_names(recording), recording.units
    fields = [pyarrow.field(name, pyarrow.float64(), nullable=False, metadata={"unit": units[name]}) for name in names]
    about = {"rtloop.header": json.dumps(recording.header), "rtloop.events": json.dumps(recording.events)}
    schema = pyarrow.schema(fields, metadata=about)
    ticks = 0
    try:
        with pyarrow.parquet.ParquetWriter(file, schema, compression="zstd") as writer:
            for rows in _join_blocks(selection.read_blocks(recording, names)):
                columns = [np.ascontiguousarray(rows[:, index]) for index in range(rows.shape[1])]
                writer.write_table(pyarrow.Table.from_arrays([pyarrow.array(c) for c in columns], schema=schema))
                ticks += len(rows)
                progress(ticks)
    except pyarrow.ArrowException as error:
        raise OSError(errno.EIO, str(error)) from None
    return ticks


def _write_npz(recording: Recording, file: IO[bytes], selection: Selection, progress: ReportTicks) -> int:
    """Write an array for each signal, and the texts header_json and events_json.

    Each pass over the recording reads columns of up to PASS_BYTES, at least one. Returns the number of ticks.
    """
    all_names = selection.selected_names(recording)
    ticks = sum(len(rows) for rows in selection.read_blocks(recording, ["tick"]))
    columns_per_pass = max(PASS_BYTES // (8 * max(ticks, 1)), 1)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for name, value in (("header_json", recording.header), ("events_json", recording.events)):
            _add_array(archive, name, np.array(json.dumps(value)))
        for start in range(0, len(all_names), columns_per_pass):
            names = all_names[start : start + columns_per_pass]
            blocks = list(selection.read_blocks(recording, names)) or [np.empty((0, len(names)))]
            for index, name in enumerate(names):
                _add_array(archive, name, np.concatenate([rows[:, index] for rows in blocks]))
            progress(ticks * (start + len(names)) // len(all_names))
    return ticks


def _write_hdf5(recording: Recording, file: IO[bytes], selection: Selection, progress: ReportTicks) -> int:
    """Write a dataset for each signal, with the attributes `unit` and `meaning`, the datasets header_json and
    events_json, and the file's attribute `rate_hz`.

    Returns the number of ticks. Raises MissingExtra without h5py.
    """
    try:
        import h5py
    except ImportError:
        raise MissingExtra("export to HDF5 needs h5py: pip install 'rtloop[data]'") from None
    names, ticks = selection.selected_names(recording), 0
    with h5py.File(descriptor_path(file), "w", track_order=True) as root:
        root.attrs["rate_hz"] = recording.header["rate_hz"]
        for name, value in (("header_json", recording.header), ("events_json", recording.events)):
            root[name] = json.dumps(value)
        datasets = [create_dataset(root, name) for name in names]
        for name, dataset in zip(names, datasets, strict=True):
            dataset.attrs.update({"unit": recording.units[name], "meaning": describe_signal(name).meaning})
        for rows in selection.read_blocks(recording, names):
            append_rows(datasets, rows)
            ticks += len(rows)
            progress(ticks)
    return ticks


def _add_array(archive: zipfile.ZipFile, name: str, array: npt.NDArray[np.generic]) -> None:
    """Write an array as the member `name`.npy of an npz archive."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)


def _join_blocks(blocks: Iterable[Real]) -> Iterator[Real]:
    """Yield the rows of `blocks`, joined to blocks of at least ROW_GROUP rows; the last one may have fewer."""
    pending: list[Real] = []
    for rows in blocks:
        pending.append(rows)
        if sum(map(len, pending)) >= ROW_GROUP:
            yield np.concatenate(pending)
            pending = []
    if pending:
        yield np.concatenate(pending)
