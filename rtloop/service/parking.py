"""Parking: bring outputs to their safe values without the loop, ramping from the last known drive."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.base import Driver, Wiring, index_of
from drivers.errors import DriverError
from rtloop.config import load
from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import UnavailableError
from rtloop.prepare import prepare
from rtloop.service.paths import block_path, open_block

_WRITE = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p)
SHORTEST_PERIOD_S = 0.0001
"""The ramp takes its steps at the loop's rate, like the loop's own, but no faster than an interpreter can."""
POLL_S = 0.005
KILL_S = 5.0
MARGIN_S = 2.0
"""Beyond what a loop without its supervisor needs, before it is taken to stand still."""


def park_configuration(config: Path) -> str:
    """Park the outputs of a configuration in place of a service that died; what was done, in words.

    A loop that outlived its service is given the time to ramp down by itself, and killed if it does not. The last
    drive comes from the service's shared block. Where there is none, nobody knows it, and the outputs go to their
    safe values at once. Raises ConfigError, DriverError, UnavailableError while the service is alive.
    """
    configuration = load(config)
    plan = prepare(configuration).plan
    slew = float(np.min(plan.coefficients["trip_slew_v_per_tick"])) * plan.pacing.rate_hz
    last_v: list[float] | None = None
    with _last_block(block_path(configuration)) as block:
        if block is not None:
            _await_end(block, plan.pacing.heartbeat_timeout_s, slew)
            last_v = block["last_drive_v"].tolist()
    if last_v is None or len(last_v) != len(plan.axes):
        start, last_v = "an unknown drive", [0.0] * len(plan.axes)
    else:
        start = ", ".join(f"{value:.3f} V" for value in last_v)
    park(plan.driver(), plan.wiring, plan.axes, last_v, slew)
    return f"{configuration.name}: parked from {start}"


@contextmanager
def _last_block(path: Path) -> Iterator[SharedBlock | None]:
    """A service's shared block; None where there is none."""
    fd = open_block(path)
    if fd is None:
        yield None
        return
    try:
        block = None
        with suppress(EOFError):  # its service died before there was anything in it
            block = SharedBlock.attach(fd, lambda: True)
        yield block
    finally:
        os.close(fd)


def _await_end(block: SharedBlock, heartbeat_timeout_s: float, slew_v_per_s: float) -> None:
    """Wait until nobody drives any more. Raises UnavailableError while a service is alive, DriverError."""
    ramp_s = float(np.max(np.abs(block["last_drive_v"]))) / slew_v_per_s
    beat_ns = int(block.words[Word.HEARTBEAT_NS])
    kill_s = time.monotonic() + heartbeat_timeout_s + ramp_s + MARGIN_S
    while (pid := block.driven_by()) is not None:
        if int(block.words[Word.HEARTBEAT_NS]) != beat_ns:
            raise UnavailableError(f"process {pid} drives the outputs and its service is alive; stop that instead")
        if time.monotonic() > kill_s + KILL_S:
            raise DriverError(f"process {pid} drives the outputs and cannot be killed")
        if time.monotonic() > kill_s:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(POLL_S)


def ramp(
    last_v: npt.NDArray[np.float64], safe_v: npt.NDArray[np.float64], step_v: float
) -> list[npt.NDArray[np.float64]]:
    """Rows from `last_v` (exclusive) to `safe_v` (inclusive), no value moving by more than `step_v` a row."""
    rows = []
    now_v = last_v
    while not np.array_equal(now_v, safe_v):
        now_v = np.clip(safe_v, now_v - step_v, now_v + step_v)
        rows.append(now_v)
    return rows


def park(
    driver: Driver,
    wiring: Mapping[str, Wiring],
    axes: Sequence[str],
    last_drive_v: Sequence[float],
    slew_v_per_s: float,
) -> None:
    """Ramp every axis from `last_drive_v` to its safe value, then close the driver. Raises DriverError.

    A card with a watchdog of its own is no longer where it was: it has gone to its safe values, or is on its way.
    """
    outputs, parks_itself = driver.facts.outputs, driver.facts.hardware_watchdog
    safe_v = np.array([channel.safe_v for channel in outputs])
    last_v = safe_v.copy()
    for axis, drive_v in zip(axes, last_drive_v, strict=True):
        last_v[index_of(outputs, wiring[axis].output)] = drive_v
    pointers = driver.open()
    try:
        write = _WRITE(pointers.write)
        period_s = max(1.0 / driver.rate_hz, SHORTEST_PERIOD_S)
        for row in [] if parks_itself else ramp(last_v, safe_v, slew_v_per_s * period_s):
            values = np.ascontiguousarray(row)
            if write(pointers.context, values.ctypes.data) < 0:
                raise DriverError(f"{driver.kind}: write failed while parking at {row.tolist()} V")
            time.sleep(period_s)
    finally:
        driver.close()
