"""Faults by requests and signals: reloads, floods, malformed requests, a second instance, hasty stops."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import threading
import time
from pathlib import Path

from rtloop.errors import RtloopError
from tests.faults.bench import Bench
from tests.faults.evidence import TIMEOUT_S, wait_for
from tests.faults.fault import Fault, Outcome
from tests.service.hostile import EXPENSIVE, hostile_requests
from tests.service.http import exchange

RELOADS, CLIENTS, REQUESTS = 100, 8, 60
AT_ONCE_MS, BUILT_MS, FIRST_BUILT_MS = 60.0, 1000.0, 4000.0
"""Bounds in ms to 0 V: after a signal; after a request whose coefficients must be built and verified; after such a
request at the first ticks, while the process that builds the coefficients is still starting."""
STOPS_APART_S = 0.01
SILENT, BODIES, SEED, STOPPED_MS = 600, 200, 14, 2000.0
MALFORMED = (
    b"",
    b"nonsense\r\n\r\n",
    b"POST /mode HTTP/1.1\r\nHost: x\r\nContent-Length: 9\r\n\r\n{\"mode\":1",
    b"POST /setpoint HTTP/1.1\r\nHost: x\r\nContent-Length: 37\r\n\r\n{\"axis\": \"x\", \"value\": 1e300, \"a\": 0}",
    b"POST /tune HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999999\r\n\r\n" + b"x" * (5 << 20),
    b"GET /../../etc HTTP/1.1\r\nHost: x\r\n\r\n",
    b"POST /mode HTTP/1.1\r\nContent-Length: -1\r\n\r\n",
    bytes(range(256)) * 16,
)  # fmt: skip


def reload_storm(bench: Bench) -> Outcome:
    """Send SIGHUP a hundred times, with valid and invalid files in turn."""
    valid = bench.config.read_text()
    variants = (valid.replace("position_um = 60.0", "position_um = 59.0"), valid.replace("rate_hz", "rat_hz"), valid)
    bench.strike()
    for number in range(RELOADS):
        bench.config.write_text(variants[number % len(variants)])
        os.kill(bench.pid("service"), signal.SIGHUP)
        threading.Event().wait(0.02)
    refused = bench.log().count("reload refused")
    bench.config.write_text(variants[1])
    os.kill(bench.pid("service"), signal.SIGHUP)
    wait_for(lambda: bench.log().count("reload refused") > refused, "an invalid file that is refused")
    bench.config.write_text(valid)
    wait_for(lambda: not is_refused(bench, "/reload", {}), "a valid file that is accepted")
    bench.await_state("running")
    accepted, refused = bench.log().count("reloaded:"), bench.log().count("reload refused")
    return Outcome(note=f"{accepted} accepted, {refused} refused, of {RELOADS + 2} signals")


def flood(bench: Bench) -> Outcome:
    """Send requests without a pause from CLIENTS threads, and malformed bytes beside them."""
    answered, refused = [0] * CLIENTS, [0] * CLIENTS

    def send_requests(number: int) -> None:
        for count in range(REQUESTS):
            try:
                if count % 3:
                    bench.client.get("/status")
                else:
                    bench.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 60.0}})
                answered[number] += 1
            except RtloopError:
                refused[number] += 1

    threads = [threading.Thread(target=send_requests, args=(number,)) for number in range(CLIENTS)]
    bench.strike()
    for thread in threads:
        thread.start()
    for data in MALFORMED * 3:
        send_raw(bench.client.path, data)
    for thread in threads:
        thread.join()
    assert bench.await_state("running")["mode"] == "closed_loop"
    assert sum(answered) > CLIENTS * REQUESTS // 2, (answered, refused)
    return Outcome(note=f"{sum(answered)} requests answered, {sum(refused)} refused, {3 * len(MALFORMED)} malformed")


def send_raw(path: Path, data: bytes) -> None:
    """Send bytes to the socket and read an answer; the service may close the connection instead."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(0.5)
        connection.connect(str(path))
        try:
            connection.sendall(data)
            connection.recv(4096)
        except OSError:
            return


def hostile_clients(bench: Bench) -> Outcome:
    """Post /stop beside silent connections, hostile bodies, and controllers that take minutes to build."""
    with contextlib.ExitStack() as stack:
        bench.strike()
        for _ in range(SILENT):
            client = stack.enter_context(socket.socket(socket.AF_UNIX))
            client.settimeout(1.0)
            with contextlib.suppress(OSError):
                client.connect(str(bench.client.path))
        expensive = [(path, json.dumps(body).encode()) for path, body in EXPENSIVE.items()]
        requests = [*expensive, *hostile_requests(SEED, BODIES)]

        def send_requests(number: int) -> None:
            for path, body in requests[number::CLIENTS]:
                with contextlib.suppress(OSError, ValueError, IndexError):
                    exchange(bench.client.path, "POST", path, body)

        threads = [threading.Thread(target=send_requests, args=(number,)) for number in range(CLIENTS)]
        for thread in threads:
            thread.start()
        threading.Event().wait(1.0)
        began_s = time.monotonic()
        bench.strike(lambda: bench.client.post("/stop"))
        answered_ms = 1e3 * (time.monotonic() - began_s)
        bench.await_safe(STOPPED_MS, by_request=True)
        moved_ns = bench.output_record().moved_ns
        took_ms = max((moved_ns - bench.struck_ns) / 1e6, 0.0)  # A hostile body may have stopped the loop before.
        for thread in threads:
            thread.join()
    return Outcome(took_ms, note=f"/stop answered after {answered_ms:.0f} ms")


def second_instance(bench: Bench) -> Outcome:
    """Start a second service under the same name, and one under another name on the same board: both are refused."""
    other_config = bench.folder / "other.toml"
    other_config.write_text(bench.config.read_text().replace("[recording]", "[service]\nrestarts = 0\n[recording]")
                     .replace("/recordings", "/others"))  # fmt: skip
    bench.strike()
    codes = [bench.rtloop("serve", config).wait(TIMEOUT_S) for config in (bench.config, other_config)]
    assert codes == [69, 69], codes
    assert "another service uses this control socket" in bench.log()
    assert "another controller drives this board" in bench.log()
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) != 0
    assert bench.status()["state"] == "running"
    assert bench.status()["restarts"] == 0
    return Outcome()


def trip_and_reset(bench: Bench) -> Outcome:
    """Tighten an interlock until it trips, twice: start, mode and arm are refused until the reset."""
    took_ms = 0.0
    for allowed_ms in (FIRST_BUILT_MS, BUILT_MS):
        bench.strike(lambda: tune(bench, position_um=5.0))
        took_ms = max(took_ms, bench.await_safe(allowed_ms, by_request=True))
        bench.await_state("tripped", "position")
        for path, body in (("/start", {}), ("/mode", {"mode": "raw"}), ("/arm", {})):
            assert is_refused(bench, path, body), path
        tune(bench, position_um=60.0)
        bench.recover()
    return Outcome(took_ms)


def tune(bench: Bench, **values: float) -> None:
    """Post new limits of the interlocks."""
    bench.client.post("/tune", {"axis": "x", "section": "interlocks", "values": values})


def is_refused(bench: Bench, path: str, body: dict) -> bool:
    """Post a request and return whether the service refuses it."""
    try:
        bench.client.post(path, body)
    except RtloopError:
        return True
    return False


def stopped_under_drive(bench: Bench) -> Outcome:
    """Send SIGTERM while the loop drives: the output ramps to 0 V."""
    assert bench.service is not None
    service = bench.service
    bench.strike(service.terminate)
    took_ms = bench.await_safe(2 * AT_ONCE_MS)
    wait_for(lambda: service.poll() is not None, "an end")
    return Outcome(took_ms)


def stopped_again_and_again(bench: Bench) -> Outcome:
    """Send four stop signals in a row, the last three while the loop ramps down and the recorder finishes its file."""
    assert bench.service is not None
    service = bench.service
    bench.strike(service.terminate)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGTERM):
        time.sleep(STOPS_APART_S)
        service.send_signal(number)
    took_ms = bench.await_safe(2 * AT_ONCE_MS)
    wait_for(lambda: service.poll() is not None, "an end")
    return Outcome(took_ms)


FAULTS = (
    Fault("reload storm", "valid files accepted, invalid ones refused", reload_storm),
    Fault("API flood and nonsense", "answered or refused; the loop runs on", flood),
    Fault("silent connections, hostile bodies", "/stop is answered and carried out", hostile_clients),
    Fault("two instances", "the second is refused, twice", second_instance),
    Fault("operator trips and resets", "refused until the reset", trip_and_reset),
    Fault("SIGTERM under drive", "ramp, whole recording, exit 0", stopped_under_drive),
    Fault("stop signals in a row", "as one signal: ramp, whole recording, exit 0", stopped_again_and_again),
)
