"""What a panel with four clients costs a paced run; a quiet machine and real-time rights are needed.

Of one service on the simulated rig, in pairs that alternate: SECONDS with nobody looking, SECONDS with four clients at
the fastest time base. Lateness is read from the recording, the panel's CPU time from the kernel, bytes from the socket.
The clients are on this machine as well, and cost as much as the panel; --cpu N gives a processor to the loop alone,
and what is left to panel and clients. --pages has four pages of Chromium look instead, drawing without a graphics card.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from rtloop import load
from tests.faults.bench import Bench
from tests.panel.page.browser import launched, opened
from tests.panel.web.browser import Browser, unpacked
from tests.paper_configuration import TEXT

CLIENTS, PAIRS, SECONDS = 4, 10, 10.0
ALLOWED = 1.1
"""p99 with clients against none."""
REST_S = 1.0
TRIGGER = {"mode": "auto", "kind": "edge", "source": "x_reference_um", "level": 0.0}
STEPS, FASTEST = 20, "1.0 ms"
"""As often as "shorter" is pressed, and what the page then says of the time of a screen."""
WISHES = {
    "view": {"signals": ["x_reference_um", "x_position_um", "x_drive_v", "x_error_um"],
             "seconds": 0.001, "pixels": 1200, "trigger": TRIGGER},
    "spectrum": {"signal": "x_position_um"},
    "timing": True,
}  # fmt: skip


class Clients:
    """Four that take all that they are sent, while they are there."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self.frames: dict[str, list[int]] = {}

    @contextmanager
    def looking(self) -> Iterator[None]:
        """While they do."""
        with ExitStack() as stack:
            streams = [stack.enter_context(self._browser.live(WISHES)) for _ in range(CLIENTS)]
            threads = [threading.Thread(target=self._take, args=(one,), daemon=True) for one in streams]
            for thread in threads:
                thread.start()
            yield

    def _take(self, live: Any) -> None:
        for message in live:
            self.frames.setdefault(unpacked(message)[0]["kind"], []).append(len(message))


class Pages:
    """Four windows of a real browser, each at the fastest time base."""

    def __init__(self, browser: Browser, chromium: Any) -> None:
        self._address, self._chromium = f"{browser.origin}/#token={browser.token}", chromium
        self.frames: dict[str, list[int]] = {}

    @contextmanager
    def looking(self) -> Iterator[None]:
        """While they are open."""
        pages = [opened(self._chromium, self._address) for _ in range(CLIENTS)]
        for page in pages:
            for _ in range(STEPS):
                page.click("#shorter")
            assert page.inner_text("#seconds").strip() == FASTEST
        yield
        for page in pages:
            page.context.close()


def cpu_s(pid: int) -> float:
    """That a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measured(folder: Path, pairs: int, seconds: float, cpu: int | None, pages: bool) -> dict[str, Any]:
    """Lateness with and without, in µs, and what the panel used."""
    spans: list[tuple[bool, int, int]] = []
    used_s = {False: 0.0, True: 0.0}
    text = TEXT.replace('folder = "recordings"', f'folder = "{folder}/recordings"')
    if cpu is not None:
        text = text.replace("[loop]\n", f"[loop]\ncpu = {cpu}\n", 1)
        os.sched_setaffinity(0, os.sched_getaffinity(0) - {cpu})  # and of all that is started, but for the loop
    with ExitStack() as stack:
        bench = stack.enter_context(Bench(folder, board=False, text=text))
        browser = Browser(bench)
        browser.log_in()
        clients = Pages(browser, stack.enter_context(launched())) if pages else Clients(browser)
        for number in range(2 * pairs):
            looks = (number + number // 2) % 2 == 1  # none, four, four, none: a drift counts for both
            with clients.looking() if looks else nullcontext():
                time.sleep(REST_S)
                first, before_s = bench.ticks, cpu_s(browser.process.pid)
                time.sleep(seconds)
                spans.append((looks, first, bench.ticks))
                used_s[looks] += cpu_s(browser.process.pid) - before_s
        status = bench.status()
        assert bench.stop() == 0
    recording = load(sorted((folder / "recordings").glob("*.mcap")))
    tick, late_us = (recording[name] for name in ("tick", "lateness_us"))
    found: dict[str, Any] = {"rate_hz": recording.header["rate_hz"], "ticks_lost": status["recording"]["ticks_lost"]}
    for looks, name in ((False, "none"), (True, "four")):
        parts = [late_us[(tick >= first) & (tick < end)] for with_clients, first, end in spans if with_clients is looks]
        quantiles = np.array([np.quantile(part, [0.5, 0.99]) for part in parts])
        p50_us, p99_us = np.median(quantiles, axis=0).tolist()
        cpu_percent = 100 * used_s[looks] / (pairs * seconds)
        found[name] = {"p50_us": p50_us, "p99_us": p99_us, "max_us": max(float(part.max()) for part in parts),
                       "panel_cpu_percent": cpu_percent, "p99_us_of_each": quantiles[:, 1].tolist()}  # fmt: skip
    found["p99_ratio"] = found["four"]["p99_us"] / found["none"]["p99_us"]
    found["frames"] = {
        kind: {
            "bytes": float(np.mean(sizes)),
            "a_second_and_client": len(sizes) / (CLIENTS * pairs * (seconds + REST_S)),
        }
        for kind, sizes in sorted(clients.frames.items())
    }
    return found


def main() -> int:
    """The verdict as an exit code; figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=PAIRS)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--cpu", type=int, help="Of the loop alone.")
    parser.add_argument("--pages", action="store_true", help="Of a real browser; `make tools` installs it.")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = measured(Path(folder), options.pairs, options.seconds, options.cpu, options.pages)
    print(json.dumps(found, indent=2))
    return 0 if found["p99_ratio"] <= ALLOWED and not found["ticks_lost"] else 1


if __name__ == "__main__":
    sys.exit(main())
