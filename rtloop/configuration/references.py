"""Reference options to generators: parameters of the compiled kinds, and one table that holds all samples."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtloop.configuration.reference_options import (
    ChirpOptions,
    HoldOptions,
    InputOptions,
    ReferenceOptions,
    StepsOptions,
    TableOptions,
)
from rtloop.configuration.text_files import read_below, read_regular
from rtloop.drivers.base import Channel, channel_index
from rtloop.engine.messages import ALL_AXES, Kind
from rtloop.engine.plan import Plan
from rtloop.kernel.limits import USABLE_MAGNITUDE
from rtloop.kernel.reference import Generator
from rtloop.signals import Mode

MAX_TABLE_BYTES = 64 << 20
MAX_SAMPLES = MAX_TABLE_BYTES // 8
MAX_HOLD_TICKS = 10**9
"""Limit for one sample: more than a day at 10 kHz, and no count of ticks overflows."""


class _NotANumber(Exception):
    """A line of a table that holds no number; its argument is the line's number."""


class TableOfSamples:
    """All samples of the references in one array, which the loop reads; grows while references are built."""

    def __init__(self) -> None:
        """Begin with an empty table."""
        self._parts: list[npt.NDArray[np.float64]] = []
        self._size = 0

    def add(self, samples: npt.NDArray[np.float64]) -> int:
        """Append `samples` (n,) and return the index of the first one."""
        first = self._size
        self._parts.append(samples)
        self._size += samples.size
        return first

    @property
    def samples(self) -> npt.NDArray[np.float64]:
        """Samples of all references, in the order of `add`, (n,); a generator's parameters say where its own begin."""
        return np.concatenate(self._parts) if self._parts else np.zeros(0)


def generator_values(
    options: ReferenceOptions, rate_hz: float, inputs: tuple[Channel, ...], folder: Path, table: TableOfSamples
) -> tuple[float, ...]:
    """Return a generator's kind, then its parameters: frequencies in Hz, the phase in turns, a sweep's duration in s,
    the time that a sample is held in ticks.

    Samples are appended to `table`; the parameters then begin with the index of the first one and their number. Raises
    ValueError for a duration or frequency that the rate does not allow, an unusable file, and an unknown channel.
    """
    if isinstance(options, HoldOptions):
        return Generator.HOLD, options.value
    if isinstance(options, StepsOptions):
        if options.dwell_s * rate_hz > MAX_HOLD_TICKS:
            raise ValueError(
                f"dwell_s: {options.dwell_s} s; allowed: up to {MAX_HOLD_TICKS} periods of {1 / rate_hz:g} s"
            )
        hold_ticks = round(options.dwell_s * rate_hz)
        if hold_ticks < 1:
            raise ValueError(f"dwell_s: {options.dwell_s} s; allowed: at least one period of {1 / rate_hz:g} s")
        first = table.add(np.array(options.levels))
        return Generator.TABLE, first, len(options.levels), hold_ticks, float(options.repeat)
    if isinstance(options, TableOptions):
        if options.hold_ticks > MAX_HOLD_TICKS:
            raise ValueError(f"hold_ticks: {options.hold_ticks} ticks; allowed: up to {MAX_HOLD_TICKS} ticks")
        return table_values(read_samples(folder / options.file), options.hold_ticks, options.repeat, table)
    if isinstance(options, ChirpOptions):
        _require_below_half_rate("start_hz", options.start_hz, rate_hz)
        _require_below_half_rate("end_hz", options.end_hz, rate_hz)
        sweep = (options.amplitude, options.start_hz, options.end_hz, options.duration_s, options.offset)
        return Generator.CHIRP, *sweep, float(options.logarithmic)
    if isinstance(options, InputOptions):
        return Generator.INPUT, channel_index(inputs, options.channel), options.per_v, options.offset
    _require_below_half_rate("frequency_hz", options.frequency_hz, rate_hz)
    kind = Generator.SINE if options.kind == "sine" else Generator.TRIANGLE
    return kind, options.amplitude, options.frequency_hz, options.offset, options.phase_deg / 360


def _require_below_half_rate(key: str, frequency_hz: float, rate_hz: float) -> None:
    """Raise ValueError for a frequency of half the loop's rate or more, which would be played as a lower one."""
    if not frequency_hz < rate_hz / 2:
        raise ValueError(f"{key}: {frequency_hz:g} Hz; allowed: below half of the loop's rate, {rate_hz / 2:g} Hz")


def table_values(
    samples: npt.NDArray[np.float64], hold_ticks: int, repeat: bool, table: TableOfSamples
) -> tuple[float, ...]:
    """Append `samples` (n, 1 or 2) to `table`; return kind and parameters of a generator that plays them.

    Each row is held for `hold_ticks`. After the last row, `repeat` begins anew; otherwise the last row is held. The
    first column is the reference; the second, in µm, is added to the command of a closed loop.
    """
    count, columns = samples.shape
    first = table.add(samples.T.ravel())
    return Generator.TABLE, first, count, hold_ticks, float(repeat), float(columns == 2)


def read_samples(path: Path, folder: Path | None = None) -> npt.NDArray[np.float64]:
    """Return one or two columns of numbers, (n, 1 or 2), of a text or .npy file.

    With `folder`, `path` is relative to this folder, and must not leave it. Raises ValueError for an unreadable file,
    other contents, too many samples, and numbers that are not finite or too large. Messages quote no contents: the
    person who names a file is not always allowed to read it.
    """
    try:
        data = read_regular(path, MAX_TABLE_BYTES) if folder is None else read_below(folder, path, MAX_TABLE_BYTES)
        loaded = np.load(io.BytesIO(data), allow_pickle=False) if path.suffix == ".npy" else _numbers(data.decode())
    except OSError as error:
        raise ValueError(f"file: {path}: {error.strerror or error}") from None
    except _NotANumber as error:
        raise ValueError(f"file: {path} is not one or two columns of numbers (line {error})") from None
    except Exception:  # a malformed .npy header can raise almost any error
        raise ValueError(f"file: {path} is not one or two columns of numbers") from None
    if not isinstance(loaded, np.ndarray) or loaded.dtype.kind not in "fiu":
        raise ValueError(f"file: {path} contains {getattr(loaded, 'dtype', 'an archive')}; allowed: real numbers")
    if loaded.size > MAX_SAMPLES:
        raise ValueError(f"file: {path} has {loaded.size} samples; allowed: up to {MAX_SAMPLES}")
    samples = loaded.astype(float)
    if samples.ndim == 1:
        samples = samples[:, np.newaxis]
    if samples.ndim != 2 or samples.shape[1] not in (1, 2) or samples.size == 0:
        raise ValueError(
            f"file: {path} holds an array of {' × '.join(map(str, loaded.shape)) or 'no'} numbers; allowed: one or "
            "two columns of at least one number"
        )
    if not np.all(np.abs(samples) < USABLE_MAGNITUDE):
        raise ValueError(
            f"file: {path} contains NaN, infinity or too large numbers; allowed: finite numbers within "
            f"±{USABLE_MAGNITUDE:g}"
        )
    return samples


def _numbers(text: str) -> npt.NDArray[np.float64]:
    """Return the one or two numbers of each line, (n, 1 or 2), which commas or spaces separate; empty lines and
    comments (#) are skipped.

    Raises _NotANumber for a text that is no number, and for a line of more than two numbers or not as many as the
    first.
    """
    rows: list[list[float]] = []
    for count, line in enumerate(text.splitlines(), start=1):
        if content := line.partition("#")[0].strip():
            try:
                rows.append([float(number) for number in content.split("," if "," in content else None)])
            except ValueError:
                raise _NotANumber(count) from None
            if len(rows[-1]) > 2 or len(rows[-1]) != len(rows[0]):
                raise _NotANumber(count)
    return np.array(rows)


def references_in_plan(plan: Plan, axis: int) -> Iterator[tuple[str, Mode, list[float]]]:
    """Yield every reference of an axis in a plan: its label, the mode that it begins in, and its generator.

    The generator is its kind, then its parameters.
    """
    mode, generator = plan.mode, plan.generators[axis]
    yield "reference", mode, [float(generator["kind"]), *generator["parameters"].tolist()]
    for command in plan.schedule:
        if command["kind"] == Kind.SET_MODE:
            mode = Mode(int(command["values"][0]))
        elif command["kind"] == Kind.SET_REFERENCE and command["axis"] in (ALL_AXES, axis):
            yield f"reference from tick {command['tick']} on", mode, command["values"].tolist()


def played_samples(plan: Plan, values: Sequence[float]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the samples (n,) that a generator `values` plays from the plan's table, and its additions to the command
    in µm (n,); none, (0,), for a kind without a table or without such additions.
    """
    if values[0] != Generator.TABLE:
        return np.empty(0), np.empty(0)
    first, count = int(values[1]), int(values[2])
    last = first + 2 * count if values[5] else first + count
    return plan.table[first : first + count], plan.table[first + count : last]


def volts(lowest: float, highest: float) -> str:
    """Return a range of voltages as text, such as "0 V … 10 V"; "5 V" where both ends are equal."""
    return f"{lowest:g} V" if lowest == highest else f"{lowest:g} V … {highest:g} V"


def extent(values: Sequence[float], samples: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Return the lowest and the highest value of a generator `values`: its kind, then its parameters.

    `samples` (n,) are the reference of a generator that plays a table. The result for an input channel is (0, 0),
    because its range is unknown.
    """
    kind = Generator(int(values[0]))
    if kind is Generator.INPUT:
        return 0.0, 0.0
    if kind is Generator.TABLE:
        return float(np.min(samples)), float(np.max(samples))
    if kind is Generator.HOLD:
        return values[1], values[1]
    offset, amplitude = values[5 if kind is Generator.CHIRP else 3], abs(values[1])
    return offset - amplitude, offset + amplitude
