"""Scheduled retuning of the input taps with `rtloop ctl retune`, for axes whose configuration has [axis.adapt].

The command runs in a separate process and measures resonance and gain through the control API. The service refuses it
unless the axis runs in closed loop at a setpoint.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rtloop.configuration.axis import AdaptOptions
from rtloop.foundation import timing
from rtloop.foundation.children import child_environment, python_command
from rtloop.service.background import repeat_every
from rtloop.service.service import Service, State

log = logging.getLogger(__name__)
RETUNE_TIMEOUT_S = 600.0
LOOK_PERIOD_S = 1.0
NICENESS = 10
CommandRunner = Callable[[Sequence[str]], subprocess.CompletedProcess[str]]


def run_adaptation(service: Service, socket: Path) -> contextlib.AbstractContextManager[None]:
    """Return a context manager: during the work within, a thread retunes each axis with [axis.adapt] when it is due.

    `socket` is the path of the service's control socket.
    """
    schedule = RetuneSchedule(service, socket)
    return repeat_every(LOOK_PERIOD_S, lambda: schedule.retune_due_axes(timing.monotonic_s()))


def _run_at_low_priority(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a command at low CPU priority until it ends. Returns its exit code, stdout and stderr as text.

    Raises OSError, and TimeoutExpired after RETUNE_TIMEOUT_S, which kills it.
    """
    pipe, environment = subprocess.PIPE, child_environment()
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=environment) as process:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, process.pid, NICENESS)
        try:
            stdout, stderr = process.communicate(timeout=RETUNE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    return subprocess.CompletedProcess(command, process.returncode, stdout, stderr)


class RetuneSchedule:
    """Schedule of the axes with [axis.adapt]: an axis is due `every_s` after the loop was first seen running, then
    `every_s` after each attempt.

    `socket` is the path of the service's control socket. `run_command` runs a command until it ends and returns its
    exit code, stdout and stderr; it may raise OSError or TimeoutExpired.
    """

    def __init__(self, service: Service, socket: Path, run_command: CommandRunner = _run_at_low_priority) -> None:
        """Prepare the schedule; no axis is due before its first interval has passed.

        `run_command` runs a command line until it ends, as `_run_at_low_priority` does.
        """
        self._service, self._socket, self._run = service, socket, run_command
        self._interval_start_s: dict[str, float] = {}

    def retune_due_axes(self, now_s: float) -> None:
        """Retune the axes that are due at the monotonic time `now_s`, one after another, and wait for each.

        The interval of an axis begins at the first call in the state "running", and at each attempt. A call in any
        other state ends all intervals; they begin again at the next call in the state "running".
        """
        if self._service.state is not State.RUNNING:
            self._interval_start_s.clear()
            return
        for axis in self._service.configuration.axes:
            if axis.adapt is None:
                continue
            if now_s - self._interval_start_s.setdefault(axis.name, now_s) >= axis.adapt.every_s:
                self._interval_start_s[axis.name] = now_s
                self._retune(axis.name, axis.adapt)

    def _retune(self, axis: str, options: AdaptOptions) -> None:
        """Run `rtloop ctl retune` for an axis, wait for its end, and log the result or the failure."""
        command = python_command("rtloop", "ctl", "--socket", self._socket, "retune", axis, "--yes", "--json")
        for name in ("amplitude_um", "gain_um", "bound_percent", "within_percent"):
            command += [f"--{name.replace('_', '-')}", repr(getattr(options, name))]
        try:
            process = self._run(command)
            report = json.loads(process.stdout or "{}")
        except (OSError, ValueError, subprocess.TimeoutExpired) as error:  # ValueError: it was killed while it printed.
            log.warning("axis %s is not retuned: %s", axis, error)
            return
        if "better" in report:
            try:
                log.info("axis %s %s", axis, _outcome_text(report))
            except (LookupError, TypeError) as error:  # Another version of rtloop may have been installed meanwhile.
                log.warning(
                    "axis %s: the result of `rtloop ctl retune` cannot be read (%r), because another version of rtloop "
                    "printed it; restart the service",
                    axis,
                    error,
                )
        else:
            log.warning("axis %s is not retuned: %s", axis, process.stderr.strip().removeprefix("rtloop: "))


def _outcome_text(report: dict[str, Any]) -> str:
    """Return the result of a retuning in words; `report` is the decoded output of `rtloop ctl retune --json`."""
    hz, percent, gain = report["resonance"]["hz"], report["percent_from_model"], report["gain"]
    measured = f"resonance {hz:.2f} Hz, {percent:+.2f} % from the model's"
    if gain is not None:
        gain_percent = report["gain_percent_from_model"]
        gain_text = "too uncertain" if gain_percent is None else f"{gain_percent:+.2f} % from the model's"
        measured += f"; gain {gain['value']:.4f} ± {gain['std']:.4f} (standard deviation), {gain_text}"
    if report["tick"] is None:
        return f"keeps its taps: {measured}; new taps would be no better"
    return f"retuned: {measured}; at tick {report['tick']}"
