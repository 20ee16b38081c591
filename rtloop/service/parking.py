"""Parking: bring outputs to their safe values without the loop, ramping from the last known drive."""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.base import Driver, Wiring, index_of
from drivers.errors import DriverError
from rtloop.config import load
from rtloop.engine.memory import SharedBlock
from rtloop.prepare import prepare
from rtloop.service.paths import block_path

_WRITE = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p)
RAMP_PERIOD_S = 0.001
BUSY_TIMEOUT_S, BUSY_POLL_S = 3.0, 0.05


def park_configuration(config: Path) -> str:
    """Park the outputs of a configuration in place of a service that died; what was done, in words.

    The last drive comes from the service's shared block. Where there is none, nobody knows it, and the outputs go to
    their safe values at once. Raises ConfigError, DriverError.
    """
    configuration = load(config)
    plan = prepare(configuration).plan
    slew = float(np.min(plan.coefficients["trip_slew_v_per_tick"])) * plan.pacing.rate_hz
    last_v = _last_drive(block_path(configuration), len(plan.axes))
    deadline_s = time.monotonic() + BUSY_TIMEOUT_S
    while True:
        driver = plan.driver()
        try:
            park(driver, plan.wiring, plan.axes, [0.0] * len(plan.axes) if last_v is None else last_v, slew)
        except DriverError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(BUSY_POLL_S)  # a loop without its supervisor still ramps down by itself
            continue
        start = "an unknown drive" if last_v is None else ", ".join(f"{value:.3f} V" for value in last_v)
        return f"{configuration.name}: parked from {start}"


def _last_drive(path: Path, axes: int) -> list[float] | None:
    """The last drive in a service's shared block; None where there is no such block."""
    try:
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        last_v = SharedBlock.attach(fd, lambda: True)["last_drive_v"].tolist()
    except EOFError:
        return None
    finally:
        os.close(fd)
    return last_v if len(last_v) == axes else None


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
    """Ramp every axis from `last_drive_v` to its safe value, then close the driver. Raises DriverError."""
    outputs = driver.facts.outputs
    safe_v = np.array([channel.safe_v for channel in outputs])
    last_v = safe_v.copy()
    for axis, drive_v in zip(axes, last_drive_v, strict=True):
        last_v[index_of(outputs, wiring[axis].output)] = drive_v
    pointers = driver.open()
    try:
        write = _WRITE(pointers.write)
        for row in ramp(last_v, safe_v, slew_v_per_s * RAMP_PERIOD_S):
            values = np.ascontiguousarray(row)
            if write(pointers.context, values.ctypes.data) < 0:
                raise DriverError(f"{driver.kind}: write failed while parking at {row.tolist()} V")
            time.sleep(RAMP_PERIOD_S)
    finally:
        driver.close()
