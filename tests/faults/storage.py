"""Faults of the recording: a disk that is full, a folder that vanishes, a ring that is overrun."""

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
from tests.faults.fault import Fault, Measured, NotPossible
from tests.faults.preload import preloaded

SMALL, LARGE = "size=900k", "size=64m"
ROUNDS = 1.4
STALLED, STALL_S = "stalled", 10.0
"""File that tells of the stall; how long it takes, as stalling_disk.c has it."""
DAMAGED = "the cache of compiled code is damaged"


@contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """A file system of less than a megabyte where the recordings go."""
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
    """What status says of the recording, once it is in `state`, for a second more; the metrics say the same."""
    wait_for(lambda: bench.status()["recording"]["state"] == state, state)
    ticks = bench.ticks
    wait_for(lambda: bench.ticks > ticks + 4000, "another second")
    families = {family.name: family for family in text_string_to_metric_families(bench.client.get("/metrics"))}
    assert families["rtloop_recording"].samples[0].value == (state == "recording")
    status = bench.status()
    assert status["state"] == "running"
    said = status["recording"]
    assert said["state"] == state
    told = "recorded again" if state == "recording" else "not recorded from tick"
    wait_for(lambda: told in bench.log(), f"{told} in the log")
    assert families["rtloop_ticks_not_recorded"].samples[0].value > 0
    assert said["ticks_lost"] > 0
    return said


def disk_full(bench: Bench) -> Measured:
    bench.strike()
    said = await_recording(bench, "not recording")
    assert said["reason"] == "No space left on device"
    return Measured(lost_allowed=True, exit_code=1, note="the loop goes on; said at once and at the end")


def disk_full_then_room(bench: Bench) -> Measured:
    measured = disk_full(bench)
    command = ["mount", "-o", f"remount,{LARGE}", str(bench.folder / "recordings")]
    subprocess.run(command, check=True, capture_output=True)
    await_recording(bench, "recording")
    return resumed(bench, measured)


def folder_removed(bench: Bench) -> Measured:
    folder = bench.folder / "recordings"
    bench.strike(lambda: shutil.rmtree(folder))
    said = await_recording(bench, "not recording")
    assert said["reason"] == "No such file or directory"
    assert said["since_tick"] == 0  # what had been written is gone too
    folder.mkdir()
    await_recording(bench, "recording")
    return resumed(bench, Measured(lost_allowed=True, exit_code=1))


def resumed(bench: Bench, measured: Measured) -> Measured:
    """The newest file says what is missing in front of it, as status does, and replays by itself."""
    lost = bench.status()["recording"]["ticks_lost"]
    ticks = bench.ticks
    wait_for(lambda: bench.ticks > ticks + 8000, "some more ticks")
    (part,) = (bench.folder / "recordings").glob("*.mcap.part")
    recording = rtloop.load(part)
    gaps = [event["what"]["count"] for event in recording.events if event["kind"] == "gap"]
    assert gaps == [lost], f"{gaps} in the file, {lost} in status"
    assert {event["kind"] for event in recording.events} >= {"recording_failed", "recording_resumed"}
    still_open = "the file was not finished: the file is read from the beginning, without the index"
    left = unexplained(replay(recording), recording.header["rate_hz"], ended=False)
    assert left == [still_open], left
    measured.note = f"the loop goes on; {lost} ticks said to be lost; recorded again"
    return measured


def ring_overrun(bench: Bench) -> Measured:
    """Every recorder that comes is stopped at once, until the ring has gone round."""
    block, stopped = bench.blocks[-1], set[int]()
    bench.strike()
    until_s = time.monotonic() + ROUNDS * len(bench.blocks[-1]["ticks_slots"]) / BOARD_RATE_HZ
    while time.monotonic() < until_s:
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
    return Measured(lost_allowed=True, exit_code=1, note=f"{len(stopped)} recorders stopped in a row")


def stalling_disk(folder: Path) -> dict[str, str]:
    """The environment in which the first recording that is finished waits ten seconds for its disk."""
    return preloaded(folder, "stalling_disk") | {"STALLED_DISK": str(folder / STALLED)}


def disk_stalls(bench: Bench) -> Measured:
    """Ten seconds at a rotation: longer than a recorder may stand still, shorter than the ring holds."""
    wait_for(lambda: (bench.folder / STALLED).exists(), "a rotation")
    bench.strike()
    ticks = bench.ticks
    wait_for(lambda: bench.ticks > ticks + round((STALL_S + 3.0) * BOARD_RATE_HZ), "the end of the stall")
    status = bench.status()
    assert (status["state"], status["restarts"]) == ("running", 0), status
    assert status["recording"]["ticks_lost"] == 0, status["recording"]
    return Measured(note=f"{status['recorder_replacements']} recorder replaced")


def torn_cache(folder: Path) -> dict[str, str]:
    """A copy of the cache of compiled code in which a power cut left no file whole."""
    shutil.copytree(CACHE_FOLDER, folder / "cache" / "rtloop" / CACHE_FOLDER.name)
    tear(folder / "cache")
    return {"XDG_CACHE_HOME": str(folder / "cache")}


def tear(folder: Path) -> None:
    """Leave nothing of one file and half of the next."""
    for number, path in enumerate(sorted(path for path in folder.rglob("*") if path.is_file())):
        os.truncate(path, path.stat().st_size // 2 * (number % 2))


def cache_torn(bench: Bench) -> Measured:
    """The service has started on a torn cache, which is torn again before service and loop die."""
    assert DAMAGED in bench.log()
    tear(bench.folder / "cache")
    service, loop = bench.pid("service"), bench.pid("rt")
    bench.strike(lambda: os.kill(service, signal.SIGKILL), lambda: os.kill(loop, signal.SIGKILL))
    assert bench.service is not None
    bench.service.wait()
    before = bench.log().count(DAMAGED)
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0
    took_ms = bench.await_safe()  # no bound: an interpreter must start
    assert bench.log().count(DAMAGED) == before + 1, "park names the cache"
    bench.start_service()
    bench.await_drive()
    return Measured(took_ms, note="started twice, parked, each time on a torn cache")


FAULTS = (
    Fault("disk full", "the loop goes on; lost ticks said at once", disk_full, around=small_disk),
    Fault("disk full, then room", "recorded again; the gap said", disk_full_then_room, around=small_disk),
    Fault("folder of recordings removed, then made", "recorded again; the gap said", folder_removed),
    Fault("compiler cache torn", "named and made anew; parks without it", cache_torn, environment=torn_cache),
    Fault("ring overrun", "the loop goes on; the gap said", ring_overrun),
    Fault("disk stalls 10 s at a rotation", "the loop goes on, nothing is lost", disk_stalls,
          changes=(("[recording]", "[recording]\nrotate_s = 4.0"),), environment=stalling_disk),
)  # fmt: skip
