"""Lateness of a paced run beside a panel with four clients; a quiet machine and real-time rights are needed.

One service on the simulated rig, in alternating pairs: SECONDS without clients, SECONDS with four clients at the
fastest time base. Lateness is read from the recording, the panel's CPU time from the kernel, bytes from the socket.
The clients run on this machine too, and cost as much as the panel; --cpu N reserves a processor for the loop, and
leaves the others to panel and clients. --pages opens four pages of Chromium instead, drawn without a graphics card.
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
from tests.panel.page.browser import launch_browser, open_panel
from tests.panel.web.browser import Browser, unpack_message
from tests.paper_configuration import TEXT

CLIENTS, PAIRS, SECONDS = 4, 10, 10.0
ALLOWED_RATIO = 1.1
"""Allowed p99 of the lateness with clients, in units of the p99 without."""
REST_S = 1.0
TRIGGER = {"mode": "auto", "kind": "edge", "source": "x_reference_um", "level": 0.0}
STEPS, FASTEST = 20, "1.0 ms"
"""Clicks on "shorter", and the time of a screen that the page then shows."""
SUBSCRIPTIONS = {
    "view": {"signals": ["x_reference_um", "x_position_um", "x_drive_v", "x_error_um"],
             "seconds": 0.001, "pixels": 1200, "trigger": TRIGGER},
    "spectrum": {"signal": "x_position_um"},
    "timing": True,
}  # fmt: skip


class Clients:
    """Four clients that read every frame; `frames` holds the sizes in bytes by kind."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self.frames: dict[str, list[int]] = {}

    @contextmanager
    def connected(self) -> Iterator[None]:
        """Connect the clients within the context."""
        with ExitStack() as stack:
            streams = [stack.enter_context(self._browser.live(SUBSCRIPTIONS)) for _ in range(CLIENTS)]
            threads = [threading.Thread(target=self._read_frames, args=(stream,), daemon=True) for stream in streams]
            for thread in threads:
                thread.start()
            yield

    def _read_frames(self, stream: Any) -> None:
        """Store the size of each frame of a stream, to its end."""
        for message in stream:
            self.frames.setdefault(unpack_message(message)[0]["kind"], []).append(len(message))


class Pages:
    """Four pages of a real browser, each at the fastest time base; `frames` stays empty."""

    def __init__(self, browser: Browser, chromium: Any) -> None:
        self._address, self._chromium = f"{browser.origin}/#token={browser.token}", chromium
        self.frames: dict[str, list[int]] = {}

    @contextmanager
    def connected(self) -> Iterator[None]:
        """Open the pages within the context."""
        pages = [open_panel(self._chromium, self._address) for _ in range(CLIENTS)]
        for page in pages:
            for _ in range(STEPS):
                page.click("#shorter")
            assert page.inner_text("#seconds").strip() == FASTEST
        yield
        for page in pages:
            page.context.close()


def cpu_s(pid: int) -> float:
    """Return the processor time (s) that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure_load(folder: Path, pairs: int, seconds: float, cpu: int | None, pages: bool) -> dict[str, Any]:
    """Return the lateness (µs) and the panel's processor load, with ("four") and without clients ("none")."""
    spans: list[tuple[bool, int, int]] = []
    used_s = {False: 0.0, True: 0.0}
    text = TEXT.replace('folder = "recordings"', f'folder = "{folder}/recordings"')
    if cpu is not None:
        text = text.replace("[loop]\n", f"[loop]\ncpu = {cpu}\n", 1)
        # All child processes inherit the set of processors; the loop alone moves to `cpu`.
        os.sched_setaffinity(0, os.sched_getaffinity(0) - {cpu})
    with ExitStack() as stack:
        bench = stack.enter_context(Bench(folder, board=False, text=text))
        browser = Browser(bench)
        browser.log_in()
        clients = Pages(browser, stack.enter_context(launch_browser())) if pages else Clients(browser)
        for number in range(2 * pairs):
            has_clients = (number + number // 2) % 2 == 1  # none, four, four, none: a drift affects both.
            with clients.connected() if has_clients else nullcontext():
                time.sleep(REST_S)
                first, before_s = bench.ticks, cpu_s(browser.process.pid)
                time.sleep(seconds)
                spans.append((has_clients, first, bench.ticks))
                used_s[has_clients] += cpu_s(browser.process.pid) - before_s
        status = bench.status()
        assert bench.stop() == 0
    recording = load(sorted((folder / "recordings").glob("*.mcap")))
    tick, lateness_us = (recording[name] for name in ("tick", "lateness_us"))
    figures: dict[str, Any] = {"rate_hz": recording.header["rate_hz"], "ticks_lost": status["recording"]["ticks_lost"]}
    for has_clients, name in ((False, "none"), (True, "four")):
        spans_us = [
            lateness_us[(tick >= first) & (tick < end)]
            for had_clients, first, end in spans
            if had_clients is has_clients
        ]
        quantiles = np.array([np.quantile(span_us, [0.5, 0.99]) for span_us in spans_us])
        p50_us, p99_us = np.median(quantiles, axis=0).tolist()
        cpu_percent = 100 * used_s[has_clients] / (pairs * seconds)
        figures[name] = {"p50_us": p50_us, "p99_us": p99_us,
                         "max_us": max(float(span_us.max()) for span_us in spans_us),
                         "panel_cpu_percent": cpu_percent, "p99_us_of_each": quantiles[:, 1].tolist()}  # fmt: skip
    figures["p99_ratio"] = figures["four"]["p99_us"] / figures["none"]["p99_us"]
    figures["frames"] = {
        kind: {
            "bytes": float(np.mean(sizes)),
            "a_second_and_client": len(sizes) / (CLIENTS * pairs * (seconds + REST_S)),
        }
        for kind, sizes in sorted(clients.frames.items())
    }
    return figures


def main() -> int:
    """Print the figures as JSON; return 1 if the p99 rises by more than ALLOWED_RATIO or a tick is lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=PAIRS)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--cpu", type=int, help="Processor of the loop alone.")
    parser.add_argument("--pages", action="store_true", help="Pages of a real browser; `make tools` installs it.")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = measure_load(Path(folder), options.pairs, options.seconds, options.cpu, options.pages)
    print(json.dumps(figures, indent=2))
    return 0 if figures["p99_ratio"] <= ALLOWED_RATIO and not figures["ticks_lost"] else 1


if __name__ == "__main__":
    sys.exit(main())
