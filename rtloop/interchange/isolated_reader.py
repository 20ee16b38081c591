"""Reads a file in a separate process: a damaged file may crash a library, or exhaust the memory.

    python -m rtloop.interchange.isolated_reader FILE HINTS

HINTS are the fields of `Hints` as JSON. It prints a JSON object in a line, {"error", "kind"} or {"rows", "columns"}
with the other fields of the `Table`, followed by the columns' doubles, one column after the other.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import IO, cast

import numpy as np

from rtloop.errors import MissingExtra, RtloopError
from rtloop.foundation.children import child_environment, python_command
from rtloop.interchange.formats.groups import MAX_BYTES, row_count
from rtloop.interchange.formats.table import NO_HINTS, AmbiguousData, Hints, Table, UnopenedData, UnreadableData
from rtloop.interchange.reading import read_in_process

MEMORY_BYTES = 6 * MAX_BYTES
"""Limit of address space: libraries, the data, and copies made while reading."""


def read_table(path: Path, hints: Hints = NO_HINTS) -> Table:
    """Return the columns of a file, read in a separate process; `hints.group` picks one of several rasters or groups.

    None: the longest one with several columns, or else the longest one; an MCAP file must then have a single topic.
    Raises UnopenedData if the file cannot be opened; AmbiguousData if `hints` must decide; UnreadableData if it is of
    no known format, damaged, too large or has no such group, or if the process is killed; MissingExtra if the format's
    package is missing.
    """
    command = python_command(__name__, path, json.dumps(asdict(hints)))
    environment = child_environment({"OPENBLAS_NUM_THREADS": "1"})
    devnull = subprocess.DEVNULL
    with subprocess.Popen(command, stdin=devnull, stdout=subprocess.PIPE, stderr=devnull, env=environment) as process:
        table = _receive_table(path, cast("IO[bytes]", process.stdout))
    if table is None:
        number = -process.returncode
        if number == signal.SIGKILL:
            raise UnreadableData(f"{path}: the process that read the file was killed; free some memory, and try again")
        cause = signal.Signals(number).name if number > 0 else f"exit code {process.returncode}"
        raise UnreadableData(f"{path}: the file is damaged; the library that reads such files crashed ({cause})")
    return table


def _receive_table(path: Path, stream: IO[bytes]) -> Table | None:
    """Return the table that the process sends; None where it ended before the table was complete.

    Raises the process's error: UnreadableData, UnopenedData or MissingExtra.
    """
    line = stream.readline()
    if not line.endswith(b"\n"):
        return None
    message = json.loads(line)
    if "error" in message:
        kinds = {kind.__name__: kind for kind in (MissingExtra, UnopenedData, AmbiguousData)}
        raise kinds.get(message["kind"], UnreadableData)(message["error"])
    rows = message.pop("rows")
    columns = {name: np.empty(rows) for name in message.pop("columns")}
    for values in columns.values():
        remaining = values.data.cast("B")
        while len(remaining) and (count := stream.readinto(remaining)):  # type: ignore[attr-defined]
            remaining = remaining[count:]
        if len(remaining):
            return None
    return Table(columns, **message)


def _serve_table(path: Path, hints: Hints) -> None:
    """Read a file within the memory limit, and write the table, or the error, to stdout."""
    with suppress(ImportError):  # Windows limits no process by itself.
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    out = sys.stdout.buffer
    try:
        table = read_in_process(path, hints)
    except RtloopError as fault:
        _send_line(out, {"error": str(fault), "kind": type(fault).__name__})
        return
    except MemoryError:
        _send_line(
            out, {"error": f"{path}: needs more than {MEMORY_BYTES >> 30} GiB of memory; split the file", "kind": ""}
        )
        return
    except Exception as fault:  # whatever a library lets through of a damaged file
        _send_line(out, {"error": f"{path}: damaged ({type(fault).__name__}: {str(fault)[:200]})", "kind": ""})
        return
    evidence = {field.name: getattr(table, field.name) for field in fields(table)}
    _send_line(out, evidence | {"rows": row_count(table), "columns": [*table.columns]})
    for values in table.columns.values():
        out.write(values.data.cast("B"))
    out.flush()


def _send_line(out: IO[bytes], message: Mapping[str, object]) -> None:
    """Write a message as a line of JSON, and flush it."""
    out.write(json.dumps(message).encode() + b"\n")
    out.flush()


if __name__ == "__main__":
    _serve_table(Path(sys.argv[1]), Hints(**json.loads(sys.argv[2])))
