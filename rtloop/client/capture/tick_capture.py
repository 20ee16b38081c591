"""Ticks of a run that still continues, saved as a recording beside the recording of the run.

    python -m rtloop.client.capture.tick_capture SOCKET FILE FIRST END

waits until the ticks FIRST … END − 1 of the run with the recording FILE are written, cuts them out, replays them, and
prints one JSON line: {file, first, end, ticks, gaps, problems, replay}, or {error}.
"""

from __future__ import annotations

import argparse
import json
import sys
from itertools import count
from os.path import lexists
from pathlib import Path
from typing import Any, NamedTuple

from rtloop.client import Client
from rtloop.errors import RtloopError, UnavailableError
from rtloop.foundation import timing
from rtloop.foundation.trusted import open_without_link
from rtloop.recording.cutting.cut import cut, cut_path
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.run_readers import run_files
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay

POLL_S = 0.1
GRACE_S = 10.0
"""Wait beyond the time at which the last tick runs; the recorder writes twice a second."""
MIN_FREE_BYTES = 128 << 20
"""Disk space that a capture leaves free: twice the recorder's limit, so that no capture costs it a tick."""
ATTEMPTS = 5


class RecordedRun(NamedTuple):
    """The run that a service records now."""

    file: Path
    """NAME.mcap, the first file of its recording."""
    tick: int
    """Number of the newest tick."""
    written: int
    """Number of the first tick that is not yet written."""
    rate_hz: float


def current_run(client: Client) -> RecordedRun:
    """Return the run that the service records now.

    Raises UnavailableError if no loop is recorded, also while the recording of a running loop is interrupted, and if no
    service answers.
    """
    status = client.get("/status")
    recording = status["recording"]
    if "file" not in recording or "rate_hz" not in status:
        raise UnavailableError(
            f"{client.path}: cannot capture, because no loop is recorded now; the state of the service is "
            f"{status['state']}; try again when the loop runs"
        )
    if recording["state"] != "recording":
        raise UnavailableError(
            f"{client.path}: cannot capture, because the loop is not recorded from tick {recording['since_tick']} on: "
            f"{recording['reason']}"
        )
    written, rate_hz = int(recording["written_ticks"]), float(status["rate_hz"])
    return RecordedRun(Path(recording["file"]), int(status["tick"]), written, rate_hz)


def capture_ticks(client: Client, file: Path, first: int, end: int, folder: Path | None = None) -> dict[str, Any]:
    """Wait until ticks `first` … `end` − 1 of the run with the recording `file` are written, and cut them out.

    The new file is NAME.capture-FIRST.mcap beside the run's recording, or in `folder`, with -2, -3, … before its ending
    if the name is taken. Returns the report of `cut`: among others `output`, the new path as text, and `gaps`, [(first
    tick, count)] of the missing ticks. Raises RecordingError for ticks that the run does not have, OutputError if the
    file cannot be written, UnavailableError if the ticks are not written GRACE_S after they were due, or the recording
    was interrupted.
    """
    _await_written(client, file, end)
    attempt = 1
    while True:
        output = _unused_path(file, first, folder)
        try:
            return cut(_files_with_ticks(file, first, end), first, end, output, min_free_bytes=MIN_FREE_BYTES)
        except RecordingError:
            if attempt > ATTEMPTS:
                raise
            attempt += 1
            timing.sleep(POLL_S)  # The recorder renames a file when it is complete.


def _await_written(client: Client, file: Path, end: int) -> None:
    """Wait until the ticks before `end` of the run with the recording `file` are written, or the run is over.

    Raises UnavailableError if the run's recording has stopped without being finished, or if the ticks are not written
    GRACE_S after the last one was due.
    """
    deadline_s = None
    while True:
        try:
            run = current_run(client)
        except UnavailableError:
            if run_files(file, ".mcap.part"):
                raise
            return  # The run is over; its files are complete.
        if run.file != file or run.written >= end:
            return
        if deadline_s is None:
            deadline_s = timing.monotonic_s() + max(end - run.tick, 0) / run.rate_hz + GRACE_S
        if timing.monotonic_s() > deadline_s:
            raise UnavailableError(
                f"{file}: tick {end - 1} is not written yet; the recorder is at tick {run.written}; try again"
            )
        timing.sleep(POLL_S)


def _files_with_ticks(file: Path, first: int, end: int) -> list[Path]:
    """Return the files of the run with the recording `file` that hold the ticks `first` … `end` − 1, in their order.

    The file before these files is included, because a replay may need it. Files that begin at `end` or later are left
    out, because the recorder may rename them meanwhile. If no file begins at `first` or earlier, all files that begin
    before `end` are returned; [file] if the run has no file. Raises RecordingError for a file that cannot be read.
    """
    paths = {*run_files(file, ".mcap"), *run_files(file, ".mcap.part")}
    files = sorted(paths, key=lambda path: (path.name.removesuffix(".part") != file.name, path.name))
    last = len(files)
    for index in reversed(range(len(files))):
        with Reader(files[index], tolerant=True, opener=open_without_link) as reader:
            if reader.first_tick <= first:
                return files[max(index - 1, 0) : last]
            if reader.first_tick >= end:
                last = max(index, 1)
    return files[:last] or [file]


def _unused_path(file: Path, tick: int, folder: Path | None) -> Path:
    """Return a path for the capture at which no file lies: NAME.capture-TICK.mcap in `folder` (None: beside `file`), or
    with -2, -3, … before its ending.
    """
    path = candidate = cut_path(file if folder is None else folder / file.name, tick, "capture")
    numbers = count(2)
    while lexists(candidate):
        candidate = path.with_name(f"{path.stem}-{next(numbers)}.mcap")
    return candidate


def _replay_verdict(path: Path) -> str:
    """Replay a recording and return the verdict: "identical", or a text that states the first difference, the parts
    that were not verified, or the RtloopError for which no replay is possible.
    """
    try:
        report = replay(load(path))
    except RtloopError as error:
        return f"not possible: {error}"
    if report.identical:
        return "identical"
    if (difference := report.first_difference) is not None:
        return f"different: tick {difference['tick']}, signal {difference['signal']}"
    return "; ".join(
        [
            "no difference, but the replay could not verify the whole recording",
            *(entry["why"] for entry in report.not_verified),
        ]
    )


def main() -> int:
    """Save the ticks FIRST … END − 1 of a run as a separate recording, and check it by a replay of the law.

    The module describes the command line, and the JSON line that is printed. Returns 1 after {error}, else 0, also if
    the replay differs.
    """
    parser = argparse.ArgumentParser(prog="rtloop.client.capture.tick_capture", description="save ticks of a run")
    for name, argument_type in (("socket", Path), ("file", Path), ("first", int), ("end", int)):
        parser.add_argument(name, type=argument_type)
    arguments = parser.parse_args()
    try:
        result = capture_ticks(Client(arguments.socket), arguments.file, arguments.first, arguments.end)
        path = Path(result["output"])
        figures = {key: result[key] for key in ("first", "end", "ticks", "gaps", "problems")}
        response = {"file": path.name, **figures, "replay": _replay_verdict(path)}
    except RtloopError as error:
        response = {"error": str(error)}
    print(json.dumps(response), flush=True)
    return 1 if "error" in response else 0


if __name__ == "__main__":
    sys.exit(main())
