"""Archives for tests: copies of one short recording, with damaged, cut and forged recordings among them."""

from __future__ import annotations

import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from rtloop.kernel.layout import COEFFICIENTS
from rtloop.recording.file.mcap.container import CHUNK_HEAD
from rtloop.recording.file.reader import Reader
from tests.campaigns.campaign_files import PAPER, ROOT, rtloop
from tests.recording.forging import first_chunk, pack_file, take_apart
from tests.recording.tamper import Rows, flip_byte, rewrite

DRIVE_TICK = 777
START_S = 60.0


def record_short_run(folder: Path) -> Path:
    """Record the paper's loop for 0.3 s. Returns the path of the recording."""
    process = rtloop("run", PAPER, "--duration", 0.3, "--unpaced", "--out", folder, folder=folder)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    (path,) = folder.glob("*.mcap")
    return path


def flip_tick_byte(source: Path, target: Path) -> None:
    """Flip one byte in the data of the ticks."""
    with Reader(source) as reader:
        place = reader.tick_chunks[0].offset + CHUNK_HEAD.size + 1_000
    flip_byte(source, place, target)


def truncate(source: Path, target: Path) -> None:
    """Write the file without its last third."""
    data = source.read_bytes()
    target.write_bytes(data[: len(data) * 2 // 3])


def zero_middle(source: Path, target: Path) -> None:
    """Write zeros over 4 KiB in the middle of the file."""
    data = bytearray(source.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 4096] = bytes(4096)
    target.write_bytes(data)


def write_text(source: Path, target: Path) -> None:
    """Write a text under the name of a recording."""
    target.write_text("Stage 3, Tuesday: cable replaced.\n")


def change_coefficient(source: Path, target: Path) -> None:
    """Add one unit in the last place to a coefficient of the recorded law."""
    offset = 8 + COEFFICIENTS.fields["um_per_v"][1]  # type: ignore[index]

    def change(data: bytearray) -> None:
        (value,) = struct.unpack_from("<d", data, offset)
        struct.pack_into("<d", data, offset, np.nextafter(value, np.inf))

    rewrite(source, target, law=change)


def change_drive(source: Path, target: Path) -> None:
    """Change the recorded drive of one tick by 1 nV."""
    with Reader(source) as reader:
        column = reader.columns.index("x_drive_v")

    def change(rows: Rows) -> None:
        rows[rows[:, 0] == DRIVE_TICK, column] += 1e-9

    rewrite(source, target, rows=change)


def change_header(source: Path, target: Path, **values: Any) -> None:
    """Write the recording with changed fields of its header."""
    base = take_apart(source)
    target.write_bytes(pack_file(base, first_chunk({**base.header, **values}, base.header["columns"])))


BAD: dict[str, tuple[Callable[[Path, Path], None], str, str]] = {
    "flipped": (flip_tick_byte, "damaged", "is damaged"),
    "cut": (truncate, "damaged", "ends in the middle of a chunk"),
    "zeroed": (zero_middle, "damaged", "is damaged"),
    "text": (write_text, "cannot be read", "not a recording: not an MCAP file"),
    "coefficient": (change_coefficient, "differs", "replayed"),
    "drive": (change_drive, "differs", "replayed"),
    "layout": (lambda *paths: change_header(*paths, law={"laws": []}), "other version", "stores a law's state"),
}
"""Bad recordings by name: the function that writes one, its verdict, and a part of the verdict's reason."""


def make_archive(folder: Path, source: Path, count: int, bad: Sequence[str]) -> None:
    """Fill five subfolders with `count` copies of a recording, and with the bad recordings of the names `bad`."""
    for number in range(count):
        place = folder / f"day-{number % 5}" / f"run-{number:03d}.mcap"
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, place)
    for number, name in enumerate(bad):
        BAD[name][0](source, folder / f"day-{number % 5}" / f"{name}.mcap")


def archive(*arguments: object, folder: Path, environment: dict[str, str] | None = None) -> tuple[int, dict[str, Any]]:
    """Run `rtloop archive` with --json in a folder. Returns its exit code and its JSON object."""
    process = rtloop("archive", *arguments, "--json", folder=folder, environment=environment)
    output, errors = process.communicate(timeout=280)
    assert "Traceback" not in errors, errors
    return process.returncode, json.loads(output) if output else {"error": errors}


def bad_rows(report: dict[str, Any], good_verdict: str = "identical") -> dict[str, dict[str, Any]]:
    """Return the rows with another verdict than `good_verdict`, by the stem of the file name."""
    return {Path(row["path"]).stem: row for row in report["verdicts"] if row["verdict"] != good_verdict}


def require_exact(report: dict[str, Any], bad: Sequence[str]) -> None:
    """Raise AssertionError unless exactly the bad recordings are named, with their verdicts and reasons."""
    rows = bad_rows(report)
    assert sorted(rows) == sorted(bad), rows
    for name in bad:
        _, verdict, reason = BAD[name]
        assert rows[name]["verdict"] == verdict, rows[name]
        assert reason in rows[name]["reason"], rows[name]


@contextmanager
def dask_cluster(folder: Path, workers: int, settings: Mapping[str, str] = MappingProxyType({})) -> Iterator[str]:
    """Start a Dask scheduler and worker processes with one thread each. Yields the scheduler's address.

    `settings` are additional environment variables of these processes.
    """
    address_file = folder / "scheduler.json"
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, **settings, "PYTHONPATH": os.pathsep.join(paths)}
    parts = (
        ("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"),
        ("worker", "--host", "127.0.0.1", "--nthreads", "1", "--nworkers", str(workers), "--no-dashboard"),
    )
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for kind, *options in parts:
            with (folder / f"{kind}.log").open("wb") as log:
                command = [sys.executable, "-m", "dask", kind, "--scheduler-file", str(address_file), *options]
                processes.append(
                    subprocess.Popen(
                        command, cwd=folder, env=environment, start_new_session=True, stdout=log, stderr=log
                    )
                )
            _wait_for(address_file.exists, folder / f"{kind}.log")
        _wait_for(lambda: (folder / "worker.log").read_text().count("Registered to") >= workers, folder / "worker.log")
        yield json.loads(address_file.read_text())["address"]
    finally:
        for process in reversed(processes):
            os.killpg(process.pid, signal.SIGTERM)
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def _wait_for(is_ready: Callable[[], bool], log: Path) -> None:
    """Wait until a process is ready. Raises AssertionError with its log after START_S."""
    end_s = time.monotonic() + START_S
    while not is_ready():
        assert time.monotonic() < end_s, log.read_text()
        time.sleep(0.05)
