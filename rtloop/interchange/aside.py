"""Reads a file in a process of its own: one that is damaged may bring a library down, or ask for all the memory.

    python -m rtloop.interchange.aside FILE [GROUP]

prints a JSON object in a line, {"error", "kind"} or {"rows", "columns", "units", "time", "about",
"in_other_files"}, and behind it the columns' doubles, one column after the other.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from typing import IO, Any

import numpy as np

from rtloop.errors import MissingExtra, RtloopError
from rtloop.interchange.formats.groups import BYTES_AT_MOST, rows_of
from rtloop.interchange.formats.table import Table, UnopenedData, UnreadableData
from rtloop.interchange.reading import read_here

MEMORY_BYTES = 6 * BYTES_AT_MOST
"""Of address space: libraries, what is read, and the copies that are made on the way."""


def read_table(path: Path, group: str | None = None) -> Table:
    """The columns of a file; `group` says which ones, where it has several rasters, groups or topics.

    Raises UnreadableData, MissingExtra.
    """
    command = [sys.executable, "-m", __name__, str(path), *([] if group is None else [group])]
    calm = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdin=quiet, stdout=subprocess.PIPE, stderr=quiet, env=calm) as process:
        assert process.stdout
        table = _received(path, process.stdout)
    if table is None:
        number = -process.returncode
        what = signal.Signals(number).name if number > 0 else f"exit code {process.returncode}"
        raise UnreadableData(f"{path}: damaged: the library that reads such files came to grief over it ({what})")
    return table


def _received(path: Path, stream: IO[bytes]) -> Table | None:
    """The table; None where the process ended before it was whole. Raises what it says was wrong."""
    line = stream.readline()
    if not line.endswith(b"\n"):
        return None
    said = json.loads(line)
    if "error" in said:
        kinds = {kind.__name__: kind for kind in (MissingExtra, UnopenedData)}
        raise kinds.get(said["kind"], UnreadableData)(said["error"])
    columns = {name: np.empty(said["rows"]) for name in said["columns"]}
    for values in columns.values():
        rest = values.data.cast("B")
        while len(rest) and (count := stream.readinto(rest)):  # type: ignore[attr-defined]
            rest = rest[count:]
        if len(rest):
            return None
    return Table(columns, said["units"], said["time"], said["about"], tuple(said["in_other_files"]))


def _main(path: Path, group: str | None) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    out = sys.stdout.buffer
    try:
        table = read_here(path, group)
    except RtloopError as fault:
        _say(out, {"error": str(fault), "kind": type(fault).__name__})
        return
    except MemoryError:
        _say(out, {"error": f"{path}: needs more than {MEMORY_BYTES >> 30} GiB of memory; cut it", "kind": ""})
        return
    except Exception as fault:  # whatever a library lets through of a damaged file
        _say(out, {"error": f"{path}: damaged ({type(fault).__name__}: {str(fault)[:200]})", "kind": ""})
        return
    about = {"rows": rows_of(table), "columns": [*table.columns], "units": dict(table.units)}
    about |= {"time": table.time, "about": dict(table.about), "in_other_files": [*table.in_other_files]}
    _say(out, about)
    for values in table.columns.values():
        out.write(values.data.cast("B"))
    out.flush()


def _say(out: IO[bytes], what: dict[str, Any]) -> None:
    out.write(json.dumps(what).encode() + b"\n")
    out.flush()


if __name__ == "__main__":
    _main(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else None)
