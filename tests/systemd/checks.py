"""The installed service under a real systemd, in the container of tests/systemd/run. Each check prints a verdict line.

The outputs are read from the board's memory, not from the process that drives them and may be dead. Times are printed,
and compared with generous bounds: the host may be shared and stall for some hundred milliseconds.
"""

from __future__ import annotations

import grp
import json
import math
import os
import pwd
import re
import signal
import stat
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rtloop.configuration.file import load
from rtloop.hil.board import LSB_V, MISSED_WRITES, BoardMemory
from rtloop.hil.witness import WINDOW_NS

UNIT, BOARD, PANEL = "rtloop@board.service", "rtloop-board@board.service", "rtloop-panel@board.service"
RTLOOP = "/opt/rtloop/bin/rtloop"
CONFIG = Path("/etc/rtloop/board.toml")
RECORDINGS = Path("/var/lib/rtloop/recordings")
SOCKET = Path("/run/rtloop/board.sock")
MANUAL = tuple(
    Path("/usr/share") / name
    for name in ("man/man1/rtloop.1", "man/man1/rtloop-ctl-tune.1", "bash-completion/completions/rtloop")
)
LOOP, RECORDER = "rtloop.engine.process", "rtloop.recording.capture.recorder"
HOST_STALL_S = 2.0
"""Allowance for stalls of the host, added to every stated time."""
EXPOSURE_LIMIT = 2.0
TRIP_SLEW = "trip_slew_v_per_s = 1000.0"


class CheckFailed(Exception):
    """A check failed; the message says why."""


def require(condition: object, message: str) -> None:
    """Raise CheckFailed with `message` unless the condition is true."""
    if not condition:
        raise CheckFailed(message)


def run(*command: str, ok: bool = True) -> str:
    """Run a command; return its standard output. Raises CheckFailed for a failure if `ok`."""
    completed = subprocess.run(command, capture_output=True, text=True)
    code, errors = completed.returncode, completed.stderr.strip()[-400:]
    require(code == 0 or not ok, f"{' '.join(command)}: {code}: {errors}")
    return completed.stdout


def unit_property(name: str, unit: str = UNIT) -> str:
    """Return a property of a unit, as `systemctl show` prints it."""
    return run("systemctl", "show", "--value", "--property", name, unit).strip()


def ctl(*words: str) -> dict[str, Any]:
    """Return the response to `rtloop ctl WORDS`."""
    return json.loads(run(RTLOOP, "ctl", "--name", "board", *words))


def wait_until(condition: Callable[[], Any], timeout_s: float, event: str, poll_s: float = 0.02) -> Any:
    """Return the condition's first true value. Raises CheckFailed, with the name of the event, after `timeout_s`."""
    deadline_s = time.monotonic() + timeout_s
    while not (value := condition()):
        require(time.monotonic() < deadline_s, f"not within {timeout_s:g} s: {event}")
        time.sleep(poll_s)
    return value


def service_pid() -> int:
    """Return the process id of the service. Raises CheckFailed if it does not run."""
    pid = int(unit_property("MainPID"))
    require(pid, "the service does not run")  # A signal to process 0 would reach all processes of the group.
    return pid


def child_pid(module: str) -> int:
    """Return the process id of the service's child that runs `module`. Raises CheckFailed without one."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0")
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, IndexError):
            continue
        if module.encode() in words and parent == service_pid():
            return int(entry.name)
    raise CheckFailed(f"no process {module}")


class Board:
    """The board's record of its output."""

    def __init__(self) -> None:
        options: Any = load(CONFIG).driver_options
        fd = os.open(options.file, os.O_RDWR)
        self.memory = BoardMemory(fd)
        self.evidence = self.memory.evidence
        os.close(fd)

    @property
    def drive_v(self) -> float:
        """The last drive at the output in V."""
        return float(self.evidence.last_v[0])

    def parked_after(self, start_s: float, timeout_s: float, rest_s: float = 0.05) -> float:
        """Wait until the output stays at 0 V for `rest_s`; return the seconds from `start_s` until it reached 0 V."""
        deadline_s, since_s = start_s + timeout_s, None
        while True:
            now_s = time.monotonic()
            if self.drive_v != 0.0:
                since_s = None
            else:
                since_s = since_s or now_s
                if now_s - since_s >= rest_s:
                    return since_s - start_s
            require(now_s < deadline_s, f"not parked within {timeout_s:g} s: {self.drive_v:.3f} V")
            time.sleep(0.001)


class Journal:
    """The log of the unit from the creation of this object on."""

    def __init__(self) -> None:
        out = run("journalctl", "--unit", UNIT, "--lines", "0", "--show-cursor", "--quiet", ok=False)
        self._cursor = out.partition("cursor: ")[2].strip()

    def text(self) -> str:
        """Return the text that the unit has logged."""
        after = ("--after-cursor", self._cursor) if self._cursor else ()
        return run("journalctl", "--unit", UNIT, "--output", "cat", "--quiet", *after, ok=False)

    def await_text(self, pattern: str, timeout_s: float = 20.0) -> str:
        """Wait until the log matches `pattern`; return the matching text. Raises CheckFailed after `timeout_s`."""
        return wait_until(lambda: re.search(pattern, self.text()), timeout_s, f"{pattern!r} in the journal", 0.2)[0]


host_trips: list[str] = []


def await_running(timeout_s: float = 60.0) -> None:
    """Wait until the unit is active and its loop drives. A trip here comes from a stalled host: record and reset it."""
    wait_until(lambda: unit_property("ActiveState") == "active", timeout_s, "active")

    def is_running() -> bool:
        try:
            status = ctl("status")
        except CheckFailed:
            return False
        if status["state"] == "tripped":
            host_trips.append(", ".join(status["trip"] or status["faults"]))
            ctl("reset")
            ctl("start")
        return status["state"] == "running" and status["ticks"] > 0

    wait_until(is_running, timeout_s, "running", 0.2)
    wait_until(lambda: Board().drive_v > 0.1, timeout_s, "driving")


def reset_and_start() -> None:
    """Wait for the trip that a check caused, reset it and start the loop."""
    wait_until(lambda: ctl("status").get("tick"), 120.0, "a new loop", 0.2)
    status = ctl("status")
    require(status["state"] == "tripped", f"state {status['state']} after a fault; expected: tripped until it is reset")
    ctl("reset")
    ctl("start")
    await_running()


def stated_times_s() -> tuple[float, float, float]:
    """Return the limits of a stall and of the heartbeat, and the duration of the longest ramp, in s."""
    configuration = load(CONFIG)
    limits = configuration.axes[0].limits
    ramp_s = limits.drive_v / limits.trip_slew_v_per_s
    return configuration.service.stall_ms / 1000, configuration.loop.heartbeat_timeout_s, ramp_s


# The checks, in the order of their execution. Each returns a text with its measured values.


def not_ready_without_ticks() -> str:
    """The unit does not become active without a board, because no tick can run."""
    journal = Journal()
    code = subprocess.run(["systemctl", "start", UNIT], capture_output=True).returncode
    state = unit_property("ActiveState")
    run("systemctl", "stop", UNIT)
    run("systemctl", "reset-failed", UNIT, ok=False)
    require(code != 0 and state != "active", f"start returned {code}, the unit was {state}")
    return "start refused: " + journal.await_text(r"\S+: [^:\n]+; start the board with.*")


def limited_slew() -> str:
    """Limit the slew of the loop like a ramp's; without a limit its controller moves the output by 0.5 V a tick."""
    text = CONFIG.read_text()
    require(text.count(TRIP_SLEW) == 1 and "\nslew_v_per_s" not in text, f"{CONFIG} has other limits")
    CONFIG.write_text(text.replace(TRIP_SLEW, f"{TRIP_SLEW}\nslew_v_per_s = 1000.0"))
    return "1000 V/s, like the ramps"


def active_by_notify() -> str:
    """The unit becomes active by notification, after at least ten ticks."""
    run("systemctl", "enable", "--now", BOARD)
    start_s = time.monotonic()
    run("systemctl", "enable", "--now", UNIT)
    duration_s = time.monotonic() - start_s
    ticks = ctl("status")["ticks"]
    require(unit_property("Type") == "notify" and unit_property("ActiveState") == "active", "not active by notify")
    require(ticks >= 10, f"READY after {ticks} ticks")
    wait_until(lambda: "Hz" in unit_property("StatusText"), 10.0, "STATUS")
    await_running()
    return f"after {duration_s:.1f} s; {unit_property('StatusText')}"


def user_and_realtime() -> str:
    """All processes run as user rtloop; the loop has SCHED_FIFO, locked memory and only two capabilities."""
    loop, recorder, main = child_pid(LOOP), child_pid(RECORDER), service_pid()
    users = {pwd.getpwuid(os.stat(f"/proc/{pid}").st_uid).pw_name for pid in (loop, recorder, main)}
    require(users == {"rtloop"}, f"run as {users}")
    policy, priority = os.sched_getscheduler(loop) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(loop).sched_priority
    require(policy == os.SCHED_FIFO, f"the loop's policy is {policy}")
    for pid in (recorder, main):
        require(
            os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER, f"process {pid} is not ordinary"
        )
    facts = dict(line.split(":", 1) for line in Path(f"/proc/{loop}/status").read_text().splitlines())
    locked_mib = int(facts["VmLck"].split()[0]) / 1024
    require(locked_mib > 10, f"{locked_mib:.0f} MiB locked")
    capabilities = int(facts["CapEff"], 16)
    require(capabilities == 1 << 14 | 1 << 23, f"capabilities {capabilities:#x}; CAP_IPC_LOCK and CAP_SYS_NICE alone")
    realtime = ctl("status")["realtime"]
    require(realtime["scheduler"] == "SCHED_FIFO" and realtime["mlock"], f"status says {realtime}")
    refused = f"; not granted: {', '.join(realtime['refused'])}" if realtime["refused"] else ""
    return f"rtloop; loop SCHED_FIFO {priority}, {locked_mib:.0f} MiB locked{refused}"


def socket_permissions() -> str:
    """The control socket serves members of the group rtloop and refuses other users."""
    status = SOCKET.stat()
    mode, group = stat.S_IMODE(status.st_mode), grp.getgrgid(status.st_gid).gr_name
    require(mode == 0o660 and group == "rtloop", f"{mode:04o}, group {group}")
    as_nobody = ["setpriv", "--reuid=nobody", "--regid=nogroup"]
    status_command = [RTLOOP, "ctl", "--name", "board", "status"]
    other_code = subprocess.run([*as_nobody, "--clear-groups", *status_command], capture_output=True).returncode
    member = subprocess.run([*as_nobody, "--groups=rtloop", *status_command], capture_output=True, text=True)
    require(other_code == 69 and member.returncode == 0, f"another user gets {other_code}, a member {member.stderr}")
    plain = run("curl", "--silent", "--unix-socket", str(SOCKET), "http://localhost/status")
    require(json.loads(plain)["name"] == "board", plain[:200])
    return f"{mode:04o} {group}; another user is refused, a member of the group and curl are served"


def reload_good() -> str:
    """A reload of a valid file changes the gain, and the loop continues."""
    journal, main, before = Journal(), service_pid(), ctl("status")["ticks"]
    CONFIG.write_text(CONFIG.read_text().replace("gain = 0.016", "gain = 0.0155"))
    run("systemctl", "reload", UNIT)
    message = journal.await_text(r"reloaded: .*")
    wait_until(lambda: unit_property("ActiveState") == "active", 20.0, "active after the reload")
    require(service_pid() == main and ctl("status")["ticks"] > before, "the loop did not continue")
    await_running()
    return message


def reload_bad() -> str:
    """A reload of each of three invalid files is refused, and the loop continues."""
    valid_text, main, messages = CONFIG.read_text(), service_pid(), []
    for old, new in (("drive_v = 10.0", "drive_v = 12.0"), ("rate_hz = 10000", "rate_hz = 5000"), ("[loop]", "[loop")):
        journal, before = Journal(), ctl("status")["ticks"]
        CONFIG.write_text(valid_text.replace(old, new, 1))
        try:
            run("systemctl", "reload", UNIT)
            messages.append(journal.await_text(r"reload refused.*(\n +.*)*").splitlines()[-1].strip())
            wait_until(lambda: unit_property("ActiveState") == "active", 20.0, "active after the reload")
        finally:
            CONFIG.write_text(valid_text)
        require(service_pid() == main and ctl("status")["ticks"] > before, "the loop did not continue")
    await_running()
    return " | ".join(text.removeprefix("reload refused: ") for text in messages)


def panel() -> str:
    """Requests get data only in a session, which the token opens; a request of a foreign page is refused."""
    run("systemctl", "start", PANEL)
    token = Path("/run/rtloop/board.panel-token")
    wait_until(token.exists, 30.0, "the panel's token", 0.2)
    require(stat.S_IMODE(token.stat().st_mode) == 0o640, f"{token} is {stat.S_IMODE(token.stat().st_mode):o}")
    page, _, secret = token.read_text().strip().partition("/#token=")
    wait_until(lambda: _request(page, "GET", "/")[0] == 200, 30.0, "the panel", 0.2)
    require(_request(page, "GET", "/api/status")[0] == 401, "data without a session")
    code, answer = _request(page, "POST", "/session", json.dumps({"token": secret}))
    require(code == 200, f"{code} for the token")
    session = json.loads(answer)["session"]
    code, answer = _request(page, "GET", "/api/status", session=session)
    require(code == 200 and json.loads(answer)["state"] == "running", answer)
    code, _ = _request(page, "POST", "/api/stop", "{}", session, "http://elsewhere.example")
    require(code == 403, f"{code} for a foreign page's request")
    level = _exposure(PANEL)
    require(level <= EXPOSURE_LIMIT, f"exposure {level}")
    run("systemctl", "stop", PANEL)
    require(ctl("status")["state"] == "running", "the service ended with its panel")
    return f"data only in a session by token; exposure {level}; the service runs on after its end"


def _request(
    page: str, method: str, path: str, body: str = "", session: str = "", origin: str | None = None
) -> tuple[int, str]:
    """Send a request to the panel at the address `page`; return the status (0 without an answer) and the text."""
    request = urllib.request.Request(page + path, body.encode() or None, method=method)
    headers = {"Origin": origin or page, "Authorization": f"Bearer {session}", "Content-Type": "application/json"}
    for name, value in headers.items():
        request.add_header(name, value)
    try:
        with urllib.request.urlopen(request, timeout=10.0) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()
    except OSError as error:
        return 0, str(error)


def stop_loop() -> str:
    """The output is parked after the loop is stopped by SIGSTOP."""
    stall_s, _, ramp_s = stated_times_s()
    return _loop_fault(signal.SIGSTOP, stall_s + ramp_s)


def kill_loop() -> str:
    """The output is parked after the loop is killed."""
    return _loop_fault(signal.SIGKILL, stated_times_s()[2])


def _loop_fault(number: signal.Signals, expected_s: float) -> str:
    """Send a signal to the loop: the service parks the output and starts another loop, with outputs off."""
    board, loop, main, restarts = Board(), child_pid(LOOP), service_pid(), unit_property("NRestarts")
    drive_v, start_s = board.drive_v, time.monotonic()
    os.kill(loop, number)
    parked_s = board.parked_after(start_s, expected_s + HOST_STALL_S)
    wait_until(lambda: _is_loop_replaced(loop), 120.0, "a new loop", 0.2)  # Earlier statuses are of the old loop.
    reset_and_start()
    require(service_pid() == main and unit_property("NRestarts") == restarts, "the service itself was restarted")
    return f"{drive_v:.2f} V → 0 V in {parked_s * 1e3:.0f} ms (stated: {expected_s * 1e3:.0f}); new loop, same service"


def _is_loop_replaced(loop: int) -> bool:
    """Return whether the service has a loop other than the process `loop`."""
    try:
        return child_pid(LOOP) != loop
    except CheckFailed:
        return False


def stop_service() -> str:
    """The output is parked after the service is stopped by SIGSTOP."""
    return _service_fault(signal.SIGSTOP, int(unit_property("WatchdogUSec").removesuffix("s")))


def kill_service() -> str:
    """The output is parked after the service is killed."""
    return _service_fault(signal.SIGKILL, 0.0)


def _service_fault(number: signal.Signals, watchdog_s: float) -> str:
    """Send a signal to the service: the loop parks its output, and systemd starts another service."""
    board, main, restarts, journal = Board(), service_pid(), int(unit_property("NRestarts")), Journal()
    _, heartbeat_s, ramp_s = stated_times_s()
    expected_s = heartbeat_s + ramp_s
    drive_v, start_s = board.drive_v, time.monotonic()
    os.kill(main, number)
    parked_s = board.parked_after(start_s, expected_s + HOST_STALL_S)
    wait_until(lambda: unit_property("MainPID") not in ("0", str(main)), watchdog_s + 90.0, "a new service", 0.2)
    await_running(120.0)
    duration_s = time.monotonic() - start_s
    require(int(unit_property("NRestarts")) == restarts + 1, f"NRestarts {restarts} → {unit_property('NRestarts')}")
    if watchdog_s:
        journal.await_text("Watchdog timeout")
    journal.await_text(r"board: parked from .*")
    restart = f"{'watchdog, ' if watchdog_s else ''}driving again after {duration_s:.1f} s"
    return f"{drive_v:.2f} V → 0 V in {parked_s * 1e3:.0f} ms (stated: {expected_s * 1e3:.0f}); {restart}"


def kill_recorder() -> str:
    """A killed recorder is replaced, and the loop continues."""
    board, recorder, loop = Board(), child_pid(RECORDER), child_pid(LOOP)
    before = ctl("status")["recorder_replacements"]
    os.kill(recorder, signal.SIGKILL)
    wait_until(lambda: ctl("status")["recorder_replacements"] == before + 1, 30.0, "another recorder", 0.2)
    require(child_pid(LOOP) == loop and board.drive_v > 0.1, "the loop was disturbed")
    time.sleep(3.0)
    return "replaced; the loop continued"


def stop() -> str:
    """A stop of the unit parks the output and completes the recording without a lost tick."""
    board, start_s = Board(), time.monotonic()
    time.sleep(2.0)
    run("systemctl", "stop", UNIT)
    duration_s = time.monotonic() - start_s - 2.0
    result, code = unit_property("Result"), unit_property("ExecMainStatus")
    require((result, code) == ("success", "0"), f"result {result}, exit status {code}")
    require(board.drive_v == 0.0, f"{board.drive_v} V")
    wait_until(lambda: not _remaining_processes(), 15.0, "the last of the service's processes gone", 0.2)
    recording = _newest()
    facts = json.loads(run(RTLOOP, "info", "--json", str(recording), ok=False))
    require(facts["complete"] and facts["ticks_lost"] == 0, f"{recording.name}: {facts['ticks_lost']} ticks lost")
    return f"in {duration_s:.1f} s, exit 0, 0 V; {recording.name} complete, {facts['ticks_logged']} ticks, 0 lost"


def replays() -> str:
    """Every recording of the session is complete and replays identically, also after a killed process."""
    parts = [path.name for path in RECORDINGS.glob("*.part") if not path.with_suffix("").exists()]
    require(not parts, f"unfinished: {parts}")
    ticks, lost, files = 0, 0, sorted(RECORDINGS.glob("*.mcap"))
    for path in files:
        answer = json.loads(run(RTLOOP, "replay", "--json", str(path), ok=False))
        require(answer.get("identical"), f"{path.name}: {answer}")
        ticks += answer["ticks"]
        lost += json.loads(run(RTLOOP, "info", "--json", str(path), ok=False))["ticks_lost"]
    require(len(files) >= 5, f"{len(files)} recordings")
    return f"{len(files)} recordings, {ticks} ticks, all identical; {lost} ticks lost"


def outputs_seen() -> str:
    """Every write of the session, by any process, keeps the limits of voltage and of slew (see `limited_slew`)."""
    board, configuration = Board(), load(CONFIG)
    evidence, rate_hz = board.evidence[0], configuration.loop.rate_hz
    missed_writes = int(board.memory.words[MISSED_WRITES])
    require(missed_writes == 0, f"{missed_writes} writes that the board missed")
    require(evidence.lowest_v >= -10.0 and evidence.highest_v <= 10.0, f"{evidence.lowest_v} … {evidence.highest_v} V")
    step_v = configuration.axes[0].limits.trip_slew_v_per_s / rate_hz
    steps = math.ceil(WINDOW_NS * 1e-9 * rate_hz) + 2  # A delayed write may arrive together with the next one.
    a_write = evidence.largest_step_v, 1, "from one write to the next"
    for change_v, count, interval in (a_write, (evidence.largest_window_v, steps, "within 1 ms")):
        allowed_v = count * step_v + LSB_V
        require(change_v <= allowed_v, f"{change_v:.4f} V {interval}; allowed: {allowed_v:.4f} V")
    largest = f"{evidence.largest_step_v:.3f} V a write, {evidence.largest_window_v:.3f} V within 1 ms"
    allowed = f"allowed {step_v:.3f}, {steps * step_v:.3f}"
    return f"{evidence.lowest_v:.3f} … {evidence.highest_v:.3f} V, at most {largest} ({allowed})"


def exposure() -> str:
    """The exposure level of the service's unit is within the limit."""
    level = _exposure(UNIT)
    require(level <= EXPOSURE_LIMIT, f"{level}")
    return f"{level} (limit {EXPOSURE_LIMIT})"


def _exposure(unit: str) -> float:
    """Return the exposure level of a unit, from 0 (safe) to 10, as systemd-analyze reports it."""
    text = run("systemd-analyze", "security", "--no-pager", unit)
    return float(re.search(r"Overall exposure level for \S+: ([\d.]+)", text)[1])  # type: ignore[index]


def manual() -> str:
    """The manual pages are installed, and bash completes commands."""
    missing = [str(path) for path in MANUAL if not path.is_file()]
    require(not missing, f"missing: {', '.join(missing)}")
    words = f"COMP_WORDS=({RTLOOP} re); COMP_CWORD=1"
    program = f"source {MANUAL[-1]}; {words}; _rtloop_completion {RTLOOP}; echo ${{COMPREPLY[@]}}"
    completed = run("bash", "-c", program).split()
    require("replay" in completed, f"completions of `rtloop re`: {completed}")
    return f"man pages; bash completes `rtloop re` to {' '.join(completed)}"


def uninstall() -> str:
    """Uninstalling removes program and units, but neither the configuration nor the recordings."""
    CONFIG.write_text(CONFIG.read_text() + "# edited\n")
    subprocess.run(["systemctl", "disable", "--now", UNIT, BOARD], capture_output=True)
    run("make", "-C", "/src", "uninstall")
    removed = [
        Path("/opt/rtloop"),
        Path("/etc/systemd/system/rtloop@.service"),
        Path("/usr/lib/udev/rules.d/60-rtloop.rules"),
        *MANUAL,
    ]
    require(not any(path.exists() for path in removed), "an installed file remains")
    is_kept = CONFIG.read_text().endswith("# edited\n") and list(RECORDINGS.glob("*.mcap"))
    require(is_kept, "the configuration or the recordings are missing")
    return "program and units gone; /etc/rtloop and /var/lib/rtloop kept"


def _newest() -> Path:
    """Return the recording that was written last."""
    return max(RECORDINGS.glob("*.mcap"), key=lambda path: path.stat().st_mtime)


def _remaining_processes() -> list[str]:
    """Return the processes of the user rtloop, without the board's."""
    processes = run("pgrep", "--uid", "rtloop", "--list-full", ok=False).splitlines()
    return [line for line in processes if "hil serve" not in line]


CHECKS: tuple[tuple[str, Callable[[], str]], ...] = (
    ("not READY where no tick can run", not_ready_without_ticks),
    ("running slew limited", limited_slew),
    ("active by notify", active_by_notify),
    ("own user, FIFO and mlock granted", user_and_realtime),
    ("control socket 0660", socket_permissions),
    ("reload, good file", reload_good),
    ("reload, bad files: no change", reload_bad),
    ("panel", panel),
    ("SIGSTOP loop", stop_loop),
    ("SIGSTOP service", stop_service),
    ("SIGKILL loop", kill_loop),
    ("SIGKILL recorder", kill_recorder),
    ("SIGKILL service", kill_service),
    ("systemctl stop", stop),
    ("replay of every recording", replays),
    ("outputs recorded by the board", outputs_seen),
    ("exposure by systemd-analyze", exposure),
    ("man pages and completion", manual),
    ("uninstall", uninstall),
)


def main() -> int:
    """Run the checks, print their verdicts, and return 0 if all hold, otherwise 1."""
    passed_count = 0
    for name, check in CHECKS:
        try:
            verdict, detail, passed_count = "holds", check(), passed_count + 1
        except (CheckFailed, OSError, ValueError, KeyError) as error:
            verdict, detail = "FAILS", f"{type(error).__name__}: {error}"
        print(f"{verdict}  {name:34} {detail}", flush=True)
        if verdict == "FAILS":
            print(run("journalctl", "--unit", UNIT, "--lines", "25", "--no-pager", ok=False), file=sys.stderr)
            if check is active_by_notify:
                break  # Without a running service the other checks prove nothing.
    if host_trips:
        print(f"       trips caused by the host's stalls: {'; '.join(host_trips)}")
    print(f"{passed_count} of {len(CHECKS)} checks hold")
    return 0 if passed_count == len(CHECKS) else 1


if __name__ == "__main__":
    sys.exit(main())
