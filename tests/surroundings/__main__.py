"""Table of surroundings and commands: every command of the command line in odd folders, environments and streams.

    make soak NAME=surroundings FLAGS="--only planted --commands export,plot"

A cell fails by a traceback, a signal, planted code that ran, another exit code than in clean surroundings without a
message that names the cause, and by files that are missing, empty or unlike the clean ones. Rows that need root are
left out for other users.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from pathlib import Path

from rtloop import connect
from tests.surroundings.cell import CLEAN, Bench, Ending, faults
from tests.surroundings.commands import (
    COMMANDS,
    LONG,
    PROGRAM,
    Command,
    clean_environment,
    make_stock,
    missing_commands,
)
from tests.surroundings.surroundings import SURROUNDINGS, Surrounding


def main() -> int:
    """Print a line for each surrounding, and its failed cells; return 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="rows, by parts of their names, separated by commas")
    parser.add_argument("--commands", help="commands, by their beginnings, separated by commas")
    parser.add_argument("--short", action="store_true", help="leave out commands that compute for seconds")
    parser.add_argument("--stock", type=Path, help="folder of the files that commands read, made if it is missing")
    parser.add_argument("--share", type=float, default=1.0, help="part of the cells that is tried, drawn at random")
    parser.add_argument("--seed", type=int, default=1, help="seed of this draw")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--text", action="store_true", help="print the messages of failed cells")
    options = parser.parse_args()
    if missing := missing_commands():
        sys.exit(f"commands without a cell: {', '.join(sorted(missing))}")
    rows = {
        name: row for name, row in SURROUNDINGS.items()
        if (not options.only or any(part in name for part in options.only.split(",")))
        and (os.geteuid() == 0 or not row.root)
    }  # fmt: skip
    begins = tuple(options.commands.split(",")) if options.commands else ("",)
    commands = [command for command in COMMANDS if command.words.replace("--socket {socket} ", "").startswith(begins)]
    if options.short:
        commands = [command for command in commands if not command.words.startswith(LONG)]
    with tempfile.TemporaryDirectory(prefix="s", dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o755)
        (folder / "home").mkdir()
        environment = clean_environment(folder / "home")
        stock = options.stock or folder / "stock"
        if not stock.exists():
            make_stock(stock, environment)
        with _service(folder, stock, environment) as socket:
            bench = Bench(folder, stock, environment, socket)
            draw = random.Random(options.seed)
            drawn = {name: [word for word in commands if draw.random() < options.share] for name in rows}
            return Table(bench, options.jobs, options.text).run(rows, drawn)


class _service:
    """The service of shared commands: it runs in clean surroundings while all cells run."""

    def __init__(self, folder: Path, stock: Path, environment: dict[str, str]) -> None:
        self._socket = folder / "run" / "paper.sock"
        environment = environment | {"RUNTIME_DIRECTORY": str(folder / "run")}
        command = [PROGRAM, "serve", stock / "paper.toml"]
        self._process = subprocess.Popen(command, cwd=folder, env=environment, stderr=subprocess.DEVNULL)

    def __enter__(self) -> Path:
        while not self._socket.exists():
            assert self._process.poll() is None, "the service did not start"
            time.sleep(0.1)
        return self._socket

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGINT)
        self._process.wait()


def _let_run(socket: Path) -> None:
    """Let the service run in closed loop at 0 µm, with a change that can be undone, whatever a client did before."""
    with connect(socket) as service:
        status = service.status
        if status["state"] == "tripped":
            print(f"the service tripped: {status['trip']}, {status['trip_reason']}, {status['faults']}", flush=True)
            service.reset()
        service.arm()
        service.start()
        service.mode("closed_loop")
        service.setpoint("x", 0.0)
        service.tune("x", "controller", gain=0.016)


class Table:
    """Cells of the table, run by several threads; clients of the one service run one after the other."""

    def __init__(self, bench: Bench, jobs: int, shows_text: bool) -> None:
        self._bench, self._jobs, self._shows_text = bench, jobs, shows_text
        self._numbers = count()

    def run(self, rows: dict[str, Surrounding], commands: dict[str, list[Command]]) -> int:
        """Run the clean cells twice, then the commands of each row; print what failed. Returns 1 if a cell failed."""
        begin_s = time.monotonic()
        tried = list(dict.fromkeys(command for row in commands.values() for command in row))
        clean = dict(zip(tried, zip(self._row(CLEAN, tried), self._row(CLEAN, tried), strict=True), strict=True))
        for command, pair in clean.items():
            if found := faults(pair[0], pair, CLEAN) or pair[0].code != pair[1].code:
                print(f"clean: {command.words}: {found}\n{pair[0].stderr[-1500:]}", flush=True)
        failed = 0
        for name, surrounding in rows.items():
            endings = zip(commands[name], self._row(surrounding, commands[name]), strict=True)
            bad = [
                (command, ending, found)
                for command, ending in endings
                if (found := faults(ending, clean[command], surrounding))
            ]
            failed += len(bad)
            print(f"{name:32} {len(commands[name]):4} cells {len(bad):4} failed", flush=True)
            for command, ending, found in bad:
                print(f"    {command.words}: {'; '.join(found)}", flush=True)
                if self._shows_text:
                    print("        " + ending.stderr[-1200:].replace("\n", "\n        "), flush=True)
        minutes = (time.monotonic() - begin_s) / 60
        cells = sum(map(len, commands.values()))
        print(f"{len(rows)} surroundings, {len(tried)} commands: {cells} cells, {failed} failed; {minutes:.0f} minutes")
        return bool(failed)

    def _row(self, surrounding: Surrounding, commands: list[Command]) -> list[Ending]:
        with ThreadPoolExecutor(self._jobs) as pool, ThreadPoolExecutor(1) as clients:
            pools = [clients if command.shared else pool for command in commands]
            futures = [
                chosen.submit(self._cell, command, surrounding) for chosen, command in zip(pools, commands, strict=True)
            ]
            return [future.result() for future in futures]

    def _cell(self, command: Command, surrounding: Surrounding) -> Ending:
        if command.shared:
            _let_run(self._bench.socket)
        number = next(self._numbers)
        try:
            return self._bench.run(number, command, surrounding)
        finally:
            for part in "cml":
                shutil.rmtree(os.fsencode(self._bench.folder / f"{part}{number}"), ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
