"""A service under clients that mean it no good, and an operator who stops and starts it. `make soak NAME=connections`.

Thousands of connections that say nothing or a byte a second, every hostile value in every place of every request,
tables that are FIFOs: meanwhile `/stop` and `/start` go round, and how long a stop takes is what counts.
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
from tests.service.hostile import EXPENSIVE, HOSTILE, every
from tests.service.http import exchange

STOPS_S = 0.5
WORKERS = 4


def silent(path: Path, over: threading.Event, count: int, each_s: float) -> None:
    """`count` connections; each gets a byte of a request in `each_s`, and is replaced when it is closed."""
    with contextlib.ExitStack() as stack:
        clients: list[socket.socket | None] = [None] * count
        head, number = b"POST /stop HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\n\r\n{}", 0
        while not over.is_set():
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
            over.wait(each_s)


def hostile(path: Path, over: threading.Event, answers: dict[int, int], lot: int) -> None:
    """Every hostile request of this worker's share, again and again."""
    while not over.is_set():
        requests = [*every(HOSTILE), *((path_, json.dumps(body).encode()) for path_, body in EXPENSIVE.items())]
        fifo = ("/reference", b'{"axis": "x", "reference": {"kind": "table", "file": "fifo"}}')
        for number, (resource, body) in enumerate([*requests, *[fifo] * 40]):
            if over.is_set() or number % WORKERS != lot:
                continue
            try:
                code, _ = exchange(path, "POST", resource, body)
            except (OSError, ValueError, IndexError):
                code = 0
            answers[code] = answers.get(code, 0) + 1


def rss_mib(pid: int) -> float:
    """Memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    """Run, print, and fail where a stop was refused, the service died or a request was answered by a 500."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--connections", type=int, default=2000)
    given = parser.parse_args()
    over, answers, stops_ms, failed, largest_mib = threading.Event(), {}, [], [], 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Bench(folder) as bench:
            os.mkfifo(folder / "fifo")
            path, before_mib = bench.client.path, rss_mib(bench.pid("service"))
            threads = [
                threading.Thread(target=silent, args=(path, over, given.connections // 2, 1.0)) for _ in range(2)
            ]
            threads += [threading.Thread(target=hostile, args=(path, over, answers, lot)) for lot in range(WORKERS)]
            for thread in threads:
                thread.start()
            end_s = time.monotonic() + given.seconds
            while time.monotonic() < end_s:
                for resource in ("/stop", "/reset", "/start"):
                    began_s = time.monotonic()
                    try:
                        bench.client.post(resource)
                    except RtloopError as error:
                        if resource == "/stop":  # there is nothing to reset, and what is stopped starts again
                            failed.append(str(error))
                    if resource == "/stop":
                        stops_ms.append(1e3 * (time.monotonic() - began_s))
                largest_mib = max(largest_mib, rss_mib(bench.pid("service")))
                over.wait(STOPS_S)
            over.set()
            for thread in threads:
                thread.join()
            bench.client.post("/stop")
            code, lost = bench.stop(), account(folder / "recordings", bench.blocks).lost
            log = bench.log()
    print(f"{len(stops_ms)} stops: median {statistics.median(stops_ms):.1f} ms, worst {max(stops_ms):.1f} ms")
    print(f"answers: {dict(sorted(answers.items()))} (0: hung up)")
    print(f"memory of the service: {before_mib:.0f} MiB before, at most {largest_mib:.0f} MiB; ticks lost: {lost}")
    assert code == 0, log[-2000:]
    assert not failed, failed[:5]
    assert 500 not in answers
    assert "Traceback" not in log, log[-2000:]


if __name__ == "__main__":
    main()
