"""`rtloop run` with real processes, signals and recordings."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rtloop
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import UnavailableError
from rtloop.recording.replay.replay import replay
from rtloop.supervision import supervisor
from rtloop.supervision.child import Child
from tests.recording.real_loop import read_rows, record

pytestmark = pytest.mark.system

ROOT = Path(__file__).resolve().parents[2]
PAPER = ROOT / "deploy" / "paper.toml"
TIMEOUT_S = 120
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}


def start(*arguments: str | Path, **options: object) -> subprocess.Popen[str]:
    """Start an rtloop command as a process with captured output; `options` are those of Popen."""
    command = [sys.executable, "-m", "rtloop", *map(str, arguments)]
    settings: dict = {"env": ENVIRONMENT, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, **(settings | options))


def finish(process: subprocess.Popen[str]) -> tuple[int, dict, str]:
    """Wait for the end of a process; return its exit code, its JSON summary ({} without one) and its stderr."""
    out, err = process.communicate(timeout=TIMEOUT_S)
    assert "Traceback" not in err, err
    return process.returncode, json.loads(out) if out.strip() else {}, err


def run(*arguments: str | Path, **options: object) -> tuple[int, dict, str]:
    """Execute `rtloop run --json`; return its exit code, summary and stderr."""
    return finish(start("run", *arguments, "--json", **options))


def process_ids(process: subprocess.Popen[str]) -> dict[str, int]:
    """Return the process IDs of loop and recorder, by their modules, as soon as both have started."""
    pids: dict[str, int] = {}
    deadline = time.monotonic() + TIMEOUT_S
    while len(pids) < 2 and time.monotonic() < deadline:
        for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
            command = Path(f"/proc/{child}/cmdline").read_bytes().decode()
            for name in ("engine.process", "capture.recorder"):
                if name in command:
                    pids[name] = int(child)
        time.sleep(0.01)
    return pids


def wait_for_ticks(folder: Path) -> None:
    """Wait until the recorder has written ticks, which proves that the loop runs."""
    deadline = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline:
        if any(path.stat().st_size > 20_000 for path in folder.glob("*.part")):
            return
        time.sleep(0.02)
    raise AssertionError("no recording grew")


def test_a_paced_run_accounts_for_every_tick(tmp_path: Path) -> None:
    code, summary, _ = run(PAPER, "--duration", "1.5", "--out", tmp_path)
    assert code == 0
    assert summary["ticks_expected"] == summary["ticks_logged"] == 15_000
    assert summary["ticks_lost"] == 0
    assert summary["complete"] is True
    assert summary["outcome"] == "done"
    assert summary["realtime"]["scheduler"] in ("SCHED_FIFO", "SCHED_OTHER")
    recording = rtloop.load(summary["recording"])
    assert np.array_equal(recording["tick"], np.arange(15_000))
    # the grid of deadlines is fixed: skipped periods are counted
    periods = 1 + recording["periods_missed"][1:]
    assert np.array_equal(np.diff(recording["deadline_ns"]), periods * 100_000)
    assert np.all(recording["lateness_us"] >= 0)


def test_two_unpaced_runs_are_equal_in_bytes_and_another_seed_is_not(tmp_path: Path) -> None:
    records = []
    for _ in range(2):
        code, summary, _ = run(PAPER, "--duration", "1", "--unpaced", "--out", tmp_path)
        assert code == 0
        assert summary["lateness_us"] is None
        records.append(read_rows([Path(summary["recording"])]).tobytes())
    text = PAPER.read_text()
    for seed in (1, 2):
        files = record(tmp_path / f"{seed}.mcap", text.replace("seed = 1 ", f"seed = {seed} "), 10_000)
        records.append(read_rows(files).tobytes())
    assert records[0] == records[1] == records[2]
    assert records[0] != records[3]


def test_a_name_may_hold_what_patterns_and_markup_are_made_of(tmp_path: Path) -> None:
    config = tmp_path / "lab[b]*.toml"
    config.write_text(PAPER.read_text())
    code, summary, _ = run(config, "--duration", "0.1", "--unpaced", "--out", tmp_path)
    assert code == 0
    assert Path(summary["recording"]).name.startswith("lab[b]*-")
    assert summary["ticks_logged"] == 1000
    out, err = start("info", summary["recording"]).communicate(timeout=TIMEOUT_S)
    assert "lab[b]*" in out.replace("\n", "")
    assert err == ""


@pytest.mark.parametrize("numbers", [[signal.SIGTERM], [signal.SIGINT, signal.SIGINT, signal.SIGTERM]])
def test_signals_ramp_down_and_complete_the_recording(tmp_path: Path, numbers: list[signal.Signals]) -> None:
    """More signals may arrive while the loop ramps down and the recorder writes the end."""
    process = start("run", PAPER, "--out", tmp_path, "--json")
    wait_for_ticks(tmp_path)
    for number in numbers:
        process.send_signal(number)
        time.sleep(0.01)
    code, summary, _ = finish(process)
    assert code == 0
    assert summary["outcome"] == "stopped"
    assert summary["complete"] is True
    recording = rtloop.load(summary["recording"])
    assert recording["x_drive_v"][-1] == 0.0
    ramp = np.diff(recording["x_drive_v"][recording["mode"] == 0])
    assert np.all(np.abs(ramp) <= 1000 * 1e-4 * (1 + 1e-12))


def test_a_killed_loop_is_parked_and_said(tmp_path: Path) -> None:
    process = start("run", PAPER, "--out", tmp_path, "--json")
    loop = process_ids(process)["engine.process"]
    wait_for_ticks(tmp_path)
    os.kill(loop, signal.SIGKILL)
    code, summary, err = finish(process)
    assert code == 1
    assert "signal 9" in err
    assert "parked" in err
    assert summary["complete"] is False
    assert summary["ticks_lost"] == 0
    assert len(rtloop.load(summary["recording"])) == summary["ticks_logged"] > 0


def test_a_killed_recorder_is_replaced_and_nothing_is_lost(tmp_path: Path) -> None:
    process = start("run", PAPER, "--out", tmp_path, "--duration", "6", "--json")
    recorder = process_ids(process)["capture.recorder"]
    wait_for_ticks(tmp_path)
    os.kill(recorder, signal.SIGKILL)
    code, summary, err = finish(process)
    assert code == 0
    assert summary["outcome"] == "done"
    assert "recorder died" in err
    assert "was replaced" in err
    assert len(summary["recordings"]) == 2
    assert (summary["complete"], summary["ticks_lost"]) == (True, 0), (summary["problems"], err)
    recording = rtloop.load(summary["recordings"])
    assert np.array_equal(recording["tick"], np.arange(60_000))
    verdict = replay(recording)
    assert (verdict.identical, verdict.ticks) == (True, 60_000)


def test_a_loop_without_its_supervisor_parks_and_ends(tmp_path: Path) -> None:
    process = start("run", PAPER, "--out", tmp_path, "--json")
    pids = process_ids(process)
    wait_for_ticks(tmp_path)
    kill_and_await_end(process, pids)
    recording = rtloop.load(next(tmp_path.glob("*.mcap")))
    assert recording["x_drive_v"][-1] == 0.0
    tripped = [event for event in recording.events if event["kind"] == "tripped"]
    assert tripped[0]["what"]["causes"] == ["heartbeat"]
    assert "that process died" in tripped[0]["what"]["reason"]
    assert replay(recording).identical


def kill_and_await_end(process: subprocess.Popen[str], pids: dict[str, int]) -> None:
    """Kill the supervisor, and wait until the processes of loop and recorder are gone."""
    process.kill()
    process.communicate(timeout=TIMEOUT_S)
    deadline = time.monotonic() + TIMEOUT_S
    while any(Path(f"/proc/{pid}").exists() for pid in pids.values()) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids.values())


def test_an_unpaced_loop_without_its_supervisor_ends(tmp_path: Path) -> None:
    process = start("run", PAPER, "--out", tmp_path, "--unpaced", "--json")
    pids = process_ids(process)
    wait_for_ticks(tmp_path)
    kill_and_await_end(process, pids)


def test_a_stopped_supervisor_is_told_from_a_dead_one(tmp_path: Path) -> None:
    """The loop parks and ends while `rtloop run` is stopped, which then names the cause once."""
    process = start("run", PAPER, "--out", tmp_path, "--json")
    loop = process_ids(process)["engine.process"]
    wait_for_ticks(tmp_path)
    process.send_signal(signal.SIGSTOP)
    deadline = time.monotonic() + TIMEOUT_S
    while Path(f"/proc/{loop}/stat").read_text().rpartition(")")[2].split()[0] != "Z" and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGCONT)
    code, summary, err = finish(process)
    assert (code, summary["outcome"]) == (1, "heartbeat_lost")
    assert "was stopped by a signal" in summary["trips"][0]["reason"]
    assert err.count("stopped by a signal") == 1, err


@pytest.mark.parametrize(
    ("supervisor_pid", "outcome"), [(os.getpid(), "done"), (1 << 22, "heartbeat_lost")], ids=["lives", "is dead"]
)
def test_before_its_first_tick_a_loop_in_virtual_time_waits_for_a_supervisor_that_lives(
    supervisor_pid: int, outcome: str
) -> None:
    """The newest heartbeat is as old as the host; a number above the kernel's largest stands for a dead supervisor."""
    plan = replace(prepare(load(PAPER), paced=False).plan, ticks=10)
    block = SharedBlock.create(plan.sizes)
    block.store(Word.SUPERVISOR_PID, supervisor_pid)
    block.store(Word.HEARTBEAT_NS, 1)
    loop = Child("rtloop.engine.process", block.fd)
    loop.send(pickle.dumps(plan))
    reports: list[dict[str, Any]] = []
    while not reports and loop.exit_code is None:
        time.sleep(0.001)
        reports += loop.reports()
    block.store(Word.GO, outcome == "done")
    assert loop.wait(TIMEOUT_S) is not None
    reports += loop.reports()
    assert [report.get("outcome") for report in reports] == [None, outcome]
    assert int(block["ticks_head"][0]) == (10 if outcome == "done" else 0)
    loop.end()


def test_a_trip_is_recorded_and_ends_with_exit_1(tmp_path: Path) -> None:
    config = tmp_path / "tight.toml"
    config.write_text(PAPER.read_text().replace("position_um = 60.0", "position_um = 15.0"))
    code, summary, _ = run(config, "--duration", "0.2", "--unpaced", "--out", tmp_path)
    assert code == 1
    assert summary["complete"] is True
    assert summary["trips"][0]["causes"] == ["position"]
    recording = rtloop.load(summary["recording"])
    tick = summary["trips"][0]["tick"]
    assert abs(recording["x_position_um"][tick]) > 15.0
    assert np.all(np.abs(recording["x_position_um"][:tick]) <= 15.0)
    assert np.all(recording["mode"][tick:] == 0)


def test_realtime_that_is_required_and_refused_ends_with_77(tmp_path: Path) -> None:
    config = tmp_path / "strict.toml"
    config.write_text(PAPER.read_text().replace("# require_realtime = false", "require_realtime = true"))
    code, summary, err = run(config, "--duration", "0.1", "--out", tmp_path, preexec_fn=_drop_realtime)
    assert code == 77
    assert "require_realtime" in err
    assert summary["exit_code"] == 77
    assert not list(tmp_path.glob("*.mcap*"))


def _drop_realtime() -> None:
    """Drop CAP_SYS_NICE and CAP_IPC_LOCK for good, and set the limit of real-time priority to 0."""
    import ctypes
    import resource

    libc = ctypes.CDLL(None)
    for capability in (23, 14):
        libc.prctl(24, capability, 0, 0, 0)
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))


def test_eight_axes_lose_nothing(tmp_path: Path) -> None:
    config = tmp_path / "eight.toml"
    config.write_text(eight_axis_text())
    code, summary, _ = run(config, "--duration", "1", "--out", tmp_path)
    assert code == 0
    assert summary["ticks_logged"] == 10_000
    assert summary["ticks_lost"] == 0
    assert [axis["name"] for axis in summary["axes"]] == [f"a{i}" for i in range(8)]


def eight_axis_text() -> str:
    """Return a configuration with the paper's axis eight times, each on a separate plant."""
    text = PAPER.read_text()
    head, axis = text[: text.index("[[axis]]")], text[text.index("[[axis]]") : text.index("[recording]")]
    channel = head[head.index("[driver.channels.x]") : head.index("# The rig's truth")]
    channels = [
        channel.replace("channels.x", f"channels.a{i}").replace("adc0", f"adc{i}").replace("dac0", f"dac{i}")
        for i in range(8)
    ]
    axes = [axis.replace('name = "x"', f'name = "a{i}"') for i in range(8)]
    return head.replace(channel, "\n".join(channels)) + "\n".join(axes)


def test_an_output_folder_that_cannot_be_made_ends_with_73(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    code, summary, err = run(PAPER, "--duration", "0.1", "--out", blocked / "recordings")
    assert code == 73
    assert str(blocked) in err
    assert summary["exit_code"] == 73


def test_a_recording_that_does_not_open_ends_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loop and recorder are ready, but the recording does not open, as on a file system that hangs."""

    def expire_start(*_: object) -> None:
        monkeypatch.setattr(supervisor, "START_TIMEOUT_S", 0.0)

    monkeypatch.setattr(supervisor.RecorderKeeper, "start", expire_start)
    with pytest.raises(UnavailableError, match="the recording was not open within 0 s"):
        rtloop.run(PAPER, duration_s=0.1, unpaced=True, folder=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_recordings_name_is_no_folder(tmp_path: Path) -> None:
    process = start("run", PAPER, "--duration", "0.1", "--unpaced", "--out", tmp_path / "a.mcap")
    _, err = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, "a.mcap is a recording's name; allowed: a folder" in err) == (2, True), err
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small file system needs root")
def test_a_full_disk_costs_records_and_nothing_else(tmp_path: Path) -> None:
    small = tmp_path / "small"
    small.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=700k", "tmpfs", str(small)], check=False)
    if mounted.returncode != 0:
        pytest.skip("mounting is not permitted here")
    try:
        config = tmp_path / "paper.toml"
        config.write_text(PAPER.read_text().replace("# min_free_mib = 64.0", "min_free_mib = 0.0"))
        code, summary, err = run(config, "--duration", "3", "--out", small)
        assert code == 1
        assert summary["outcome"] == "done"
        assert summary["ticks_expected"] == summary["ticks_logged"] + summary["ticks_lost"] == 30_000
        assert 0 < summary["ticks_logged"] < 30_000
        assert "space" in err.lower()
        assert len(rtloop.load(summary["recording"])) == summary["ticks_logged"]
    finally:
        subprocess.run(["umount", str(small)], check=True)
