"""Parking: bring outputs to their safe values without the loop, ramping from the last known drive."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from drivers.base import Driver, Wiring, index_of
from drivers.errors import DriverError

_WRITE = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p)
RAMP_PERIOD_S = 0.001


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
