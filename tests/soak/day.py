"""A simulated day with 20 events, recorded around the events only, and the files that a quota or a full disk leaves."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop.recording.file.topics.overview import uncovered_ranges
from rtloop.recording.load import load
from tests.recording.real_loop import PAPER, ROOT

RATE_HZ = 10_000
"""Rate of the paper's loop. At another rate the feedforward runs alone: the controller is designed for this rate."""
BEFORE_S, AFTER_S = 10, 30
LOUD_V = 4.5
"""Drive (V) of an event: the usual reference stays below, steps of 25 µm exceed it."""
EVENTS = ("trip", "mode", "loud")
USUAL = 'reference = { kind = "sine", amplitude = 10.0, frequency_hz = 5.0 }'
SEQUENCES = {
    "trip": [(0.0, 'reference = { kind = "steps", levels = [75.0, 0.0], dwell_s = 5.0 }'), (3.0, USUAL),
             (4.0, "reset_trip = true"), (4.1, 'mode = "MODE"')],
    "mode": [(0.0, 'mode = "off"'), (2.0, 'mode = "MODE"')],
    "loud": [(0.0, 'reference = { kind = "steps", levels = [25.0, -25.0], dwell_s = 0.5 }'), (2.0, USUAL)],
}  # fmt: skip
"""Scheduled changes of each kind of event: seconds after its beginning, and lines of [[schedule]]."""


class Event(NamedTuple):
    """A kind out of EVENTS, and its first tick."""

    kind: str
    tick: int


def plan_events(hours: float, count: int, rate_hz: int = RATE_HZ) -> list[Event]:
    """Return `count` events, the kinds in turn, each at a random moment of its share of the time."""
    share_s, random = hours * 3600 / count, np.random.default_rng(7)
    begins_s = [(k + random.uniform(0.3, 0.7)) * share_s for k in range(count)]
    return [Event(EVENTS[k % len(EVENTS)], round(begin_s * rate_hz)) for k, begin_s in enumerate(begins_s)]


def configuration(events: list[Event], recording: str, rate_hz: int) -> str:
    """Return the paper's configuration with these events on its schedule and `recording` added to [recording]."""
    condition = f'["trip", "mode", "abs(x_drive_v) > {LOUD_V}"]'
    window = f"around = {{ before_s = {BEFORE_S}, after_s = {AFTER_S}, on = {condition} }}\n"
    steps = PAPER[PAPER.index("[axis.reference]") :].split("\n\n", 1)[0]
    text = PAPER.replace(steps, f"[axis.reference]\n{USUAL.partition('{')[2].strip(' }').replace(', ', chr(10))}\n")
    text = text.replace('folder = "recordings"\n', f'folder = "recordings"\n{window}{recording}')
    mode = "closed_loop"
    if rate_hz != RATE_HZ:
        mode, text = "feedforward", text.replace("position_um = 60.0", "position_um = 35.0")
        text = text.replace("prewarp_hz = 595.5", f"prewarp_hz = {rate_hz / 10}")
        text = text.replace("rate_hz = 10000", f'rate_hz = {rate_hz}\nmode = "feedforward"')
    changes = [(event.tick + round(at_s * rate_hz), lines) for event in events for at_s, lines in SEQUENCES[event.kind]]
    entries = "".join(f"\n[[schedule]]\nat_tick = {tick}\n{lines}\n" for tick, lines in changes)
    return text + entries.replace("MODE", mode)


def run_command(*arguments: object) -> tuple[float, float, str]:
    """Run an `rtloop` command. Return its duration (s), peak memory (MiB) and output.

    Raises CalledProcessError for an exit code other than 0 and 1.
    """
    begin_s = time.monotonic()
    command = [sys.executable, "-m", "rtloop", *map(str, arguments)]
    with tempfile.TemporaryFile("w+") as out:
        process = subprocess.Popen(command, stdout=out, cwd=ROOT)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        output = out.read()
    if process.returncode not in (0, 1):
        raise subprocess.CalledProcessError(process.returncode, command, output)
    return time.monotonic() - begin_s, usage.ru_maxrss / 1024, output


def record_day(
    folder: Path, hours: float, events: list[Event], recording: str, rate_hz: int = RATE_HZ
) -> tuple[dict[str, Any], float, Path]:
    """Record a run into `folder`/recordings. Return its report, its duration (s) and the pattern of its files."""
    config = folder / "day.toml"
    config.write_text(configuration(events, recording, rate_hz))
    duration_s, _, output = run_command(
        "run", config, "--unpaced", "--duration", hours * 3600, "--out", folder / "recordings", "--json"
    )
    return json.loads(output), duration_s, folder / "recordings" / "day-*.mcap"


def require_events(files: Path | list[Path], events: list[Event], ticks: int, rate_hz: int) -> int:
    """Return the number of recorded stretches. Raises AssertionError if a tick around an event is not recorded."""
    recording = load(files)
    assert recording.problems == [], recording.problems
    recorded_ranges = uncovered_ranges(0, ticks, recording.skipped)
    for event in events:
        first, last = event.tick - BEFORE_S * rate_hz, min(event.tick + AFTER_S * rate_hz, ticks - 1)
        assert any(begin <= first and last < begin + count for begin, count in recorded_ranges), event
    return len(recorded_ranges)


def check_day(folder: Path, hours: float, count: int, rate_hz: int) -> None:
    """Record a day; check its events and replay; print sizes, and durations of `info` and `replay`."""
    events, ticks = plan_events(hours, count, rate_hz), round(hours * 3600 * rate_hz)
    report, duration_s, pattern = record_day(folder, hours, events, "rotate_s = 3600.0\nkeep_gib = 100.0\n", rate_hz)
    assert (report["complete"], report["ticks_lost"], report["problems"]) == (True, 0, []), report
    assert report["ticks_logged"] + report["ticks_skipped"] == ticks
    size_mib, files = report["size_bytes"] / 2**20, report["recordings"]
    print(f"{hours:g} h at {rate_hz} Hz with {count} events, made in {duration_s:.0f} s")
    print(f"  {len(files)} files, {size_mib:.1f} MiB in all, {size_mib / hours:.2f} MiB an hour")
    stretches, logged = require_events(pattern, events, ticks, rate_hz), report["ticks_logged"]
    print(f"  {logged:,} of {ticks:,} ticks kept, in {stretches} stretches")
    info_s, info_mib, output = run_command("info", pattern, "--json")
    assert json.loads(output)["complete"]
    print(f"  info {info_s:.1f} s, {info_mib:.0f} MiB of memory")
    replay_s, replay_mib, output = run_command("replay", pattern, "--json")
    verdict = json.loads(output)
    assert (verdict["identical"], verdict["gaps"], verdict["stretches"]) == (True, [], stretches), verdict
    print(f"  replay {replay_s:.1f} s, {replay_mib:.0f} MiB of memory: identical in {stretches} stretches")
    assert all(json.loads(run_command("replay", path, "--json")[2])["identical"] for path in files)
    print("  each file alone replays identical too")


def check_quota(folder: Path, hours: float, count: int, keep_mib: float, title: str, min_free_mib: float = 0.0) -> None:
    """Record with a quota; check that the files around trips remain and that others are removed."""
    events, ticks = plan_events(hours, count), round(hours * 3600 * RATE_HZ)
    lines = f"rotate_s = 300.0\nkeep_gib = {keep_mib / 1024}\nmin_free_mib = {min_free_mib}\n"
    report, _, pattern = record_day(folder, hours, events, lines)
    assert report["error"] is None, report["error"]
    remaining = sorted(pattern.parent.glob(pattern.name))
    file_count = max(int(path.stem[-4:]) for path in remaining)
    size_bytes = sum(path.stat().st_size for path in remaining)
    trips = [event for event in events if event.kind == "trip"]
    recorded_ticks = np.concatenate([load(path)["tick"] for path in remaining])
    for trip in trips:
        around = np.arange(trip.tick - BEFORE_S * RATE_HZ, min(trip.tick + AFTER_S * RATE_HZ, ticks))
        assert np.isin(around, recorded_ticks, assume_unique=True).all(), trip
    assert all(json.loads(run_command("replay", path, "--json")[2])["identical"] for path in remaining)
    assert len(remaining) < file_count
    remaining_names = {path.name for path in remaining}
    removed_names = {
        event["what"]["file"] for path in remaining for event in load(path).events if event["kind"] == "removed"
    }
    assert removed_names
    assert not removed_names & remaining_names
    assert size_bytes <= keep_mib * 2**20
    print(f"{title}: {hours:g} h in {file_count} files, {len(remaining)} remain with {size_bytes / 2**20:.1f} MiB "
          f"and name {len(removed_names)} removed files; "
          f"every tick around {len(trips)} trips is recorded, each file replays identical")  # fmt: skip


@contextmanager
def small_disk(folder: Path, mib: int) -> Iterator[Path]:
    """Mount a file system of `mib` MiB on the new folder (root only); yield the folder."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={mib}m", "tmpfs", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def check_quotas(folder: Path) -> None:
    """Check a quota that is reached and, as root, a disk that is full before its quota is reached."""
    check_quota(folder / "quota", 2.0, 12, 200.0, "a quota of 200 MiB")
    if os.geteuid() == 0:
        with small_disk(folder / "disk", 320) as disk:
            check_quota(disk, 2.0, 12, 1024.0, "a disk of 320 MiB, of which 32 must stay free", 32.0)
    else:
        print("a disk that fills: skipped, only root can mount one")


def main() -> None:
    """Check quotas and a full disk, then a day; `--day-only` omits the first two."""
    parser = argparse.ArgumentParser(description="a simulated day, recorded around events")
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--events", type=int, default=20)
    parser.add_argument("--rate", type=int, default=RATE_HZ, help="rate of the day in Hz; quota and disk run at 10000")
    parser.add_argument("--day-only", action="store_true", help="without quota and disk")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for subfolder in ("day", "quota"):
            (folder / subfolder).mkdir()
        if not options.day_only:
            check_quotas(folder)
        check_day(folder / "day", options.hours, options.events, options.rate)


if __name__ == "__main__":
    main()
