"""A simulated day with 20 events, recorded around them, and what a quota and a full disk leave."""

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
"""Of the paper's loop; at any other rate the feedforward runs alone, for its controller is made for this one."""
BEFORE_S, AFTER_S = 10, 30
LOUD_V = 4.5
"""Beyond what the usual reference asks for, and reached by steps of 25 µm."""
EVENTS = ("trip", "mode", "loud")
USUAL = 'reference = { kind = "sine", amplitude = 10.0, frequency_hz = 5.0 }'
SEQUENCES = {
    "trip": [(0.0, 'reference = { kind = "steps", levels = [75.0, 0.0], dwell_s = 5.0 }'), (3.0, USUAL),
             (4.0, "reset_trip = true"), (4.1, 'mode = "MODE"')],
    "mode": [(0.0, 'mode = "off"'), (2.0, 'mode = "MODE"')],
    "loud": [(0.0, 'reference = { kind = "steps", levels = [25.0, -25.0], dwell_s = 0.5 }'), (2.0, USUAL)],
}  # fmt: skip
"""What happens in an event, in seconds behind its beginning."""


class Event(NamedTuple):
    """One of EVENTS, and its first tick."""

    kind: str
    tick: int


def events(hours: float, count: int, rate_hz: int = RATE_HZ) -> list[Event]:
    """So many, in turn, each somewhere in its share of the time."""
    share_s, random = hours * 3600 / count, np.random.default_rng(7)
    begins_s = [(k + random.uniform(0.3, 0.7)) * share_s for k in range(count)]
    return [Event(EVENTS[k % len(EVENTS)], round(begin_s * rate_hz)) for k, begin_s in enumerate(begins_s)]


def configuration(planned: list[Event], recording: str, rate_hz: int) -> str:
    """The paper's loop, with these events and lines of [recording]."""
    on = f'["trip", "mode", "abs(x_drive_v) > {LOUD_V}"]'
    around = f"around = {{ before_s = {BEFORE_S}, after_s = {AFTER_S}, on = {on} }}\n"
    steps = PAPER[PAPER.index("[axis.reference]") :].split("\n\n", 1)[0]
    text = PAPER.replace(steps, f"[axis.reference]\n{USUAL.partition('{')[2].strip(' }').replace(', ', chr(10))}\n")
    text = text.replace('folder = "recordings"\n', f'folder = "recordings"\n{around}{recording}')
    mode = "closed_loop"
    if rate_hz != RATE_HZ:
        mode, text = "feedforward", text.replace("position_um = 60.0", "position_um = 35.0")
        text = text.replace("prewarp_hz = 595.5", f"prewarp_hz = {rate_hz / 10}")
        text = text.replace("rate_hz = 10000", f'rate_hz = {rate_hz}\nmode = "feedforward"')
    changes = [(event.tick + round(at_s * rate_hz), what) for event in planned for at_s, what in SEQUENCES[event.kind]]
    entries = "".join(f"\n[[schedule]]\nat_tick = {tick}\n{what}\n" for tick, what in changes)
    return text + entries.replace("MODE", mode)


def measured(*arguments: object) -> tuple[float, float, str]:
    """(seconds, MiB at most, what it said) of a command of rtloop. Raises CalledProcessError unless it ends well."""
    begin_s = time.monotonic()
    command = [sys.executable, "-m", "rtloop", *map(str, arguments)]
    with tempfile.TemporaryFile("w+") as out:
        process = subprocess.Popen(command, stdout=out, cwd=ROOT)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        said = out.read()
    if process.returncode not in (0, 1):
        raise subprocess.CalledProcessError(process.returncode, command, said)
    return time.monotonic() - begin_s, usage.ru_maxrss / 1024, said


def run(
    folder: Path, hours: float, planned: list[Event], recording: str, rate_hz: int = RATE_HZ
) -> tuple[dict[str, Any], float, Path]:
    """A run into `folder`/recordings: its report, how long it took, the pattern of its files."""
    config = folder / "day.toml"
    config.write_text(configuration(planned, recording, rate_hz))
    seconds, _, said = measured(
        "run", config, "--unpaced", "--duration", hours * 3600, "--out", folder / "recordings", "--json"
    )
    return json.loads(said), seconds, folder / "recordings" / "day-*.mcap"


def require_events(files: Path | list[Path], planned: list[Event], ticks: int, rate_hz: int) -> int:
    """Every tick around every event is there; how many stretches there are."""
    recording = load(files)
    assert recording.problems == [], recording.problems
    kept = uncovered_ranges(0, ticks, recording.skipped)
    for event in planned:
        first, last = event.tick - BEFORE_S * rate_hz, min(event.tick + AFTER_S * rate_hz, ticks - 1)
        assert any(begin <= first and last < begin + count for begin, count in kept), event
    return len(kept)


def a_day(folder: Path, hours: float, count: int, rate_hz: int) -> None:
    """Bytes, stretches, replay and the time of `info`."""
    planned, ticks = events(hours, count, rate_hz), round(hours * 3600 * rate_hz)
    report, seconds, pattern = run(folder, hours, planned, "rotate_s = 3600.0\nkeep_gib = 100.0\n", rate_hz)
    assert (report["complete"], report["ticks_lost"], report["problems"]) == (True, 0, []), report
    assert report["ticks_logged"] + report["ticks_skipped"] == ticks
    size_mib, files = report["size_bytes"] / 2**20, report["recordings"]
    print(f"{hours:g} h at {rate_hz} Hz with {count} events, made in {seconds:.0f} s")
    print(f"  {len(files)} files, {size_mib:.1f} MiB in all, {size_mib / hours:.2f} MiB an hour")
    stretches, logged = require_events(pattern, planned, ticks, rate_hz), report["ticks_logged"]
    print(f"  {logged:,} of {ticks:,} ticks kept, in {stretches} stretches")
    info_s, info_mib, said = measured("info", pattern, "--json")
    assert json.loads(said)["complete"]
    print(f"  info {info_s:.1f} s, {info_mib:.0f} MiB of memory")
    replay_s, replay_mib, said = measured("replay", pattern, "--json")
    found = json.loads(said)
    assert (found["identical"], found["gaps"], found["stretches"]) == (True, [], stretches), found
    print(f"  replay {replay_s:.1f} s, {replay_mib:.0f} MiB of memory: identical in {stretches} stretches")
    assert all(json.loads(measured("replay", path, "--json")[2])["identical"] for path in files)
    print("  and so does each file by itself")


def a_quota(folder: Path, hours: float, count: int, keep_mib: float, what: str, min_free_mib: float = 0.0) -> None:
    """The files around trips stay, others go."""
    planned, ticks = events(hours, count), round(hours * 3600 * RATE_HZ)
    lines = f"rotate_s = 300.0\nkeep_gib = {keep_mib / 1024}\nmin_free_mib = {min_free_mib}\n"
    report, _, pattern = run(folder, hours, planned, lines)
    assert report["error"] is None, report["error"]
    left = sorted(pattern.parent.glob(pattern.name))
    made = max(int(path.stem[-4:]) for path in left)
    size = sum(path.stat().st_size for path in left)
    trips = [event for event in planned if event.kind == "trip"]
    kept = np.concatenate([load(path)["tick"] for path in left])
    for trip in trips:
        around = np.arange(trip.tick - BEFORE_S * RATE_HZ, min(trip.tick + AFTER_S * RATE_HZ, ticks))
        assert np.isin(around, kept, assume_unique=True).all(), trip
    assert all(json.loads(measured("replay", path, "--json")[2])["identical"] for path in left)
    assert len(left) < made
    there = {path.name for path in left}
    told = {event["what"]["file"] for path in left for event in load(path).events if event["kind"] == "removed"}
    assert told
    assert not told & there
    assert size <= keep_mib * 2**20
    print(f"{what}: {hours:g} h in {made} files, {len(left)} are left with {size / 2**20:.1f} MiB, "
          f"which tell of {len(told)} that went; "
          f"every tick around {len(trips)} trips is there, each file replays identical")  # fmt: skip


@contextmanager
def small_disk(folder: Path, mib: int) -> Iterator[Path]:
    """A file system of so many MiB, as root."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={mib}m", "tmpfs", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def quotas(folder: Path) -> None:
    """A quota that is reached, and a disk that is full before."""
    a_quota(folder / "quota", 2.0, 12, 200.0, "a quota of 200 MiB")
    if os.geteuid() == 0:
        with small_disk(folder / "disk", 320) as disk:
            a_quota(disk, 2.0, 12, 1024.0, "a disk of 320 MiB, of which 32 are to stay free", 32.0)
    else:
        print("a disk that fills: skipped, only root can mount one")


def main() -> None:
    """Command line entry."""
    parser = argparse.ArgumentParser(description="a simulated day, recorded around events")
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--events", type=int, default=20)
    parser.add_argument("--rate", type=int, default=RATE_HZ, help="Hz of the day; quota and disk are shown at 10000")
    parser.add_argument("--day-only", action="store_true", help="without quota and disk")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("day", "quota"):
            (folder / part).mkdir()
        if not given.day_only:
            quotas(folder)
        a_day(folder / "day", given.hours, given.events, given.rate)


if __name__ == "__main__":
    main()
