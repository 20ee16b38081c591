"""Recorded signals for identification, and the checks that they are suitable."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from rtloop.errors import RtloopError
from rtloop.foundation.arrays import Real
from rtloop.foundation.trusted import open_user_file
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import Recording, load
from rtloop.signals import Mode, trip_causes

LEAST_SPAN_TO_NOISE = 50.0
"""Position must move by this many standard deviations of its noise."""
LEAST_TICKS = 100
LARGEST_ANTICORRELATION = -0.5
"""Correlation of position and drive below which the position falls as a slow drive rises."""
LEAST_TURNING = 0.1
"""Least share of a drive's variance without its straight line, for a sign: a ramp cannot be told from a drift."""
JUMP_SHARE = 0.2
"""A drive that changes by this fraction of its span within one tick jumps: it has a step, and is no slow sine."""
PLATEAU_DRIVE = 0.02
"""A reading constant at its extreme while the drive moves by more than this fraction of the drive's span is clipped."""
_TRIP_REMEDIES = {
    "sensor_range": "The sensor was at the end of its range: use a smaller drive, or a smaller step, because a lightly "
    "damped stage overshoots. Wider interlocks.sensor_min_v and sensor_max_v help only inside the converter's range.",
    "position": "Use a smaller drive or step, or a larger interlocks.position_um if the stage may move so far.",
    "oscillation": "Use a smaller drive or step, or a larger interlocks.oscillation_um if the stage may ring so far.",
    "frozen": "The reading stood still while the drive moved: check the sensor and its wires.",
}
_OTHER_REMEDY = "A smaller drive does not prevent this trip: see the cause in `rtloop info`, and record again."
"""Sentence that tells how to avoid a trip of any cause that `_TRIP_REMEDIES` lacks."""
PLATEAU_TICKS, PLATEAU_JUMP = 4, 10.0
"""A plateau of PLATEAU_TICKS or more is clipped too if a jump of PLATEAU_JUMP usual changes begins or ends it."""


class UnsuitableData(RtloopError):
    """Recorded data, or a model, that is unsuitable for the computation; the message names the reason and a remedy."""

    exit_code = 1


@dataclass(frozen=True)
class AxisRecording:
    """Drive and position of one axis, each (ticks,): the position of a tick was measured before its drive was written.

    An imported recording samples both together (`is_sampled_together`) unless it says that the position came first; its
    rows are shifted on reading, so that a drive acts on the next tick's position here too. `command_um` is NaN where it
    was not recorded. `is_even` says that no tick is missing or late by a period; `digest` is the SHA-256 of the
    recording's files. `time_s` (ticks,) is the time in s at which each tick was due, from an arbitrary origin; None
    stands for equal intervals.
    """

    name: str
    period_s: float
    drive_v: Real
    position_um: Real
    command_um: Real
    is_even: bool
    configuration: str
    digest: str
    time_s: Real | None = None
    is_closed_loop: bool = False
    """Whether a controller made the drive in some ticks; False where the modes were not recorded."""
    is_sampled_together: bool = False
    """Whether drive and position of a recorded row count as sampled at the same time."""

    @property
    def is_imported(self) -> bool:
        """Whether another program recorded the run, so that the drive before its first tick is unknown."""
        return not self.configuration

    @property
    def seconds(self) -> Real:
        """Times at which the ticks were due, in s (ticks,), from an arbitrary origin."""
        return self.period_s * np.arange(self.drive_v.size, dtype=np.float64) if self.time_s is None else self.time_s


def read_axis_recording(path: Path, axis: str | None = None) -> AxisRecording:
    """Read one axis of a recording (None: its only one).

    Raises RecordingError for a file that cannot be read, an unknown axis, None with several axes, and a recording
    without axes; UnsuitableData for a missing signal, fewer than LEAST_TICKS ticks, a trip, tick times that do not
    rise, and as `require_usable`.
    """
    recording = load(path)
    axis = select_axis(recording, axis, path)
    drive, position, deadlines = _signals(recording, path, f"{axis}_drive_v", f"{axis}_position_um", "deadline_ns")
    if drive.size < LEAST_TICKS:
        raise UnsuitableData(
            f"{path}: the recording has {drive.size} ticks; identification needs at least {LEAST_TICKS}"
        )
    if "flags" in recording:
        _require_untripped(path, recording["flags"])
    reading_name = f"{axis}_adc_v"
    readings = recording.read(reading_name)[0] if reading_name in recording else None
    require_usable(str(path), drive, position, readings)
    intervals = np.diff(deadlines)
    if not np.all(intervals > 0):
        raise UnsuitableData(
            f"{path}: the time of tick {int(np.argmax(intervals <= 0)) + 1} is not later than the time of the tick "
            "before"
        )
    period_ns = float(np.median(intervals))
    any_missed = "periods_missed" in recording and bool(np.any(recording["periods_missed"][1:]))
    is_even = not any_missed and bool(np.all(np.abs(intervals - period_ns) <= 1))
    command = f"{axis}_command_um"
    commands = recording[command] if command in recording else np.full(drive.size, np.nan)
    if shift := shifted_rows(recording):
        drive, commands, position, deadlines = drive[1:], commands[1:], position[:-1], deadlines[1:]
    return AxisRecording(
        str(path), period_ns * 1e-9, drive, position, commands, is_even, recording.configuration,
        _digest(recording.paths), deadlines * 1e-9,
        "mode" in recording and bool(np.any(recording["mode"] == Mode.CLOSED_LOOP)), bool(shift),
    )  # fmt: skip


def shifted_rows(recording: Recording) -> int:
    """Return the number of rows by which positions must move to later rows, so that a row's drive acts on the position
    of the next row: 1 or 0.

    It is 1 if drive and position of a row were sampled together: in an imported recording, unless its header says that
    the position was sampled before the drive changed. It is 0 for every other recording.
    """
    imported = recording.header.get("imported")
    return int(imported is not None and not imported.get("position_first", False))


def distinct(
    runs: Sequence[AxisRecording], other_runs: Sequence[AxisRecording] = ()
) -> tuple[list[AxisRecording], list[str]]:
    """Return the runs in their order, without those whose drive and position are in all ticks the same as in an
    earlier run or in one of `other_runs`, and a sentence for each omitted run.

    A copy of a recording is no independent evidence.
    """
    names = {_tick_digest(run): run.name for run in other_runs}
    retained, sentences = list[AxisRecording](), list[str]()
    for run in runs:
        digest = _tick_digest(run)
        if digest in names:
            sentences.append(f"{run.name}: not used, because it is a copy of {names[digest]}, with the same ticks")
        else:
            names[digest] = run.name
            retained.append(run)
    return retained, sentences


def _tick_digest(run: AxisRecording) -> str:
    """Return the SHA-256, in hex, of the drive and the position of every tick."""
    return hashlib.sha256(run.drive_v.tobytes() + run.position_um.tobytes()).hexdigest()


def _signals(recording: Recording, path: Path, *names: str) -> list[Real]:
    """Return named signals in full, each (ticks,), in the order of `names`.

    Raises UnsuitableData, with the missing names, if the recording lacks any of them.
    """
    missing = [name for name in names if name not in recording]
    if missing:
        raise UnsuitableData(f"{path}: signals that identification needs are missing: {', '.join(missing)}")
    return recording.read(*names)


def require_usable(name: str, drive_v: Real, position_um: Real, adc_v: Real | None) -> None:
    """Raise UnsuitableData for a drive or position that is not finite, a drive that does not move, a position that
    moves by less than LEAST_SPAN_TO_NOISE times its noise or not at all, and a clipped reading.

    `name` names the recording. `adc_v` (ticks,) is the reading; None for a recording without readings, in which the
    position is searched for clipping.
    """
    if not (np.all(np.isfinite(drive_v)) and np.all(np.isfinite(position_um))):
        raise UnsuitableData(f"{name}: drive or position contains NaN or infinite values; allowed: finite values")
    noise, span = noise_std(position_um), float(np.ptp(position_um))
    if np.ptp(drive_v) == 0:
        raise UnsuitableData(
            f"{name}: too little excitation: the drive stays at {drive_v[0]:g} V; use a sine, step or chirp"
        )
    if span < LEAST_SPAN_TO_NOISE * noise or span == 0:
        raise UnsuitableData(
            f"{name}: too little excitation: the position moves by {span:.3g} µm; allowed: at least "
            f"{LEAST_SPAN_TO_NOISE * noise:.2g} µm, {LEAST_SPAN_TO_NOISE:g} times its noise of {noise:.2g} µm. "
            "Use a larger drive"
        )
    signal, values, unit = ("reading", adc_v, "V") if adc_v is not None else ("recorded position", position_um, "µm")
    if (tick := _first_clipped_tick(drive_v, values)) is not None:
        raise UnsuitableData(
            f"{name}: saturated: the {signal} stays at {values[tick]:.6g} {unit} from tick {tick} on although the "
            "stage moves; use a smaller drive, or a sensor or converter of larger range"
        )


def jumps(run: AxisRecording) -> bool:
    """Whether the drive changes at some tick by JUMP_SHARE of its span, or more, and at the ticks before and after this
    one by less than a tenth of this change. The first and the last change never count.
    """
    changes = np.abs(np.diff(run.drive_v))
    padded = np.concatenate([[np.inf], changes, [np.inf]])
    changes_beside = np.maximum(padded[:-2], padded[2:])
    return bool(np.any((changes >= JUMP_SHARE * np.ptp(run.drive_v)) & (changes_beside < 0.1 * changes)))


def excitation_warnings(runs: Sequence[AxisRecording]) -> list[str]:
    """Return a warning, with a remedy, for each run whose drive was made by a controller or has steps (`jumps`)."""
    remedy = (
        'Record a slow sine without a controller: `rtloop run` with mode = "raw" and a reference in V, as in '
        "deploy/characterise.toml"
    )
    sentences = list[str]()
    for run in runs:
        if run.is_closed_loop:
            cause = "a controller computed the drive (mode closed_loop)"
            effect = (
                "The controller also responds to noise and to the stage's dynamics, which then look like hysteresis"
            )
            sentences.append(f"{run.name}: {cause}. {effect}. {remedy}")
        elif jumps(run):
            cause = "the drive has steps, after which the stage rings"
            sentences.append(f"{run.name}: {cause}. Identification takes this ringing for hysteresis. {remedy}")
    return sentences


def require_rising(run: AxisRecording) -> None:
    """Raise UnsuitableData where the position falls as a slow drive rises: a sign is wrong somewhere.

    It falls if its correlation with the drive is below LARGEST_ANTICORRELATION, which is negative, both without their
    straight lines: a drift is no evidence. A drive that is little more than a line gives none.
    """
    drive_v, position_um = _without_line(run.drive_v[:-1]), _without_line(run.position_um[1:])
    if np.var(drive_v) < LEAST_TURNING * np.var(run.drive_v):
        return
    if np.corrcoef(drive_v, position_um)[0, 1] < LARGEST_ANTICORRELATION:
        slope = float(np.polyfit(drive_v, position_um, 1)[0])
        raise wrong_sign(run.name, f"the position falls by {-slope:.3g} µm per volt of drive")


def _without_line(values: Real) -> Real:
    ticks = np.arange(values.size)
    return values - np.polyval(np.polyfit(ticks, values, 1), ticks)


def wrong_sign(name: str, observation: str) -> UnsuitableData:
    """Return the error for the recording `name`, in which the position falls where it should rise.

    `observation` is a clause that says how the recording shows this.
    """
    return UnsuitableData(
        f"{name}: the sign of drive or position is wrong: {observation}. A loop with this sign is unstable. Change "
        "the sign of the channel's um_per_v ([driver.channels], or the mapping of an import), or reverse the wires of "
        "sensor or drive, and record again"
    )


def noise_std(position: Real) -> float:
    """Return the standard deviation of white noise on a smooth signal (ticks,), in its unit, from the median of its
    second differences.
    """
    return float(np.median(np.abs(np.diff(position, 2)))) / 0.6745 / 6**0.5


def _first_clipped_tick(drive: Real, adc: Real) -> int | None:
    """Return the first tick of the first plateau of `adc`, readings or positions, that clipping caused; None without
    one.

    A plateau is PLATEAU_TICKS or more at the maximum of `adc`, or if none there counts, at its minimum. It counts if
    the drive moves meanwhile by more than PLATEAU_DRIVE of its span or `adc` jumps at one of the plateau's ends
    (PLATEAU_JUMP); a plateau at the start of the recording does not count. A coarse sensor has plateaus between the
    extremes: the drive must move more than during these.
    """
    changes = np.abs(np.diff(adc))
    usual_change = max(float(np.median(changes)), float(changes[changes > 0].min(initial=np.inf)))
    for extreme in (adc.max(), adc.min()):
        at_extreme = adc == extreme
        edges = np.flatnonzero(np.diff(np.concatenate([[False], at_extreme, [False]])))
        for start, end in edges.reshape(-1, 2):
            if start == 0 or end - start < PLATEAU_TICKS:
                continue
            change_before, change_after = changes[start - 1], changes[end - 1] if end < adc.size else 0.0
            if max(change_before, change_after) > PLATEAU_JUMP * usual_change:
                return int(start)
            if np.ptp(drive[start:end]) > max(PLATEAU_DRIVE * np.ptp(drive), _motion_between_extremes(drive, adc)):
                return int(start)
    return None


def _motion_between_extremes(drive: Real, adc: Real) -> float:
    """Return the largest motion of the drive while `adc` stays at one value between its extremes."""
    edges = np.flatnonzero(np.diff(adc, prepend=np.nan, append=np.nan))
    inside = [(a, b) for a, b in pairwise(edges) if b - a >= PLATEAU_TICKS and adc.min() < adc[a] < adc.max()]
    return max((float(np.ptp(drive[start:end])) for start, end in inside), default=0.0)


def _require_untripped(path: Path, flags: Real) -> None:
    """Raise UnsuitableData if `flags` (ticks,) contain a trip, with its first tick, its causes and a remedy."""
    is_tripped = np.array([bool(trip_causes(value)) for value in np.unique(flags)])
    if not np.any(is_tripped):
        return
    first = int(np.argmax(np.isin(flags, np.unique(flags)[is_tripped])))
    causes = trip_causes(flags[first])
    raise UnsuitableData(
        f"{path}: the run tripped at tick {first} ({', '.join(causes)}); identification needs a recording "
        f"without a trip. {trip_remedy(causes)}"
    )


def trip_remedy(causes: Sequence[str]) -> str:
    """Return sentences that tell how to record again without a trip of these causes, named as `trip_causes` does."""
    remedies = dict.fromkeys(_TRIP_REMEDIES.get(cause, _OTHER_REMEDY) for cause in causes)
    return " ".join(remedies)


def select_axis(recording: Recording, axis: str | None, path: Path) -> str:
    """Return `axis`, or the only axis for None. Raises RecordingError if `axis` is unknown, or None with several
    axes, and for a recording without axes, as an import may be.
    """
    axes = recording.header.get("axes", [])
    if not axes:
        raise RecordingError(
            f"{path}: the recording has no axis; import drive and position again, as in `rtloop import FILE "
            "--map 'x_drive_v=COLUMN [V]' --map 'x_position_um=COLUMN [µm]'`"
        )
    if axis is None and len(axes) == 1:
        return str(axes[0])
    if axis is None or axis not in axes:
        complaint = "several axes" if axis is None else f"no axis {axis!r}"
        raise RecordingError(f"{path}: {complaint}; select one of {', '.join(axes)} with --axis NAME")
    return axis


def _digest(paths: tuple[Path, ...]) -> str:
    """Return the SHA-256, in hex, of the files' contents joined in the order of `paths`.

    Raises RecordingError for a file that cannot be read.
    """
    digest = hashlib.sha256()
    for path in paths:
        try:
            with os.fdopen(open_user_file(path), "rb") as file:
                for block in iter(lambda: file.read(1 << 20), b""):
                    digest.update(block)
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror or error}") from None
    return digest.hexdigest()
