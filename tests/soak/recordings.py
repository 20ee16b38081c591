"""Recordings in full size: killed runs, damaged files, other processors, an hour at 10 kHz."""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.recording.file.topics.format import chunk_rows
from tests.recording.hand_made_loop import COLUMNS
from tests.recording.killing import kill_a_run, recovered_ticks
from tests.recording.real_loop import ROOT, TWO_AXES, record, scheduled
from tests.soak.damage import judge_damaged_files

LONGEST_LIFE_S = 1.5
PROCESSORS = ("generic", "nehalem", "haswell", "znver4")
"""From the least that x86-64 guarantees to one of another maker; this host must be able to run all of them."""
LIMITS_S = {"info": 20.0, "replay": 60.0, "plot": 60.0, "plot --html": 60.0}
LIMIT_KIB = 600 * 1024


def killed_runs(count: int, random: np.random.Generator) -> None:
    """Unpaced runs, SIGKILL at a random moment; all recover and replay, at most a chunk and the lag are missing."""
    lags, unwritten, ticks = [], [], []
    for number in range(count):
        with tempfile.TemporaryDirectory() as folder:
            killed = kill_a_run(Path(folder), random.uniform(0.0, LONGEST_LIFE_S), "--unpaced")
            ticks.append(recovered_ticks(killed))
        lags.append(killed.executed - killed.taken)
        unwritten.append(killed.taken - ticks[-1])
        assert 0 <= unwritten[-1] <= chunk_rows(COLUMNS), killed
        _say(f"killed runs {number + 1}/{count}")
    print(f"killed runs: {count}, all recovered and identical; ticks {min(ticks)} … {max(ticks)}")
    print(f"  recorder's lag in ticks: median {statistics.median(lags):.0f}, largest {max(lags)}")
    print(f"  taken but not yet written: median {statistics.median(unwritten):.0f}, largest {max(unwritten)} "
          f"(a chunk: {chunk_rows(COLUMNS)})")  # fmt: skip


def one_hour(folder: Path) -> None:
    """Time and memory of the commands on a recording of 36 million ticks."""
    run = _measured("run", ROOT / "deploy" / "paper.toml", "--unpaced", "--duration", "3600", "--out", folder, "--json")
    path = next(folder.glob("*.mcap"))
    print(f"an hour at 10 kHz: {path.stat().st_size / 2**30:.2f} GiB, made in {run[0]:.0f} s")
    for name, limit_s in LIMITS_S.items():
        command, *options = name.split()
        out = ["--out", folder / "picture"] if command == "plot" else []
        seconds, kib = _measured(command, path, *options, *out)
        print(f"  {name}: {seconds:.1f} s ({3600 / seconds:.0f} × real time), {kib / 1024:.0f} MiB")
        assert seconds <= limit_s
        assert kib <= LIMIT_KIB
    path.unlink()


def _measured(*arguments: Any) -> tuple[float, int]:
    """Wall clock in s and largest resident set in KiB of a command."""
    script = (
        "import resource, subprocess, sys\n"
        "code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL)\n"
        "print(code, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    began = time.monotonic()
    command = [sys.executable, "-c", script, sys.executable, "-m", "rtloop", *map(str, arguments)]
    code, kib = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    assert code == "0", arguments
    return time.monotonic() - began, int(kib)


def _say(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\r{text} ", end="", file=sys.stderr)


def other_processors(folder: Path) -> None:
    """A recording made by code for this processor replays identical by code that is compiled for others."""
    paths = [record(folder / "one.mcap", scheduled(), 60_000)[0], record(folder / "two.mcap", TWO_AXES, 60_000)[0]]
    for processor in PROCESSORS:
        environment = os.environ | {"NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": ""}
        for path in paths:
            command = [sys.executable, "-m", "rtloop", "replay", str(path), "--json"]
            out = subprocess.run(command, env=environment, check=False, capture_output=True, text=True).stdout
            assert json.loads(out)["identical"], (processor, out)
        print(f"code for {processor}: identical")


def main() -> None:
    """All parts, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help="killed, damaged, processors, hour")
    parser.add_argument("--killed", type=int, default=100)
    parser.add_argument("--damaged", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    random = np.random.default_rng(given.seed)
    parts: dict[str, Callable[[Path], None]] = {
        "killed": lambda _: killed_runs(given.killed, random),
        "damaged": lambda _: judge_damaged_files(given.damaged, random, _say),
        "processors": other_processors,
        "hour": one_hour,
    }
    for name in given.parts or parts:
        with tempfile.TemporaryDirectory() as folder:
            parts[name](Path(folder))


if __name__ == "__main__":
    main()
