"""A stretch of a run that goes on, as a recording of its own, beside the run's.

    python -m rtloop.panel.capture SOCKET FILE FIRST END

waits until the ticks FIRST … END − 1 of the run with the recording FILE are written, cuts them out, replays them, and
prints one JSON line: {file, first, end, ticks, gaps, problems, replay}, or {error}.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from itertools import chain, count
from os.path import lexists
from pathlib import Path
from typing import Any, NamedTuple

from rtloop.errors import RtloopError, UnavailableError
from rtloop.foundation.trusted import open_without_link
from rtloop.recording.cutting.cut import cut, cut_path
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.run_readers import run_files
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.service.client import Client

POLL_S = 0.1
GRACE_S = 10.0
"""Beyond the time that the ticks need to come about: the recorder writes twice a second."""
MIN_FREE_BYTES = 128 << 20
"""Twice what the recorder keeps free: no capture costs it a tick."""
ATTEMPTS = 5


class Run(NamedTuple):
    """What is recorded now: NAME.mcap of its recording, the newest tick, the tick behind those that are written."""

    file: Path
    tick: int
    written: int
    rate_hz: float


def current_run(client: Client) -> Run:
    """Of the service. Raises UnavailableError where nothing is recorded."""
    status = client.get("/status")
    recording = status["recording"]
    if "file" not in recording or "rate_hz" not in status:
        raise UnavailableError(f"{client.path}: nothing to capture from: no loop is recorded, it is {status['state']}")
    if recording["state"] != "recording":
        since = f"not recorded from tick {recording['since_tick']} on: {recording['reason']}"
        raise UnavailableError(f"{client.path}: nothing to capture from: {since}")
    return Run(Path(recording["file"]), int(status["tick"]), int(recording["written_ticks"]), float(status["rate_hz"]))


def capture(client: Client, file: Path, first: int, end: int, folder: Path | None = None) -> dict[str, Any]:
    """Ticks `first` to before `end` of the run that is recorded in `file`, once they are written; as `cut` returns it.

    It goes into NAME.capture-FIRST.mcap beside the run's recording, or in `folder`. Raises RecordingError for ticks
    that the run does not have, OutputError, UnavailableError where they are not recorded.
    """
    _await_written(client, file, end)
    for _ in range(ATTEMPTS):
        try:
            return _cut(file, first, end, folder)
        except RecordingError:
            time.sleep(POLL_S)  # a file that is finished meanwhile has another name
    return _cut(file, first, end, folder)


def _await_written(client: Client, file: Path, end: int) -> None:
    """Wait until the ticks before `end` are written, or the run is over. Raises UnavailableError."""
    deadline_s = None
    while True:
        try:
            run = current_run(client)
        except UnavailableError:
            if run_files(file, ".mcap.part"):
                raise
            return  # the run is over; its files say what they have
        if run.file != file or run.written >= end:
            return
        if deadline_s is None:
            deadline_s = time.monotonic() + max(end - run.tick, 0) / run.rate_hz + GRACE_S
        if time.monotonic() > deadline_s:
            raise UnavailableError(f"{file}: tick {end - 1} is not written yet; the recorder is at tick {run.written}")
        time.sleep(POLL_S)


def _cut(file: Path, first: int, end: int, folder: Path | None) -> dict[str, Any]:
    return cut(
        _files_from_tick(file, first), first, end, _unused_path(file, first, folder), min_free_bytes=MIN_FREE_BYTES
    )


def _files_from_tick(file: Path, tick: int) -> list[Path]:
    """The last files of a run, from the one before that with `tick` on: a state of the law may stand in there."""
    paths = {*run_files(file, ".mcap"), *run_files(file, ".mcap.part")}
    files = sorted(paths, key=lambda path: (path.name.removesuffix(".part") != file.name, path.name))
    for index in reversed(range(len(files))):
        with Reader(files[index], tolerant=True, opener=open_without_link) as reader:
            if reader.first_tick <= tick:
                return files[max(index - 1, 0) :]
    return files or [file]


def _unused_path(file: Path, tick: int, folder: Path | None) -> Path:
    """A name that nothing has."""
    path = cut_path(file if folder is None else folder / file.name, tick, "capture")
    alternatives = (path.with_name(f"{path.stem}-{number}.mcap") for number in count(2))
    return next(candidate for candidate in chain([path], alternatives) if not lexists(candidate))


def _replay_verdict(path: Path) -> str:
    """What a replay says."""
    try:
        report = replay(load(path))
    except RtloopError as error:
        return f"not possible: {error}"
    if report.identical:
        return "identical"
    if (difference := report.first_difference) is not None:
        return f"different: tick {difference['tick']}, {difference['signal']}"
    return "; ".join(["no difference, but not verified as a whole", *(entry["why"] for entry in report.not_verified)])


def main() -> int:
    """Command line entry."""
    parser = argparse.ArgumentParser(prog="rtloop.panel.capture", description="save a stretch of a running loop")
    for name, argument_type in (("socket", Path), ("file", Path), ("first", int), ("end", int)):
        parser.add_argument(name, type=argument_type)
    arguments = parser.parse_args()
    response: dict[str, Any]
    try:
        result = capture(Client(arguments.socket), arguments.file, arguments.first, arguments.end)
        path = Path(result["output"])
        response = {"file": path.name, **{key: result[key] for key in ("first", "end", "ticks", "gaps", "problems")}}
        response["replay"] = _replay_verdict(path)
    except RtloopError as error:
        response = {"error": str(error)}
    print(json.dumps(response), flush=True)
    return 1 if "error" in response else 0


if __name__ == "__main__":
    sys.exit(main())
