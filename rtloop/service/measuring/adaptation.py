"""Taps made anew on a schedule, by consent of the configuration: `rtloop ctl retune`, as somebody at the desk would.

The command measures resonance and gain through the control API, works beside the loop in a process of its own, and is
refused by the service where the loop does not run in closed loop about a reference that it holds.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rtloop.configuration.axis import AdaptOptions
from rtloop.service.service import Service, State

log = logging.getLogger(__name__)
LONGEST_S = 600.0
LOOK_S = 1.0
NICE = 10
Run = Callable[[Sequence[str]], subprocess.CompletedProcess[str]]


@contextlib.contextmanager
def adapting(service: Service, socket: Path) -> Iterator[None]:
    """Retune every axis whose configuration says so, whenever it is due, for as long as the service runs."""
    end_event = threading.Event()
    thread = threading.Thread(target=_watch, args=(service, socket, end_event), daemon=True)
    thread.start()
    try:
        yield
    finally:
        end_event.set()


def _watch(service: Service, socket: Path, ended: threading.Event) -> None:
    schedule = Schedule(service, socket)
    while not ended.wait(LOOK_S):
        schedule.look(time.monotonic())


def _beside(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """With less right to the processors than whatever else runs."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, process.pid, NICE)
        try:
            stdout, stderr = process.communicate(timeout=LONGEST_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    return subprocess.CompletedProcess(command, process.returncode, stdout, stderr)


class Schedule:
    """When each axis is due: `every_s` after the loop was seen running first, and after each time that it was tried."""

    def __init__(self, service: Service, socket: Path, run: Run = _beside) -> None:
        self._service, self._socket, self._run = service, socket, run
        self._since_s: dict[str, float] = {}

    def look(self, now_s: float) -> None:
        """Retune what is due, unless the loop does not run; a trip begins the waiting anew."""
        if self._service.state is not State.RUNNING:
            self._since_s.clear()
            return
        for axis in self._service.configuration.axes:
            if axis.adapt is None:
                continue
            if now_s - self._since_s.setdefault(axis.name, now_s) >= axis.adapt.every_s:
                self._since_s[axis.name] = now_s
                self._retune(axis.name, axis.adapt)

    def _retune(self, axis: str, options: AdaptOptions) -> None:
        ctl = [sys.executable, "-m", "rtloop", "ctl", "--socket", str(self._socket)]
        command = [*ctl, "retune", axis, "--yes", "--json"]
        for name in ("amplitude_um", "gain_um", "bound_percent", "within_percent"):
            command += [f"--{name.replace('_', '-')}", repr(getattr(options, name))]
        try:
            process = self._run(command)
        except (OSError, subprocess.TimeoutExpired) as error:
            log.warning("axis %s is not retuned: %s", axis, error)
            return
        report = json.loads(process.stdout or "{}")
        if "better" in report:
            log.info("axis %s %s", axis, _outcome(report))
        else:
            log.warning("axis %s is not retuned: %s", axis, process.stderr.strip().removeprefix("rtloop: "))


def _outcome(answer: dict[str, Any]) -> str:
    """Say in words what a retuning measured and did; `answer` is that of `ctl retune --json`."""
    hz, percent, gain = answer["resonance"]["hz"], answer["percent_from_model"], answer["gain"]
    measured = f"resonance {hz:.2f} Hz, {percent:+.2f} % from the model's"
    if gain is not None:
        gain_percent = answer["gain_percent_from_model"]
        gain_text = "too uncertain" if gain_percent is None else f"{gain_percent:+.2f} % from the model's"
        measured += f"; gain {gain['value']:.4f} ± {gain['std']:.4f}, {gain_text}"
    if answer["tick"] is None:
        return f"keeps its taps: {measured}; new ones would be no better"
    return f"retuned: {measured}; at tick {answer['tick']}"
