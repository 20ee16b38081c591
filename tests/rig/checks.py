"""The loop on real interfaces of the kernel, in the virtual machine of tests/rig/run. Each check prints a verdict line.

The machine is emulated: rates are printed but need not reach a limit. Programs run as the service's user.
"""

from __future__ import annotations

import grp
import json
import os
import platform
import re
import shutil
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

import rtloop

BIN = Path("/opt/rtloop/bin")
CONFIGS = Path("/rig/tests/rig")
UNIT = "rtloop@rig.service"
DEVICE = Path("/dev/comedi0")
CAPABILITIES = "+sys_nice,+ipc_lock"
AS_SERVICE = ("setpriv", "--reuid=rtloop", "--regid=rtloop", "--init-groups", f"--inh-caps={CAPABILITIES}",
              f"--ambient-caps={CAPABILITIES}", "env", "XDG_CACHE_HOME=/var/cache/rtloop", "PYTHONDONTWRITEBYTECODE=1",
              "HOME=/var/lib/rtloop", "PYTHONPATH=/rig")  # fmt: skip
GAIN_TOLERANCE, OFFSET_CODES, LSB_V = 0.001, 2, 20.0 / 65535
TIMEOUT_S, STARTS = 1800.0, 4


class CheckFailed(Exception):
    """A check failed; the message says why."""


class NotReady(CheckFailed):
    """A command failed because loop and recorder did not start in time."""


def require(condition: object, message: str) -> None:
    """Raise CheckFailed with `message` unless the condition is true."""
    if not condition:
        raise CheckFailed(message)


def run(*command: str | Path, codes: tuple[int, ...] = (0,)) -> str:
    """Run a command; return its standard output. Raises CheckFailed or NotReady for an exit code not in `codes`."""
    completed = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=TIMEOUT_S)
    output = (completed.stderr + completed.stdout).strip()[-1500:]
    if completed.returncode not in codes:
        kind = NotReady if "were not ready within" in output else CheckFailed
        raise kind(f"{' '.join(map(str, command))}: {completed.returncode}: {output}")
    return completed.stdout


def as_service(*command: str | Path, codes: tuple[int, ...] = (0,)) -> str:
    """Run a command as the service's user with its capabilities; return the output as `run` does."""
    return run(*AS_SERVICE, *command, codes=codes)


def run_rtloop(*command: str | Path, codes: tuple[int, ...] = (0,)) -> str:
    """Run `rtloop` as the service's user; return its output. Repeat it, up to STARTS times in all, after NotReady."""
    for _ in range(STARTS - 1):
        with suppress(NotReady):
            return as_service(BIN / "rtloop", *command, codes=codes)
    return as_service(BIN / "rtloop", *command, codes=codes)


def closed_loop(config: Path, duration_s: float, allowed_error_um: float) -> str:
    """Run a loop and replay its recording: no tick is lost, the replay is identical, and each step settles."""
    output = run_rtloop("run", config, "--duration", str(duration_s), "--json", codes=(0, 1))
    summary = json.loads(output)
    require("ticks_lost" in summary, output)
    require(summary["ticks_lost"] == 0 and summary["complete"], f"{summary['ticks_lost']} ticks lost; {output}")
    require(not summary["trips"], f"tripped: {summary['trips']}")
    verdict = json.loads(as_service(BIN / "rtloop", "replay", *summary["parts"], "--json"))
    require(verdict["identical"], f"replay: {verdict}")
    recording = rtloop.load(summary["parts"])
    reference, error = recording["x_reference_um"], recording["x_error_um"]
    step_ends = np.flatnonzero(np.diff(reference))
    require(step_ends.size >= 2, "the reference never changed")
    worst_um = float(np.max(np.abs([np.mean(error[end - 20 : end]) for end in step_ends])))
    require(worst_um <= allowed_error_um, f"{worst_um:.3f} µm from the reference at the end of a step")
    scheduling = summary["realtime"]
    require(scheduling["scheduler"] == "SCHED_FIFO", f"scheduling: {scheduling}")
    late_us, phases = summary["lateness_us"], summary["phases"]
    return (
        f"{summary['ticks_logged']} ticks at {summary['rate_hz']:g} Hz, 0 lost, {summary['periods_missed']} periods "
        f"missed, replay identical, {worst_um:.4f} µm left; late p50 {late_us['p50']:.0f} µs, "
        f"max {late_us['max']:.0f} µs; read {phases['read_us']:.0f} µs, write {phases['write_us']:.0f} µs"
    )


# The checks, in the order of their execution. Each returns a text with its measured values.


def kernel() -> str:
    """The kernel is PREEMPT_RT."""
    realtime = Path("/sys/kernel/realtime")
    require("PREEMPT_RT" in platform.version(), platform.version())
    require(realtime.exists() and realtime.read_text().strip() == "1", "/sys/kernel/realtime is missing or not 1")
    return f"{platform.release()}, {platform.version()}"


def comedi_device() -> str:
    """The kernel provides a comedi board, which the service's user may read and write."""
    run("modprobe", "comedi_test")
    run("udevadm", "settle")
    require(DEVICE.is_char_device(), f"no {DEVICE}")
    status = DEVICE.stat()
    mode, group = stat.S_IMODE(status.st_mode), grp.getgrgid(status.st_gid).gr_name
    member = as_service("sh", "-c", f"test -r {DEVICE} && test -w {DEVICE} && id --name --groups").strip()
    require(mode == 0o660, f"{DEVICE}: {mode:04o} {group}")
    return f"{DEVICE}, {mode:04o} {group}; the service's user is in {member}"


def conformance() -> str:
    """The drivers' conformance suite passes on the board."""
    output = as_service(BIN / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", "--import-mode=importlib",
                      "tests/rig/conformance.py")  # fmt: skip
    passed = re.search(r"(\d+) passed(?!.*(failed|skipped|error))", output)
    require(passed and int(passed[1]) >= 25, output[-600:])
    return output.strip().splitlines()[-1]


def permission() -> str:
    """A user without the group cannot open the board, and the message names the remedy."""
    code = "from rtloop.drivers.comedi_board import Board\nBoard('libcomedi.so.0', '/dev/comedi0')"
    as_nobody = ("setpriv", "--reuid=nobody", "--regid=nogroup", "--clear-groups")
    completed = subprocess.run([*as_nobody, BIN / "python", "-c", code], capture_output=True, text=True)
    message = completed.stderr.strip().splitlines()[-1]
    require(completed.returncode == 1 and "Permission denied; add this user to" in message, message)
    return message


def selftest() -> str:
    """The loopback self-test passes, with a delay of one tick."""
    limits = ("--gain-tolerance", str(GAIN_TOLERANCE), "--offset-tolerance", f"{OFFSET_CODES * LSB_V:.9f}")
    output = run_rtloop("drivers", "--selftest", CONFIGS / "comedi.toml", "--loopback", *limits, "--json", codes=(0, 1))
    report = json.loads(output)
    require("axes" in report, output)
    pair = report["axes"][0]
    summary = (
        f"gain {pair['gain']:.6f}, offset {pair['offset_v'] / LSB_V:.2f} codes, noise {pair['noise_v'] / LSB_V:.2f} "
        f"codes, delay {pair['delay_ticks']} tick; rates "
        + ", ".join(f"{rate['rate_hz']:g} Hz {rate['missed_share']:.1%} missed" for rate in report["rates"])
    )
    require(report["passed"] and pair["delay_ticks"] == 1, summary)
    return summary


def comedi_loop() -> str:
    """A closed loop runs over the comedi board."""
    return closed_loop(CONFIGS / "comedi.toml", 6.0, 0.02)


def can_loop() -> str:
    """A closed loop runs over SocketCAN, with the simulated rig as a node."""
    run("modprobe", "vcan")
    run("modprobe", "can-raw")
    run("ip", "link", "add", "dev", "vcan0", "type", "vcan")
    run("ip", "link", "set", "up", "vcan0")
    node = subprocess.Popen([*AS_SERVICE, BIN / "rtloop", "hil", "serve", CONFIGS / "can.toml", "--can"],
                            stderr=subprocess.PIPE, text=True)  # fmt: skip
    try:
        summary = closed_loop(CONFIGS / "can.toml", 12.0, 1.0)
    finally:
        node.send_signal(signal.SIGTERM)
        _, node_log = node.communicate(timeout=120.0)
    statistics = run("ip", "-statistics", "-json", "link", "show", "vcan0")
    frames = json.loads(statistics)[0]["stats64"]["rx"]["packets"]
    require(node.returncode == 0 and frames > 2000, f"node: {node.returncode}: {node_log}; {frames} frames")
    return f"{summary}; {frames} frames on vcan0"


def service() -> str:
    """The installed service on the comedi board becomes active, and its loop has SCHED_FIFO and locked memory."""
    shutil.copy(CONFIGS / "comedi.toml", "/etc/rtloop/rig.toml")
    drop_in = Path("/etc/systemd/system/rtloop@.service.d/emulated.conf")
    drop_in.parent.mkdir(exist_ok=True)
    drop_in.write_text("[Service]\nTimeoutStartSec=900\n")  # The unit's 180 s are too short here.
    run("systemctl", "daemon-reload")
    try:
        run("systemctl", "start", UNIT)
    except CheckFailed as error:
        raise CheckFailed(f"{error}\n{run('journalctl', '--unit', UNIT, '--lines', '30', '--no-pager')}") from None
    state = run("systemctl", "show", "--value", "--property", "ActiveState", UNIT).strip()
    require(state == "active", state)
    deadline_s = time.monotonic() + 120.0
    while (status := ctl("status"))["state"] != "running" or status["ticks"] < 1000:
        require(time.monotonic() < deadline_s, f"not running: {status}")
        time.sleep(2.0)
    realtime = status["realtime"]
    require(realtime["scheduler"] == "SCHED_FIFO" and realtime["mlock"] and not realtime["refused"], f"{realtime}")
    policies = {pid: os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK for pid in loop_pids()}
    require(list(policies.values()) == [os.SCHED_FIFO], f"policies of the loop's process: {policies}")
    refused = as_service(BIN / "rtloop", "drivers", "--selftest", CONFIGS / "comedi.toml", "--json", codes=(69,))
    require("another program uses this subdevice" in refused, refused)
    run("systemctl", "stop", UNIT)
    result = run("systemctl", "show", "--value", "--property", "Result", UNIT).strip()
    require(result == "success", result)
    return f"active, SCHED_FIFO {realtime['priority']}, memory locked, nothing refused; a second controller gets 69"


def ctl(*words: str) -> dict[str, Any]:
    """Return the response to `rtloop ctl WORDS`."""
    return json.loads(run(BIN / "rtloop", "ctl", "--name", "rig", *words))


def loop_pids() -> list[int]:
    """Return the process ids of the loop's processes."""
    return list(map(int, run("pgrep", "--full", "--uid", "rtloop", "rtloop.engine.process").split()))


CHECKS: tuple[tuple[str, Callable[[], str]], ...] = (
    ("PREEMPT_RT kernel", kernel),
    ("comedi board of the kernel", comedi_device),
    ("conformance suite on this board", conformance),
    ("another user is refused", permission),
    ("closed loop over comedi", comedi_loop),
    ("service, FIFO granted", service),
    ("closed loop over SocketCAN", can_loop),
    ("loopback self-test", selftest),
)


def main() -> int:
    """Run the checks, print their verdicts, and return 0 if all hold, otherwise 1."""
    passed_count = 0
    for name, check in CHECKS:
        start_s = time.monotonic()
        try:
            verdict, detail, passed_count = "holds", check(), passed_count + 1
        except (CheckFailed, OSError, ValueError, KeyError, subprocess.TimeoutExpired) as error:
            verdict, detail = "FAILS", f"{type(error).__name__}: {error}"
        print(f"{verdict}  {name:28} {time.monotonic() - start_s:5.0f} s  {detail}", flush=True)
    print(f"{passed_count} of {len(CHECKS)} checks hold", flush=True)
    return 0 if passed_count == len(CHECKS) else 1


if __name__ == "__main__":
    sys.exit(main())
