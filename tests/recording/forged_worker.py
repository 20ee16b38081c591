"""Use forged recordings in a separate process, so that a crash shows its file: `… FOLDER FIRST COUNT [EVERY]`.

The process prints a line of JSON before each file (its number) and after it (the outcome of each command). Each command
must end with an exit code of CODES, within its time and memory. A replay that is `identical` is checked by the stock
reader.
"""

from __future__ import annotations

import json
import shutil
import signal
import sys
import traceback
from pathlib import Path
from typing import Any, NamedTuple

from click.testing import CliRunner
from mcap.reader import NonSeekingReader

from rtloop import signals
from rtloop.cli import main
from rtloop.signals import COMMON_COUNT, MODE, PER_AXIS_COUNT, TICK, axis_column
from tests.recording.forging import TICKS, Base, Forgery, forge, pack_file, record_bases

TIME_LIMIT_S = 30
CODES = (0, 1, 66, 73, 78)
SHORT_TAGS = 15
COMPUTED = (signals.POSITION, signals.ERROR, signals.COMMAND, signals.DEMAND, signals.DRIVE)
COMMANDS = {"set_mode": ("value",), "reset_trip": (), "stop": (), "load_law": ("axis", "value")}
"""Kinds of commands that a replay executes, and the fields that the loop uses of each."""
COMMAND_LINES: dict[str, list[str]] = {
    "info": ["info", "run.mcap", "--json"],
    "info, words": ["info", "run.mcap"],
    "replay": ["replay", "run.mcap", "--json"],
    "replay, words": ["replay", "run.mcap"],
    "page": ["plot", "run.mcap", "--html"],
    "csv": ["export", "run.mcap", "--to", "csv"],
    "recover": ["recover", "run.mcap", "--json"],
    "plot": ["plot", "run.mcap"],
    "resimulate": ["replay", "run.mcap", "--resimulate", "--json"],
}
SLOW_COMMANDS = ("info, words", "replay, words", "plot", "resimulate")


class ExecutedData(NamedTuple):
    """Data that a replay executes or compares: the computed bytes of each tick, snapshots of the law, commands."""

    ticks: list[bytes]
    snapshots: list[bytes]
    commands: list[Any]


class Hang(BaseException):
    """A command takes more than SECONDS."""


def read_executed(path: Path, axes: int) -> ExecutedData:
    """Read the executed data of a file with the stock reader, without the file's index."""
    data = ExecutedData([], [], [])
    with path.open("rb") as file:
        for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            if channel.topic == "/ticks":
                data.ticks.append(computed_bytes(message.data, axes))
            elif channel.topic == "/law":
                data.snapshots.append(message.data)
            elif channel.topic == "/events":
                event = json.loads(message.data)
                if event["kind"] in COMMANDS:
                    fields = {"axis": event["axis"], "value": event["what"]["values"][0]}
                    used = (fields[key] for key in COMMANDS[event["kind"]])
                    data.commands.append((event["tick"], event["kind"], *used))
    return data


def computed_bytes(data: bytes, axes: int) -> bytes:
    """Return the bytes of tick, mode and computed signals of a message, whose fields are a tag and eight bytes each."""
    tags = [1 if field < SHORT_TAGS else 2 for field in range(COMMON_COUNT + axes * PER_AXIS_COUNT)]
    starts = [sum(tags[: field + 1]) + 8 * field for field in range(len(tags))]
    computed = [axis_column(axis, signal) for axis in range(axes) for signal in COMPUTED]
    return b"".join(data[starts[field] : starts[field] + 8] for field in (TICK, MODE, *computed))


def run_commands(
    forgery: Forgery, folder: Path, names: list[str], base: Base, original: ExecutedData
) -> dict[str, str]:
    """Run the commands on a forgery. Returns for each its exit code, or its failure as text."""
    outcomes = {}
    for name in names:
        for path in folder.iterdir():
            path.unlink()
        (folder / "run.mcap").write_bytes(forgery.data)
        arguments = [str(folder / word) if word == "run.mcap" else word for word in COMMAND_LINES[name]]
        outcomes[name] = outcome = _run_command(arguments)
        if name == "replay" and outcome == "0" and _is_wrongly_identical(forgery, folder / "run.mcap", base, original):
            outcomes[name] = "wrongly identical"
    return outcomes


def _run_command(arguments: list[str]) -> str:
    """Run a command. Returns its exit code, or its failure as text."""
    signal.alarm(TIME_LIMIT_S)
    try:
        result = CliRunner().invoke(main, arguments)
    except Hang:
        return "hang"
    finally:
        signal.alarm(0)
    error = result.exception
    if error is not None and not isinstance(error, SystemExit):
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"traceback {type(error).__name__}: {str(error)[:80]} ({Path(last.filename).name}:{last.lineno})"
    if "Warning" in result.stderr:
        return f"warning {result.stderr[-150:]}"
    if result.exit_code not in CODES:
        return f"exit {result.exit_code}"
    if result.exit_code == 66 and not (result.stderr.startswith("rtloop: ") and result.stderr.count("\n") == 1):
        return f"message {result.stderr[:100]!r}"
    return str(result.exit_code)


def _is_wrongly_identical(forgery: Forgery, path: Path, base: Base, original: ExecutedData) -> bool:
    """Return whether the file of an identical replay differs from the original, by the stock reader."""
    try:
        data = read_executed(path, len(base.header["axes"]))
    except Exception:  # The stock reader raises many exceptions.
        return forgery.renewed
    is_subset = forgery.origin or set(data.snapshots) <= set(original.snapshots)
    return not is_subset or (data.ticks, data.commands) != (original.ticks, original.commands)


def _raise_hang(*_: object) -> None:
    """Raise Hang: the handler of the alarm signal."""
    raise Hang


def peak_kib() -> int:
    """Return the peak memory of this process in KiB; getrusage may give the peak of its parent."""
    status = Path("/proc/self/status").read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))


def run(folder: Path, first: int, count: int, every: int) -> None:
    """Run the commands on `count` forgeries from number `first` on; the slow commands on one in `every`."""
    signal.signal(signal.SIGALRM, _raise_hang)
    recordings: list[Base] = record_bases(folder)
    originals = []
    for base in recordings:
        (folder / "whole.mcap").write_bytes(pack_file(base))
        originals.append(read_executed(folder / "whole.mcap", len(base.header["axes"])))
        assert len(originals[-1].ticks) == TICKS
    use_folder = folder / "use"
    use_folder.mkdir()
    for number in range(first, first + count):
        forgery = forge(recordings, number)
        print(json.dumps({"number": number, "what": forgery.change}), flush=True)
        names = [name for name in COMMAND_LINES if name not in SLOW_COMMANDS or number % every == 0]
        which = number % len(recordings)
        outcomes = run_commands(forgery, use_folder, names, recordings[which], originals[which])
        peak_mib = peak_kib() >> 10
        print(json.dumps({"number": number, "outcomes": outcomes, "peak_mib": peak_mib}), flush=True)
    shutil.rmtree(use_folder)


if __name__ == "__main__":
    run(Path(sys.argv[1]), *map(int, sys.argv[2:5]))
