"""The installed service under a real systemd, inside the container of tests/systemd/run: one verdict line a check.

What an output did is read from the board's memory, never from the process that drove it or died. Times are printed and
compared with generous bounds only: the host may be shared and stop for some hundred milliseconds.
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
PAGE = "http://127.0.0.1:8321"
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
"""What is allowed on top of every stated time."""
EXPOSURE_LIMIT = 2.0
TRIP_SLEW = "trip_slew_v_per_s = 1000.0"


class Failed(Exception):
    """A check does not hold."""


def require(condition: object, message: str) -> None:
    if not condition:
        raise Failed(message)


def run(*command: str, ok: bool = True) -> str:
    done = subprocess.run(command, capture_output=True, text=True)
    require(done.returncode == 0 or not ok, f"{' '.join(command)}: {done.returncode}: {done.stderr.strip()[-400:]}")
    return done.stdout


def show(name: str, unit: str = UNIT) -> str:
    return run("systemctl", "show", "--value", "--property", name, unit).strip()


def ctl(*words: str) -> dict[str, Any]:
    return json.loads(run(RTLOOP, "ctl", "--name", "board", *words))


def until(condition: Callable[[], Any], timeout_s: float, what: str, poll_s: float = 0.02) -> Any:
    """The condition's first true value."""
    deadline_s = time.monotonic() + timeout_s
    while not (value := condition()):
        require(time.monotonic() < deadline_s, f"not within {timeout_s:g} s: {what}")
        time.sleep(poll_s)
    return value


def service_pid() -> int:
    pid = int(show("MainPID"))
    require(pid, "the service does not run")  # and signals must not go to process 0
    return pid


def child(module: str) -> int:
    """The service's loop or recorder."""
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
    raise Failed(f"no process {module}")


class Board:
    """What the board saw at its output."""

    def __init__(self) -> None:
        options: Any = load(CONFIG).driver_options
        fd = os.open(options.file, os.O_RDWR)
        self.memory = BoardMemory(fd)
        self.seen = self.memory.evidence
        os.close(fd)

    @property
    def drive_v(self) -> float:
        return float(self.seen.last_v[0])

    def parked_after(self, start_s: float, timeout_s: float, rest_s: float = 0.05) -> float:
        """Seconds from `start_s` until the output came to 0 V and stayed there."""
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
    """What the unit logs from now on."""

    def __init__(self) -> None:
        out = run("journalctl", "--unit", UNIT, "--lines", "0", "--show-cursor", "--quiet", ok=False)
        self._cursor = out.partition("cursor: ")[2].strip()

    def text(self) -> str:
        after = ("--after-cursor", self._cursor) if self._cursor else ()
        return run("journalctl", "--unit", UNIT, "--output", "cat", "--quiet", *after, ok=False)

    def await_text(self, pattern: str, timeout_s: float = 20.0) -> str:
        return until(lambda: re.search(pattern, self.text()), timeout_s, f"{pattern!r} in the journal", 0.2)[0]


host_trips: list[str] = []


def await_running(timeout_s: float = 60.0) -> None:
    """Active, and driving. A trip that nobody here caused is the host's: it is counted, reset, and the loop started."""
    until(lambda: show("ActiveState") == "active", timeout_s, "active")

    def running() -> bool:
        try:
            status = ctl("status")
        except Failed:
            return False
        if status["state"] == "tripped":
            host_trips.append(", ".join(status["trip"] or status["faults"]))
            ctl("reset")
            ctl("start")
        return status["state"] == "running" and status["ticks"] > 0

    until(running, timeout_s, "running", 0.2)
    until(lambda: Board().drive_v > 0.1, timeout_s, "driving")


def acknowledge() -> None:
    """Reset what a check caused, and drive again."""
    until(lambda: ctl("status").get("tick"), 120.0, "a new loop", 0.2)
    status = ctl("status")
    require(status["state"] == "tripped", f"state {status['state']} after a fault; expected: tripped until it is reset")
    ctl("reset")
    ctl("start")
    await_running()


def timing() -> tuple[float, float, float]:
    """Stall limit, heartbeat limit, longest ramp, in s."""
    configuration = load(CONFIG)
    limits = configuration.axes[0].limits
    ramp_s = limits.drive_v / limits.trip_slew_v_per_s
    return configuration.service.stall_ms / 1000, configuration.loop.heartbeat_timeout_s, ramp_s


# the checks, in their order; each returns what it measured


def not_ready_without_ticks() -> str:
    """Without a board no tick can run: the unit must not become active."""
    journal = Journal()
    done = subprocess.run(["systemctl", "start", UNIT], capture_output=True)
    state = show("ActiveState")
    run("systemctl", "stop", UNIT)
    run("systemctl", "reset-failed", UNIT, ok=False)
    require(done.returncode != 0 and state != "active", f"start returned {done.returncode}, the unit was {state}")
    return "start refused: " + journal.await_text(r"\S+: [^:\n]+; start the board with.*")


def limited_slew() -> str:
    """Let the loop move no faster than a ramp: without a limit it follows its controller, by half a volt a tick."""
    text = CONFIG.read_text()
    require(text.count(TRIP_SLEW) == 1 and "\nslew_v_per_s" not in text, f"{CONFIG} has other limits")
    CONFIG.write_text(text.replace(TRIP_SLEW, f"{TRIP_SLEW}\nslew_v_per_s = 1000.0"))
    return "1000 V/s, as the ramps have"


def active_by_notify() -> str:
    run("systemctl", "enable", "--now", BOARD)
    start_s = time.monotonic()
    run("systemctl", "enable", "--now", UNIT)
    took_s = time.monotonic() - start_s
    ticks = ctl("status")["ticks"]
    require(show("Type") == "notify" and show("ActiveState") == "active", "not active by notify")
    require(ticks >= 10, f"READY after {ticks} ticks")
    until(lambda: "Hz" in show("StatusText"), 10.0, "STATUS")
    await_running()
    return f"after {took_s:.1f} s; {show('StatusText')}"


def user_and_realtime() -> str:
    loop, recorder, main = child(LOOP), child(RECORDER), service_pid()
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
    status = SOCKET.stat()
    mode, group = stat.S_IMODE(status.st_mode), grp.getgrgid(status.st_gid).gr_name
    require(mode == 0o660 and group == "rtloop", f"{mode:04o}, group {group}")
    stranger = ["setpriv", "--reuid=nobody", "--regid=nogroup"]
    ask = [RTLOOP, "ctl", "--name", "board", "status"]
    outside = subprocess.run([*stranger, "--clear-groups", *ask], capture_output=True).returncode
    member = subprocess.run([*stranger, "--groups=rtloop", *ask], capture_output=True, text=True)
    require(outside == 69 and member.returncode == 0, f"a stranger gets {outside}, the group {member.stderr}")
    plain = run("curl", "--silent", "--unix-socket", str(SOCKET), "http://localhost/status")
    require(json.loads(plain)["name"] == "board", plain[:200])
    return f"{mode:04o} {group}; a stranger is refused, the group and curl are served"


def reload_good() -> str:
    journal, main, before = Journal(), service_pid(), ctl("status")["ticks"]
    CONFIG.write_text(CONFIG.read_text().replace("gain = 0.016", "gain = 0.0155"))
    run("systemctl", "reload", UNIT)
    said = journal.await_text(r"reloaded: .*")
    until(lambda: show("ActiveState") == "active", 20.0, "active after the reload")
    require(service_pid() == main and ctl("status")["ticks"] > before, "the loop did not go on")
    await_running()
    return said


def reload_bad() -> str:
    good, main, said = CONFIG.read_text(), service_pid(), []
    for old, new in (("drive_v = 10.0", "drive_v = 12.0"), ("rate_hz = 10000", "rate_hz = 5000"), ("[loop]", "[loop")):
        journal, before = Journal(), ctl("status")["ticks"]
        CONFIG.write_text(good.replace(old, new, 1))
        try:
            run("systemctl", "reload", UNIT)
            said.append(journal.await_text(r"reload refused.*(\n +.*)*").splitlines()[-1].strip())
            until(lambda: show("ActiveState") == "active", 20.0, "active after the reload")
        finally:
            CONFIG.write_text(good)
        require(service_pid() == main and ctl("status")["ticks"] > before, "the loop did not go on")
    await_running()
    return " | ".join(text.removeprefix("reload refused: ") for text in said)


def panel() -> str:
    """In the browser's words: no token, no data; with it, the service's state; a foreign page moves nothing."""
    run("systemctl", "start", PANEL)
    token = Path("/run/rtloop/board.panel-token")
    until(token.exists, 30.0, "the panel's token", 0.2)
    require(stat.S_IMODE(token.stat().st_mode) == 0o640, f"{token} is {stat.S_IMODE(token.stat().st_mode):o}")
    until(lambda: _asked("GET", "/")[0] == 200, 30.0, "the panel", 0.2)
    require(_asked("GET", "/api/status")[0] == 401, "data without a session")
    said, cookie = _asked("POST", "/session", json.dumps({"token": token.read_text().strip()}))
    require(said == 204 and cookie, f"{said} for the token")
    code, answer = _asked("GET", "/api/status", cookie=cookie)
    require(code == 200 and json.loads(answer)["state"] == "running", answer)
    require(_asked("POST", "/api/stop", "{}", cookie, "http://elsewhere.example")[0] == 403, "a foreign page is heard")
    level = _exposure(PANEL)
    require(level <= EXPOSURE_LIMIT, f"exposure {level}")
    run("systemctl", "stop", PANEL)
    require(ctl("status")["state"] == "running", "the service ended with its panel")
    return f"session by token, nothing without; exposure {level}; its end changes nothing"


def _asked(method: str, path: str, body: str = "", cookie: str = "", origin: str = PAGE) -> tuple[int, str]:
    """Status, and the cookie of a session or the text of an answer."""
    request = urllib.request.Request(PAGE + path, body.encode() or None, method=method)
    for name, value in (("Origin", origin), ("Cookie", cookie), ("Content-Type", "application/json")):
        request.add_header(name, value)
    try:
        with urllib.request.urlopen(request, timeout=10.0) as answer:
            cookie = answer.headers.get("Set-Cookie", "").partition(";")[0]
            return answer.status, cookie or answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()
    except OSError as error:
        return 0, str(error)


def stop_loop() -> str:
    stall_s, _, ramp_s = timing()
    return _loop_fault(signal.SIGSTOP, stall_s + ramp_s)


def kill_loop() -> str:
    return _loop_fault(signal.SIGKILL, timing()[2])


def _loop_fault(number: signal.Signals, expected_s: float) -> str:
    """The service parks in the loop's place, and starts another one, outputs off."""
    board, loop, main, restarts = Board(), child(LOOP), service_pid(), show("NRestarts")
    drive_v, start_s = board.drive_v, time.monotonic()
    os.kill(loop, number)
    parked_s = board.parked_after(start_s, expected_s + HOST_STALL_S)
    until(lambda: _other_loop(loop), 120.0, "a new loop", 0.2)  # what the service says before is of the one that died
    acknowledge()
    require(service_pid() == main and show("NRestarts") == restarts, "the service itself was restarted")
    return f"{drive_v:.2f} V → 0 V in {parked_s * 1e3:.0f} ms (stated: {expected_s * 1e3:.0f}); new loop, same service"


def _other_loop(loop: int) -> bool:
    try:
        return child(LOOP) != loop
    except Failed:
        return False


def stop_service() -> str:
    return _service_fault(signal.SIGSTOP, int(show("WatchdogUSec").removesuffix("s")))


def kill_service() -> str:
    return _service_fault(signal.SIGKILL, 0.0)


def _service_fault(number: signal.Signals, watchdog_s: float) -> str:
    """The loop parks itself, systemd starts another service."""
    board, main, restarts, journal = Board(), service_pid(), int(show("NRestarts")), Journal()
    _, heartbeat_s, ramp_s = timing()
    expected_s = heartbeat_s + ramp_s
    drive_v, start_s = board.drive_v, time.monotonic()
    os.kill(main, number)
    parked_s = board.parked_after(start_s, expected_s + HOST_STALL_S)
    until(lambda: show("MainPID") not in ("0", str(main)), watchdog_s + 90.0, "a new service", 0.2)
    await_running(120.0)
    took_s = time.monotonic() - start_s
    require(int(show("NRestarts")) == restarts + 1, f"NRestarts {restarts} → {show('NRestarts')}")
    if watchdog_s:
        journal.await_text("Watchdog timeout")
    journal.await_text(r"board: parked from .*")
    again = f"{'watchdog, ' if watchdog_s else ''}driving again after {took_s:.1f} s"
    return f"{drive_v:.2f} V → 0 V in {parked_s * 1e3:.0f} ms (stated: {expected_s * 1e3:.0f}); {again}"


def kill_recorder() -> str:
    board, recorder, loop = Board(), child(RECORDER), child(LOOP)
    before = ctl("status")["recorder_replacements"]
    os.kill(recorder, signal.SIGKILL)
    until(lambda: ctl("status")["recorder_replacements"] == before + 1, 30.0, "another recorder", 0.2)
    require(child(LOOP) == loop and board.drive_v > 0.1, "the loop was disturbed")
    time.sleep(3.0)
    return "replaced; the loop went on"


def stop() -> str:
    board, start_s = Board(), time.monotonic()
    time.sleep(2.0)
    run("systemctl", "stop", UNIT)
    took_s = time.monotonic() - start_s - 2.0
    result, code = show("Result"), show("ExecMainStatus")
    require((result, code) == ("success", "0"), f"result {result}, exit status {code}")
    require(board.drive_v == 0.0, f"{board.drive_v} V")
    until(lambda: not _left_over(), 15.0, "the last of the service's processes gone", 0.2)
    last = _newest()
    facts = json.loads(run(RTLOOP, "info", "--json", str(last), ok=False))
    require(facts["complete"] and facts["ticks_lost"] == 0, f"{last.name}: {facts['ticks_lost']} ticks lost")
    return f"in {took_s:.1f} s, exit 0, 0 V; {last.name} complete, {facts['ticks_logged']} ticks, 0 lost"


def replays() -> str:
    """Every recording of the session, those of killed processes too."""
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
    """Every write of the session, whoever made it: `limited_slew` lets the running loop move no faster than a ramp."""
    board, configuration = Board(), load(CONFIG)
    seen, rate_hz = board.seen[0], configuration.loop.rate_hz
    unseen = int(board.memory.words[MISSED_WRITES])
    require(unseen == 0, f"{unseen} writes that the board came too late to see")
    require(seen.lowest_v >= -10.0 and seen.highest_v <= 10.0, f"{seen.lowest_v} … {seen.highest_v} V")
    step_v = configuration.axes[0].limits.trip_slew_v_per_s / rate_hz
    steps = math.ceil(WINDOW_NS * 1e-9 * rate_hz) + 2  # a write may be held up until the next one, and come with it
    moved = (seen.largest_step_v, 1, "from one write to the next"), (seen.largest_window_v, steps, "within 1 ms")
    for change_v, count, where in moved:
        allowed_v = count * step_v + LSB_V
        require(change_v <= allowed_v, f"{change_v:.4f} V {where}; allowed: {allowed_v:.4f} V")
    said = f"{seen.largest_step_v:.3f} V a write, {seen.largest_window_v:.3f} V within 1 ms"
    return f"{seen.lowest_v:.3f} … {seen.highest_v:.3f} V, at most {said} (allowed {step_v:.3f}, {steps * step_v:.3f})"


def exposure() -> str:
    level = _exposure(UNIT)
    require(level <= EXPOSURE_LIMIT, f"{level}")
    return f"{level} (limit {EXPOSURE_LIMIT})"


def _exposure(unit: str) -> float:
    text = run("systemd-analyze", "security", "--no-pager", unit)
    return float(re.search(r"Overall exposure level for \S+: ([\d.]+)", text)[1])  # type: ignore[index]


def manual() -> str:
    missing = [str(path) for path in MANUAL if not path.is_file()]
    require(not missing, f"missing: {', '.join(missing)}")
    words = f"COMP_WORDS=({RTLOOP} re); COMP_CWORD=1"
    program = f"source {MANUAL[-1]}; {words}; _rtloop_completion {RTLOOP}; echo ${{COMPREPLY[@]}}"
    completed = run("bash", "-c", program).split()
    require("replay" in completed, f"completions of `rtloop re`: {completed}")
    return f"man pages; bash completes `rtloop re` to {' '.join(completed)}"


def uninstall() -> str:
    CONFIG.write_text(CONFIG.read_text() + "# edited\n")
    subprocess.run(["systemctl", "disable", "--now", UNIT, BOARD], capture_output=True)
    run("make", "-C", "/src", "uninstall")
    gone = [
        Path("/opt/rtloop"),
        Path("/etc/systemd/system/rtloop@.service"),
        Path("/usr/lib/udev/rules.d/60-rtloop.rules"),
        *MANUAL,
    ]
    require(not any(path.exists() for path in gone), "something is left")
    require(CONFIG.read_text().endswith("# edited\n") and list(RECORDINGS.glob("*.mcap")), "data is gone")
    return "program and units gone; /etc/rtloop and /var/lib/rtloop kept"


def _newest() -> Path:
    return max(RECORDINGS.glob("*.mcap"), key=lambda path: path.stat().st_mtime)


def _left_over() -> list[str]:
    """Processes of the user rtloop beside the board."""
    found = run("pgrep", "--uid", "rtloop", "--list-full", ok=False).splitlines()
    return [line for line in found if "hil serve" not in line]


CHECKS: tuple[tuple[str, Callable[[], str]], ...] = (
    ("not READY where no tick can run", not_ready_without_ticks),
    ("running slew limited", limited_slew),
    ("active by notify", active_by_notify),
    ("own user, FIFO and mlock granted", user_and_realtime),
    ("control socket 0660", socket_permissions),
    ("reload, good file", reload_good),
    ("reload, bad files: the old stays", reload_bad),
    ("panel", panel),
    ("SIGSTOP loop", stop_loop),
    ("SIGSTOP service", stop_service),
    ("SIGKILL loop", kill_loop),
    ("SIGKILL recorder", kill_recorder),
    ("SIGKILL service", kill_service),
    ("systemctl stop", stop),
    ("replay of every recording", replays),
    ("what the board saw", outputs_seen),
    ("exposure by systemd-analyze", exposure),
    ("man pages and completion", manual),
    ("uninstall", uninstall),
)


def main() -> int:
    held = 0
    for name, check in CHECKS:
        try:
            verdict, detail, held = "holds", check(), held + 1
        except (Failed, OSError, ValueError, KeyError) as error:
            verdict, detail = "FAILS", f"{type(error).__name__}: {error}"
        print(f"{verdict}  {name:34} {detail}", flush=True)
        if verdict == "FAILS":
            print(run("journalctl", "--unit", UNIT, "--lines", "25", "--no-pager", ok=False), file=sys.stderr)
            if check is active_by_notify:
                break  # the others would say nothing
    if host_trips:
        print(f"       trips caused by the host's stalls: {'; '.join(host_trips)}")
    print(f"{held} of {len(CHECKS)} checks hold")
    return 0 if held == len(CHECKS) else 1


if __name__ == "__main__":
    sys.exit(main())
