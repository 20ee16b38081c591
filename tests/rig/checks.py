"""The real kernel interfaces, inside the virtual machine of tests/rig/run: one verdict line a check.

The machine is emulated: rates are printed and not judged. Programs run as the service's user, with its compiled code.
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


class Failed(Exception):
    """A check does not hold."""


class NotReady(Failed):
    """Loop and recorder did not start in time."""


def require(condition: object, message: str) -> None:
    if not condition:
        raise Failed(message)


def run(*command: str | Path, codes: tuple[int, ...] = (0,)) -> str:
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=TIMEOUT_S)
    said = (done.stderr + done.stdout).strip()[-1500:]
    if done.returncode not in codes:
        kind = NotReady if "were not ready within" in said else Failed
        raise kind(f"{' '.join(map(str, command))}: {done.returncode}: {said}")
    return done.stdout


def as_service(*command: str | Path, codes: tuple[int, ...] = (0,)) -> str:
    return run(*AS_SERVICE, *command, codes=codes)


def started(*command: str | Path, codes: tuple[int, ...] = (0,)) -> str:
    """What rtloop says; tried again where the emulated machine took too long to start a loop's processes."""
    for _ in range(STARTS - 1):
        with suppress(NotReady):
            return as_service(BIN / "rtloop", *command, codes=codes)
    return as_service(BIN / "rtloop", *command, codes=codes)


def closed_loop(config: Path, duration_s: float, settled_um: float) -> str:
    """Run, replay, and look at how the steps ended: no tick lost, in bytes the same, the error gone."""
    told = started("run", config, "--duration", str(duration_s), "--json", codes=(0, 1))
    summary = json.loads(told)
    require("ticks_lost" in summary, told)
    require(summary["ticks_lost"] == 0 and summary["complete"], f"{summary['ticks_lost']} ticks lost; {told}")
    require(not summary["trips"], f"tripped: {summary['trips']}")
    verdict = json.loads(as_service(BIN / "rtloop", "replay", *summary["parts"], "--json"))
    require(verdict["identical"], f"replay: {verdict}")
    recording = rtloop.load(summary["parts"])
    reference, error = recording["x_reference_um"], recording["x_error_um"]
    ends = np.flatnonzero(np.diff(reference))
    require(ends.size >= 2, "the reference never changed")
    worst_um = float(np.max(np.abs([np.mean(error[end - 20 : end]) for end in ends])))
    require(worst_um <= settled_um, f"{worst_um:.3f} µm from the reference at the end of a step")
    scheduling = summary["realtime"]
    require(scheduling["scheduler"] == "SCHED_FIFO", f"scheduling: {scheduling}")
    late, took = summary["lateness_us"], summary["phases"]
    return (
        f"{summary['ticks_logged']} ticks at {summary['rate_hz']:g} Hz, 0 lost, {summary['periods_missed']} periods "
        f"missed, replay identical, {worst_um:.4f} µm left; late p50 {late['p50']:.0f} µs, max {late['max']:.0f} µs; "
        f"read {took['read_us']:.0f} µs, write {took['write_us']:.0f} µs"
    )


# the checks, in their order; each returns what it measured


def kernel() -> str:
    realtime = Path("/sys/kernel/realtime")
    require("PREEMPT_RT" in platform.version(), platform.version())
    require(realtime.exists() and realtime.read_text().strip() == "1", "/sys/kernel/realtime does not say so")
    return f"{platform.release()}, {platform.version()}"


def comedi_device() -> str:
    run("modprobe", "comedi_test")
    run("udevadm", "settle")
    require(DEVICE.is_char_device(), f"no {DEVICE}")
    status = DEVICE.stat()
    mode, group = stat.S_IMODE(status.st_mode), grp.getgrgid(status.st_gid).gr_name
    member = as_service("sh", "-c", f"test -r {DEVICE} && test -w {DEVICE} && id --name --groups").strip()
    require(mode == 0o660, f"{DEVICE}: {mode:04o} {group}")
    return f"{DEVICE}, {mode:04o} {group}; the service's user is in {member}"


def conformance() -> str:
    said = as_service(BIN / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", "--import-mode=importlib",
                      "tests/rig/conformance.py")  # fmt: skip
    passed = re.search(r"(\d+) passed(?!.*(failed|skipped|error))", said)
    require(passed and int(passed[1]) >= 25, said[-600:])
    return said.strip().splitlines()[-1]


def permission() -> str:
    code = "from rtloop.drivers.comedi_board import Board\nBoard('libcomedi.so.0', '/dev/comedi0')"
    stranger = ("setpriv", "--reuid=nobody", "--regid=nogroup", "--clear-groups")
    done = subprocess.run([*stranger, BIN / "python", "-c", code], capture_output=True, text=True)
    said = done.stderr.strip().splitlines()[-1]
    require(done.returncode == 1 and "Permission denied; add this user to" in said, said)
    return said


def selftest() -> str:
    limits = ("--gain-tolerance", str(GAIN_TOLERANCE), "--offset-tolerance", f"{OFFSET_CODES * LSB_V:.9f}")
    told = started("drivers", "--selftest", CONFIGS / "comedi.toml", "--loopback", *limits, "--json", codes=(0, 1))
    report = json.loads(told)
    require("axes" in report, told)
    pair = report["axes"][0]
    said = (
        f"gain {pair['gain']:.6f}, offset {pair['offset_v'] / LSB_V:.2f} codes, noise {pair['noise_v'] / LSB_V:.2f} "
        f"codes, delay {pair['delay_ticks']} tick; rates "
        + ", ".join(f"{rate['rate_hz']:g} Hz {rate['missed_share']:.1%} missed" for rate in report["rates"])
    )
    require(report["passed"] and pair["delay_ticks"] == 1, said)
    return said


def comedi_loop() -> str:
    return closed_loop(CONFIGS / "comedi.toml", 6.0, 0.02)


def can_loop() -> str:
    run("modprobe", "vcan")
    run("modprobe", "can-raw")
    run("ip", "link", "add", "dev", "vcan0", "type", "vcan")
    run("ip", "link", "set", "up", "vcan0")
    node = subprocess.Popen([*AS_SERVICE, BIN / "rtloop", "hil", "serve", CONFIGS / "can.toml", "--can"],
                            stderr=subprocess.PIPE, text=True)  # fmt: skip
    try:
        said = closed_loop(CONFIGS / "can.toml", 12.0, 1.0)
    finally:
        node.send_signal(signal.SIGTERM)
        _, told = node.communicate(timeout=120.0)
    statistics = run("ip", "-statistics", "-json", "link", "show", "vcan0")
    frames = json.loads(statistics)[0]["stats64"]["rx"]["packets"]
    require(node.returncode == 0 and frames > 2000, f"node: {node.returncode}: {told}; {frames} frames")
    return f"{said}; {frames} frames on vcan0"


def service() -> str:
    """Installed, active by notify, its loop FIFO with locked memory, on the comedi board."""
    shutil.copy(CONFIGS / "comedi.toml", "/etc/rtloop/rig.toml")
    drop_in = Path("/etc/systemd/system/rtloop@.service.d/emulated.conf")
    drop_in.parent.mkdir(exist_ok=True)
    drop_in.write_text("[Service]\nTimeoutStartSec=900\n")  # the unit's 180 s are for a machine that is not emulated
    run("systemctl", "daemon-reload")
    try:
        run("systemctl", "start", UNIT)
    except Failed as error:
        raise Failed(f"{error}\n{run('journalctl', '--unit', UNIT, '--lines', '30', '--no-pager')}") from None
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
    return json.loads(run(BIN / "rtloop", "ctl", "--name", "rig", *words))


def loop_pids() -> list[int]:
    return list(map(int, run("pgrep", "--full", "--uid", "rtloop", "rtloop.engine.process").split()))


CHECKS: tuple[tuple[str, Callable[[], str]], ...] = (
    ("PREEMPT_RT kernel", kernel),
    ("comedi board of the kernel", comedi_device),
    ("conformance suite on it", conformance),
    ("a stranger is refused", permission),
    ("closed loop over comedi", comedi_loop),
    ("service, FIFO granted", service),
    ("closed loop over SocketCAN", can_loop),
    ("loopback self-test", selftest),
)


def main() -> int:
    held = 0
    for name, check in CHECKS:
        start_s = time.monotonic()
        try:
            verdict, detail, held = "holds", check(), held + 1
        except (Failed, OSError, ValueError, KeyError, subprocess.TimeoutExpired) as error:
            verdict, detail = "FAILS", f"{type(error).__name__}: {error}"
        print(f"{verdict}  {name:28} {time.monotonic() - start_s:5.0f} s  {detail}", flush=True)
    print(f"{held} of {len(CHECKS)} checks hold", flush=True)
    return 0 if held == len(CHECKS) else 1


if __name__ == "__main__":
    sys.exit(main())
