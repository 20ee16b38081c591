"""Faults of storage: a full disk, a removed folder, an overrun ring, a stalled disk, a torn compiler cache."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from prometheus_client.parser import text_string_to_metric_families

import rtloop
from rtloop.engine.memory import Word
from rtloop.foundation.native.cache import CACHE_FOLDER
from rtloop.recording.replay.replay import replay
from tests.faults.account import unexplained
from tests.faults.bench import Bench
from tests.faults.configuration import BOARD_RATE_HZ
from tests.faults.evidence import TIMEOUT_S, wait_for
from tests.faults.fault import Fault, NotPossible, Outcome
from tests.faults.preload import preload

SMALL, LARGE = "size=900k", "size=64m"
RING_LENGTHS = 1.4
STALLED, STALL_S = "stalled", 10.0
"""Name of the file that stalling_disk.c creates when it stalls, and the duration of the stall in s."""
DAMAGED = "the cache of compiled code is damaged"


@contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """Mount a file system of less than a megabyte as the folder of the recordings. Raises NotPossible without root."""
    recordings = folder / "recordings"
    recordings.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", SMALL, "tmpfs", str(recordings)]
    if os.geteuid() != 0 or subprocess.run(command, check=False, capture_output=True).returncode != 0:
        raise NotPossible("mounting a small file system is not permitted")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(recordings)], check=True)


def await_recording(bench: Bench, state: str) -> dict[str, Any]:
    """Wait for a state of the recording; compare metrics and log 4,000 ticks later; return status["recording"]."""
    wait_for(lambda: bench.status()["recording"]["state"] == state, state)
    ticks = bench.ticks
    wait_for(lambda: bench.ticks > ticks + 4000, "another second")
    families = {family.name: family for family in text_string_to_metric_families(bench.client.get("/metrics"))}
    assert families["rtloop_recording"].samples[0].value == (state == "recording")
    status = bench.status()
    assert status["state"] == "running"
    recording = status["recording"]
    assert recording["state"] == state
    message = "recorded again" if state == "recording" else "not recorded from tick"
    wait_for(lambda: message in bench.log(), f"{message} in the log")
    assert families["rtloop_ticks_not_recorded"].samples[0].value > 0
    assert recording["ticks_lost"] > 0
    return recording


def disk_full(bench: Bench) -> Outcome:
    """Run on a small disk until it is full: the loop runs on, and status names the reason."""
    bench.strike()
    recording = await_recording(bench, "not recording")
    assert recording["reason"] == "No space left on device"
    return Outcome(lost_allowed=True, exit_code=1, note="the loop runs on; the loss is reported at once and at the end")


def disk_full_then_room(bench: Bench) -> Outcome:
    """Enlarge the full disk: the service records again and states the gap."""
    outcome = disk_full(bench)
    command = ["mount", "-o", f"remount,{LARGE}", str(bench.folder / "recordings")]
    subprocess.run(command, check=True, capture_output=True)
    await_recording(bench, "recording")
    return check_resumed(bench, outcome)


def folder_removed(bench: Bench) -> Outcome:
    """Remove the folder of the recordings, then create it again: the service records again and states the gap."""
    folder = bench.folder / "recordings"
    bench.strike(lambda: shutil.rmtree(folder))
    recording = await_recording(bench, "not recording")
    assert recording["reason"] == "No such file or directory"
    assert recording["since_tick"] == 0  # the ticks written before are gone too
    folder.mkdir()
    await_recording(bench, "recording")
    return check_resumed(bench, Outcome(lost_allowed=True, exit_code=1))


def check_resumed(bench: Bench, outcome: Outcome) -> Outcome:
    """Require that the newest file states the same gap as status, and that it replays without the older files."""
    lost = bench.status()["recording"]["ticks_lost"]
    ticks = bench.ticks
    wait_for(lambda: bench.ticks > ticks + 8000, "some more ticks")
    (part,) = (bench.folder / "recordings").glob("*.mcap.part")
    recording = rtloop.load(part)
    gaps = [event["what"]["count"] for event in recording.events if event["kind"] == "gap"]
    assert gaps == [lost], f"{gaps} in the file, {lost} in status"
    assert {event["kind"] for event in recording.events} >= {"recording_failed", "recording_resumed"}
    still_open = "the file was not finished: the file is read from the beginning, without the index"
    problems = unexplained(replay(recording), recording.header["rate_hz"], ended=False)
    assert problems == [still_open], problems
    outcome.note = f"the loop runs on; {lost} ticks stated as lost; recorded again"
    return outcome


def ring_overrun(bench: Bench) -> Outcome:
    """Stop every new recorder at once, until the loop has overwritten the whole ring."""
    block, stopped = bench.blocks[-1], set[int]()
    bench.strike()
    deadline_s = time.monotonic() + RING_LENGTHS * len(bench.blocks[-1]["ticks_slots"]) / BOARD_RATE_HZ
    while time.monotonic() < deadline_s:
        pid = block.load(Word.RECORDER_PID)
        if pid and pid not in stopped:
            stopped.add(pid)
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGSTOP)
        time.sleep(0.002)
    last = block.load(Word.RECORDER_PID)
    with suppress(ProcessLookupError):
        os.kill(last, signal.SIGCONT)
    wait_for(lambda: block.load(Word.RECORDER_CURSOR) > bench.ticks - 4000, "a recorder that keeps up")
    assert bench.status()["state"] == "running"
    return Outcome(lost_allowed=True, exit_code=1, note=f"{len(stopped)} recorders stopped in a row")


def stalling_disk(folder: Path) -> dict[str, str]:
    """Return the environment in which the first fsync of a recording takes ten seconds."""
    return preload(folder, "stalling_disk") | {"STALLED_DISK": str(folder / STALLED)}


def disk_stalls(bench: Bench) -> Outcome:
    """Stall the disk for ten seconds at a rotation: a recorder is replaced, and the ring still holds all ticks."""
    wait_for(lambda: (bench.folder / STALLED).exists(), "a rotation")
    bench.strike()
    ticks = bench.ticks
    wait_for(lambda: bench.ticks > ticks + round((STALL_S + 3.0) * BOARD_RATE_HZ), "the end of the stall")
    status = bench.status()
    assert (status["state"], status["restarts"]) == ("running", 0), status
    assert status["recording"]["ticks_lost"] == 0, status["recording"]
    return Outcome(note=f"{status['recorder_replacements']} recorder replaced")


def torn_cache(folder: Path) -> dict[str, str]:
    """Copy the cache of compiled code, damage the copy, and return the environment that uses it."""
    shutil.copytree(CACHE_FOLDER, folder / "cache" / "rtloop" / CACHE_FOLDER.name)
    tear(folder / "cache")
    return {"XDG_CACHE_HOME": str(folder / "cache")}


def tear(folder: Path) -> None:
    """Truncate the files of a folder, in turn to nothing and to half of their size."""
    for number, path in enumerate(sorted(path for path in folder.rglob("*") if path.is_file())):
        os.truncate(path, path.stat().st_size // 2 * (number % 2))


def cache_torn(bench: Bench) -> Outcome:
    """Tear the cache of a service that started on a torn one, kill service and loop, park, and start again."""
    assert DAMAGED in bench.log()
    tear(bench.folder / "cache")
    service, loop = bench.pid("service"), bench.pid("rt")
    bench.strike(lambda: os.kill(service, signal.SIGKILL), lambda: os.kill(loop, signal.SIGKILL))
    assert bench.service is not None
    bench.service.wait()
    warnings = bench.log().count(DAMAGED)
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0
    took_ms = bench.await_safe()  # no bound: an interpreter must start
    assert bench.log().count(DAMAGED) == warnings + 1, "park must report the damaged cache"
    bench.start_service()
    bench.await_drive()
    return Outcome(took_ms, note="started twice, parked, each time on a torn cache")


FAULTS = (
    Fault("disk full", "the loop runs on; lost ticks reported at once", disk_full, around=small_disk),
    Fault("disk full, then room", "recorded again; the gap is stated", disk_full_then_room, around=small_disk),
    Fault("folder of recordings removed, then made", "recorded again; the gap is stated", folder_removed),
    Fault("compiler cache torn", "reported and rebuilt; parks without it", cache_torn, environment=torn_cache),
    Fault("ring overrun", "the loop runs on; the gap is stated", ring_overrun),
    Fault("disk stalls 10 s at a rotation", "the loop runs on, nothing is lost", disk_stalls,
          changes=(("[recording]", "[recording]\nrotate_s = 4.0"),), environment=stalling_disk),
)  # fmt: skip
