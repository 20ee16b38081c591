"""Runs beside 20 busy loops: the host is to blame for each trip, and dead supervisors are noticed as before.

`make soak NAME=busy`. One line a run: in virtual time, paced, as an idle service, and with a supervisor that is killed
or stopped; these four kinds run at the same time. It ends with exit code 1 if a run in virtual time trips, if another
trip does not name the host's stall with its length, or if a lost supervisor leads to no trip within the heartbeat's
timeout.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from mcap.reader import make_reader

import rtloop
from rtloop.errors import RtloopError

ROOT = Path(__file__).resolve().parents[2]
PAPER = ROOT / "deploy" / "paper.toml"
TIMEOUT_S, TIMEOUT_OF_HEARTBEAT_S, LOOK_S = 900.0, 1.0, 0.05
"""Longest wait for a process; default of `loop.heartbeat_timeout_s`; time for one more look and one tick."""
HOST = re.compile(r"for [\d.]+ s: the host stalled|too little of a processor on a busy host, had no tick for [\d.]+ s")
BUSY_LOOP = ("sh", "-c", "while :; do :; done")


@contextmanager
def busy_host(count: int) -> Iterator[None]:
    """Run `count` busy loops meanwhile."""
    loops = [subprocess.Popen(BUSY_LOOP) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


@contextmanager
def command(folder: Path, *arguments: str | Path) -> Iterator[subprocess.Popen[str]]:
    """Start an rtloop command, whose control sockets lie in `folder`; it is killed at the end if it still runs."""
    process = subprocess.Popen(
        [sys.executable, "-m", "rtloop", *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": str(ROOT), "RUNTIME_DIRECTORY": str(folder)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def await_true(condition: Callable[[], object], what: str) -> None:
    """Wait until `condition` returns a true value. Raises TimeoutError after TIMEOUT_S."""
    end_s = time.monotonic() + TIMEOUT_S
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError(what)
        time.sleep(0.02)


def unblamed(texts: list[str]) -> str:
    """Return the verdict of the texts of trips and faults: each must name the host's stall with its length."""
    bad = [text for text in texts if not HOST.search(text)]
    return f"FAILS: {'; '.join(bad)}" if bad else f"holds: {'; '.join(texts) or 'no trip'}"


def run_alone(folder: Path, seconds: float, *options: str) -> str:
    """Run the paper's loop to its end and return the verdict; in virtual time no trip is allowed."""
    with command(folder, "run", PAPER, "--duration", f"{seconds}", "--out", folder, "--json", *options) as process:
        out, error = process.communicate(timeout=TIMEOUT_S + 60 * seconds)
        report = json.loads(out) if out.strip() else {}
        texts = [trip["reason"] or ", ".join(trip["causes"]) for trip in report.get("trips", [])]
        if process.returncode and not texts:
            texts = [error.strip()]
        return unblamed(texts) if "--unpaced" not in options or not texts else f"FAILS: {'; '.join(texts)}"


def stand_idle(folder: Path, seconds: float) -> str:
    """Let an armed service stand without a command for `seconds`, and return the verdict."""
    config = folder / "idle.toml"
    text = PAPER.read_text(encoding="utf-8").replace('folder = "recordings"', f'folder = "{folder}"')
    config.write_text(f"{text}\n[service]\narm = true\n", encoding="utf-8")
    with command(folder, "serve", config) as process:

        def status() -> dict[str, object]:
            try:
                with rtloop.connect(folder / "idle.sock") as loop:
                    return loop.status
            except RtloopError:
                return {}

        await_true(lambda: status().get("ticks") or process.poll() is not None, "the service's first tick")
        time.sleep(seconds)
        faults = status().get("faults", ["the service gives no status"])
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=TIMEOUT_S)
        return unblamed(list(map(str, faults)))  # type: ignore[call-overload]


def lose_supervisor(folder: Path, number: signal.Signals) -> str:
    """Kill or stop `rtloop run` while its loop drives; return the time until the trip, with the verdict."""
    with command(folder, "run", PAPER, "--out", folder, "--json") as process:
        await_true(lambda: any(part.stat().st_size > 100_000 for part in folder.glob("*.part")), "a recording")
        time.sleep(1.0)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        struck_ns = time.time_ns()
        process.send_signal(number)
        if number == signal.SIGSTOP:
            await_true(lambda: all(_has_ended(child) for child in children[:1]), "the end of the loop")
            process.send_signal(signal.SIGCONT)
        await_true(lambda: all(_has_ended(child) for child in children), "the end of loop and recorder")
    (path,) = folder.glob("*.mcap")
    with path.open("rb") as file:
        events = [
            (message.log_time, json.loads(message.data))
            for *_, message in make_reader(file).iter_messages(topics=["/events"])
        ]
    trip_ns, trip = next((time_ns, event) for time_ns, event in events if event["kind"] == "tripped")
    recording = rtloop.load(path)
    silent_s, late_s = (
        (trip_ns - struck_ns) / 1e9,
        float(recording["lateness_us"][recording["tick"] == trip["tick"]][0]) / 1e6,
    )
    word = "died" if number == signal.SIGKILL else "stopped by a signal"
    holds = (
        silent_s <= TIMEOUT_OF_HEARTBEAT_S + LOOK_S
        and word in trip["what"]["reason"]
        and recording["x_drive_v"][-1] == 0
    )
    verdict = "holds" if holds else "FAILS"
    return f"{verdict}: trip due {silent_s:.3f} s after it, {1e3 * late_s:.1f} ms late: {trip['what']['reason']}"


def _has_ended(pid: str) -> bool:
    """Return whether a process is gone, or dead and not waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def main() -> None:
    """Run all, print a line a run, and exit with 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--runs", type=int, default=50, help="runs in virtual time; two fifths of them of each other kind"
    )
    parser.add_argument("--minutes", type=float, default=1.0, help="length of a paced or idle run")
    parser.add_argument("--loops", type=int, default=20, help="busy loops beside")
    options = parser.parse_args()
    others, seconds = max(1, round(0.4 * options.runs)), 60.0 * options.minutes
    signals = (signal.SIGKILL, signal.SIGSTOP)
    kinds: dict[str, tuple[int, Callable[[Path, int], str]]] = {
        "virtual": (options.runs, lambda folder, _: run_alone(folder, 10.0, "--unpaced")),
        "paced": (others, lambda folder, _: run_alone(folder, seconds)),
        "idle": (others, lambda folder, _: stand_idle(folder, seconds)),
        "lost": (max(others, 2), lambda folder, number: lose_supervisor(folder, signals[number % 2])),
    }

    def run_kind(kind: str) -> int:
        """Run one kind, and return how many runs of it fail."""
        (count, measure), failures = kinds[kind], 0
        for number in range(count):
            with tempfile.TemporaryDirectory() as name:
                begin_s = time.monotonic()
                try:
                    verdict = measure(Path(name), number)
                except (TimeoutError, subprocess.TimeoutExpired) as error:
                    verdict = f"FAILS: no end: {error}"
            failures += verdict.startswith("FAILS")
            print(f"{kind} {number + 1}/{count} {time.monotonic() - begin_s:.0f} s {verdict}", flush=True)
        return failures

    with busy_host(options.loops), ThreadPoolExecutor(len(kinds)) as kinds_at_once:
        failures = sum(kinds_at_once.map(run_kind, kinds))
    print(f"{failures} of {sum(count for count, _ in kinds.values())} runs fail")
    sys.exit(failures > 0)


if __name__ == "__main__":
    main()
