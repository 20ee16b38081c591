"""Recordings at full size: killed runs, damaged files, other processors, an hour at 10 kHz."""

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
from tests.recording.killing import kill_run, recovered_ticks
from tests.recording.real_loop import ROOT, TWO_AXES, eventful_configuration, record
from tests.soak.damage import judge_damaged_files

LONGEST_LIFE_S = 1.5
PROCESSORS = ("generic", "nehalem", "haswell", "znver4")
"""Processors of LLVM, from the least of x86-64 to one of another maker; this host must be able to run their code."""
REPLAY_FOR = """import sys
from rtloop.foundation.native.compiler import numba
numba.config.CPU_NAME, numba.config.CPU_FEATURES = sys.argv[1], ""
import rtloop.cli
rtloop.cli.main.main(sys.argv[2:])"""
"""Program that compiles for the processor of its first argument; it needs a cache of its own."""
LIMITS_S = {"info": 20.0, "replay": 60.0, "plot": 60.0, "plot --html": 60.0}
LIMIT_KIB = 600 * 1024


def check_killed_runs(count: int, random: np.random.Generator) -> None:
    """Kill `count` unpaced runs at a random moment: all recover and replay, and lack a chunk and the lag at most."""
    lags, unwritten, ticks = [], [], []
    for number in range(count):
        with tempfile.TemporaryDirectory() as folder:
            killed = kill_run(Path(folder), random.uniform(0.0, LONGEST_LIFE_S), "--unpaced")
            ticks.append(recovered_ticks(killed))
        lags.append(killed.executed - killed.taken)
        unwritten.append(killed.taken - ticks[-1])
        assert 0 <= unwritten[-1] <= chunk_rows(COLUMNS), killed
        _show_progress(f"killed runs {number + 1}/{count}")
    print(f"killed runs: {count}, all recovered and identical; ticks {min(ticks)} … {max(ticks)}")
    print(f"  recorder's lag in ticks: median {statistics.median(lags):.0f}, largest {max(lags)}")
    print(f"  taken but not yet written: median {statistics.median(unwritten):.0f}, largest {max(unwritten)} "
          f"(a chunk: {chunk_rows(COLUMNS)})")  # fmt: skip


def check_one_hour(folder: Path) -> None:
    """Check the duration and memory of the commands on a recording of 36 million ticks."""
    run_s, _ = _measure_command(
        "run", ROOT / "deploy" / "paper.toml", "--unpaced", "--duration", "3600", "--out", folder, "--json"
    )
    path = next(folder.glob("*.mcap"))
    print(f"an hour at 10 kHz: {path.stat().st_size / 2**30:.2f} GiB, made in {run_s:.0f} s")
    for name, limit_s in LIMITS_S.items():
        command, *options = name.split()
        out = ["--out", folder / "picture"] if command == "plot" else []
        seconds, kib = _measure_command(command, path, *options, *out)
        print(f"  {name}: {seconds:.1f} s ({3600 / seconds:.0f} × real time), {kib / 1024:.0f} MiB")
        assert seconds <= limit_s
        assert kib <= LIMIT_KIB
    path.unlink()


def _measure_command(*arguments: Any) -> tuple[float, int]:
    """Run an `rtloop` command; return its duration (s) and largest resident set (KiB)."""
    script = (
        "import resource, subprocess, sys\n"
        "code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL)\n"
        "print(code, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    begin_s = time.monotonic()
    command = [sys.executable, "-c", script, sys.executable, "-m", "rtloop", *map(str, arguments)]
    code, kib = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    assert code == "0", arguments
    return time.monotonic() - begin_s, int(kib)


def _show_progress(text: str) -> None:
    """Overwrite the line of progress, if stderr is a terminal."""
    if sys.stderr.isatty():
        print(f"\r{text} ", end="", file=sys.stderr)


def check_other_processors(folder: Path) -> None:
    """Check that recordings by code for this processor replay identical by code compiled for other processors."""
    paths = [
        record(folder / "one.mcap", eventful_configuration(), 60_000)[0],
        record(folder / "two.mcap", TWO_AXES, 60_000)[0],
    ]
    for processor in PROCESSORS:
        environment = os.environ | {"XDG_CACHE_HOME": str(folder / processor)}
        for path in paths:
            command = [sys.executable, "-c", REPLAY_FOR, processor, "replay", str(path), "--json"]
            out = subprocess.run(command, env=environment, check=False, capture_output=True, text=True).stdout
            assert json.loads(out)["identical"], (processor, out)
        print(f"code for {processor}: identical")


def main() -> None:
    """Run the named parts, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help="killed, damaged, processors, hour")
    parser.add_argument("--killed", type=int, default=100)
    parser.add_argument("--damaged", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    parts: dict[str, Callable[[Path], None]] = {
        "killed": lambda _: check_killed_runs(options.killed, random),
        "damaged": lambda _: judge_damaged_files(options.damaged, random, _show_progress),
        "processors": check_other_processors,
        "hour": check_one_hour,
    }
    for name in options.parts or parts:
        with tempfile.TemporaryDirectory() as folder:
            parts[name](Path(folder))


if __name__ == "__main__":
    main()
