"""A service under slow and hostile clients, while an operator stops and starts it. `make soak NAME=connections`.

Thousands of connections send nothing, or a byte a second. Other clients send every hostile value in every place of
every request, and tables that are FIFOs. Meanwhile `/stop` and `/start` alternate; no stop may be refused.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import socket
import statistics
import tempfile
import threading
import time
from pathlib import Path

from rtloop.errors import RtloopError
from tests.faults.account import account
from tests.faults.bench import Bench
from tests.service.hostile import EXPENSIVE, HOSTILE, requests_with_each_value
from tests.service.http import exchange

STOPS_S = 0.5
"""Pause (s) before the next stop and start."""
WORKERS = 4


def hold_connections(path: Path, end: threading.Event, count: int, period_s: float) -> None:
    """Hold `count` connections until `end` is set; reopen closed ones. Every other sends a byte in `period_s`."""
    with contextlib.ExitStack() as stack:
        clients: list[socket.socket | None] = [None] * count
        head, number = b"POST /stop HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\n\r\n{}", 0
        while not end.is_set():
            for index, client in enumerate(clients):
                try:
                    if client is None:
                        client = clients[index] = stack.enter_context(socket.socket(socket.AF_UNIX))
                        client.settimeout(0.5)
                        client.connect(str(path))
                    if index % 2:
                        client.send(head[number % 20 : number % 20 + 1])
                except OSError:
                    if client is not None:
                        client.close()
                    clients[index] = None
            number += 1
            end.wait(period_s)


def send_hostile_requests(path: Path, end: threading.Event, answers: dict[int, int], worker: int) -> None:
    """Send this worker's share of the hostile requests again and again; count the status codes in `answers`.

    Code 0 counts requests without a valid answer.
    """
    while not end.is_set():
        requests = [
            *requests_with_each_value(HOSTILE),
            *((resource, json.dumps(body).encode()) for resource, body in EXPENSIVE.items()),
        ]
        fifo = ("/reference", b'{"axis": "x", "reference": {"kind": "table", "file": "fifo"}}')
        for number, (resource, body) in enumerate([*requests, *[fifo] * 40]):
            if end.is_set() or number % WORKERS != worker:
                continue
            try:
                code, _ = exchange(path, "POST", resource, body)
            except (OSError, ValueError, IndexError):
                code = 0
            answers[code] = answers.get(code, 0) + 1


def rss_mib(pid: int) -> float:
    """Return the resident memory (MiB) of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    """Run and print durations of stops, answers and memory.

    Raises AssertionError if a stop was refused, the service failed or a request was answered with status 500.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--connections", type=int, default=2000)
    options = parser.parse_args()
    end, answers, stops_ms, refusals, largest_mib = threading.Event(), {}, [], [], 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Bench(folder) as bench:
            os.mkfifo(folder / "fifo")
            path, before_mib = bench.client.path, rss_mib(bench.pid("service"))
            threads = [
                threading.Thread(target=hold_connections, args=(path, end, options.connections // 2, 1.0))
                for _ in range(2)
            ]
            threads += [
                threading.Thread(target=send_hostile_requests, args=(path, end, answers, worker))
                for worker in range(WORKERS)
            ]
            for thread in threads:
                thread.start()
            end_s = time.monotonic() + options.seconds
            while time.monotonic() < end_s:
                for resource in ("/stop", "/reset", "/start"):
                    begin_s = time.monotonic()
                    try:
                        bench.client.post(resource)
                    except RtloopError as error:
                        if resource == "/stop":  # /reset may find no trip, and /start a running loop.
                            refusals.append(str(error))
                    if resource == "/stop":
                        stops_ms.append(1e3 * (time.monotonic() - begin_s))
                largest_mib = max(largest_mib, rss_mib(bench.pid("service")))
                end.wait(STOPS_S)
            end.set()
            for thread in threads:
                thread.join()
            bench.client.post("/stop")
            code, lost = bench.stop(), account(folder / "recordings", bench.blocks).lost
            log = bench.log()
    print(f"{len(stops_ms)} stops: median {statistics.median(stops_ms):.1f} ms, worst {max(stops_ms):.1f} ms")
    print(f"answers: {dict(sorted(answers.items()))} (0: no valid answer)")
    print(f"memory of the service: {before_mib:.0f} MiB before, at most {largest_mib:.0f} MiB; ticks lost: {lost}")
    assert code == 0, log[-2000:]
    assert not refusals, refusals[:5]
    assert 500 not in answers
    assert "Traceback" not in log, log[-2000:]


if __name__ == "__main__":
    main()
