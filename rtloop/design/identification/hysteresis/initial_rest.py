"""Features of a recording that begins at rest: initial loading curve and major loop."""

from __future__ import annotations

import numpy as np

from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData, jumps
from rtloop.hysteresis.plays import turning_points
from rtloop.values import count_text

REST_SHARE = 0.02
"""A recording starts from rest where its first drive is at most this fraction of the largest."""


def begins_at_rest(run: AxisRecording) -> bool:
    """Whether the first |drive| is at most REST_SHARE of the largest and the drive turns back at least twice by half of
    its range, which completes the major loop: `identify_hysteresis` requires both.
    """
    turns = turning_points(run.drive_v, 0.5 * float(np.ptp(run.drive_v)))
    return abs(run.drive_v[0]) <= REST_SHARE * float(np.abs(run.drive_v).max()) and turns.size >= 2


def require_loop(run: AxisRecording) -> None:
    """Raise UnsuitableData for a first |drive| above REST_SHARE of the largest, and for a drive that turns back fewer
    than two times by half of its range.
    """
    drive, largest_v = run.drive_v, float(np.abs(run.drive_v).max())
    if abs(drive[0]) > REST_SHARE * largest_v:
        raise UnsuitableData(
            f"{run.name}: the drive starts at {drive[0]:g} V, so that the actuator's memory is not known. Record "
            "from rest, with a drive that starts at 0 V"
        )
    turns = turning_points(drive, 0.5 * float(np.ptp(drive)))
    if turns.size < 2:
        raise UnsuitableData(
            f"{run.name}: too little excitation: the drive turns back {count_text(turns.size, 'time')}; allowed: at "
            "least 2 times (one and a half periods of a sine give the major loop)"
            + (". For a step, use `rtloop identify dynamics`" if jumps(run) else "")
        )
