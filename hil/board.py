"""The rig as a board of its own: a free-running process with its own clock behind memory that looks like a card.

The controller's side writes DAC codes and reads ADC codes; the board moves the rig at its own rate whether or not
anybody writes, and holds the last codes like a card does. Samples can be dropped or repeated at random, as a bad link
does; a seed makes that the same in every run. The board stores what it saw at its outputs (`witness.py`): evidence
that does not come from the process that is judged.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.hil.native.atomics import fence_acquire, fence_release, load_acquire, store_release
from rtloop.hil.native.compiled import jit
from rtloop.hil.native.monotonic import monotonic_ns, sleep_until
from rtloop.hil.options import BoardOptions
from rtloop.hil.rig import advance, build_rig, sample
from rtloop.hil.stages.noise import seed_word
from rtloop.hil.trusted import open_file, release
from rtloop.hil.witness import LEVELS, PAST, SEEN, move, see_write

MAGIC = int.from_bytes(b"rtlboard", "little")
VERSION = 3
MAX_CHANNELS = 16
BITS = 16
FULL_SCALE_V = 10.0
LSB_V = 2 * FULL_SCALE_V / 2**BITS
LOWEST_CODE, HIGHEST_CODE = -(2 ** (BITS - 1)), 2 ** (BITS - 1) - 1
SLICE_S = 0.02
BOARD_BYTE, CONTROLLER_BYTE = 0, 1
BUSY = np.uint64(0xFFFFFFFFFFFFFFFF)

FACTS = np.dtype([("magic", np.uint64), ("version", np.int64), ("channels", np.int64), ("rate_hz", np.float64)])
"""First in the file, written once."""
WORDS, SEQUENCE, FAULT, LONGEST_LATE_NS, DROPPED, REPEATED, WRITTEN, TAKEN, UNSEEN, LOOKED_NS = 9, *range(9)
"""uint64 words: samples so far (BUSY while one is written), the fault that a test asks for, how late the board's own
clock ever was (between two looks at its outputs lay at most so much more than its period), how many samples were
dropped and repeated, how many writes there were, how many of them the board has looked at, how many it came too
late to see, and when it began its newest look, in ns of CLOCK_MONOTONIC."""
FIFO = 1 << 14
"""Writes that the card keeps until the board has seen them; the newest of them is what stands at the converters."""
WRITE = np.dtype([("ns", np.int64), ("codes", np.int64, (MAX_CHANNELS,))])
"""A write: its date in ns of CLOCK_MONOTONIC, taken by the driver as it writes, and the code of each channel."""
NO_FAULT, FROZEN_INPUT, STUCK_OUTPUT = 0, 1, 2
LOSSES = np.dtype([("word", np.uint64), ("dropped_share", np.float64), ("repeated_share", np.float64)])
"""How often samples are lost, and the state of the chance that decides."""
_SHIFTS = np.uint64(13), np.uint64(7), np.uint64(17)
_UNUSED_BITS, _UNIT = np.uint64(11), 2.0**-53


class BoardMemory:
    """Arrays over a board's file: `facts`, `words`, `fifo`, `adc_codes`, `sample_ns`, `seen`."""

    def __init__(self, fd: int) -> None:
        self._map = mmap.mmap(fd, file_bytes())
        offset = 0
        arrays = {}
        for name, (dtype, count) in _LAYOUT.items():
            arrays[name] = np.frombuffer(self._map, dtype, count, offset)
            offset += _aligned(dtype.itemsize * count)
        self.facts, self.words, self.sample_ns = arrays["facts"], arrays["words"], arrays["sample_ns"]
        self.adc_codes = arrays["adc_codes"]
        self.fifo, self.seen = arrays["fifo"].view(np.recarray), arrays["seen"].view(np.recarray)
        self._arrays = tuple(arrays.values())

    @property
    def dac_codes(self) -> np.ndarray[Any, Any]:
        """Codes at the converters (MAX_CHANNELS,): those of the newest write; zeros before the first."""
        written = int(self.words[WRITTEN])
        return self.fifo[(written - 1) % FIFO]["codes"].copy() if written else np.zeros(MAX_CHANNELS, np.int64)

    def reset(self) -> None:
        """As a card is after it was switched on: outputs at 0 V, nothing seen."""
        for array in self._arrays:
            array[:] = np.zeros(1, array.dtype)


_LAYOUT: dict[str, tuple[np.dtype, int]] = {
    "facts": (FACTS, 1),
    "words": (np.dtype(np.uint64), WORDS),
    "sample_ns": (np.dtype(np.int64), 1),
    "adc_codes": (np.dtype(np.int64), MAX_CHANNELS),
    "seen": (SEEN, MAX_CHANNELS),
    "fifo": (WRITE, FIFO),
}


def _aligned(size: int) -> int:
    return -(-size // 64) * 64


def file_bytes() -> int:
    """Length of a board's file."""
    return sum(_aligned(dtype.itemsize * count) for dtype, count in _LAYOUT.values())


class BoardBusy(OSError):
    """Another board serves this file."""


def serve(
    path: Path,
    options: BoardOptions,
    axes: Sequence[str],
    rate_hz: float,
    stopped: Callable[[], bool],
    ready: Callable[[], None] = lambda: None,
) -> int:
    """Be the board at `path` until `stopped`; returns the samples taken. Raises ValueError, OSError, BoardBusy."""
    if len(axes) > MAX_CHANNELS:
        raise ValueError(f"{len(axes)} axes; a board has at most {MAX_CHANNELS} channels")
    coefficients, state = build_rig(options, axes, 1.0 / rate_hz)
    fd = open_file(path, os.O_RDWR | os.O_CREAT, 0o660, group=True)
    try:
        if not take_role(fd, BOARD_BYTE):
            raise BoardBusy(f"{path}: another board serves this file")
        os.ftruncate(fd, file_bytes())  # never shorter: a controller may still have it mapped
        memory = BoardMemory(fd)
        memory.reset()
        timespec = np.zeros(2, np.int64)
        losses = np.zeros(1, LOSSES).view(np.recarray)
        losses.word = seed_word(options.seed, "losses")
        losses.dropped_share, losses.repeated_share = options.dropped_share, options.repeated_share
        levels = np.zeros((MAX_CHANNELS, LEVELS), PAST).view(np.recarray)
        arguments = (coefficients, state, memory.words, memory.sample_ns, memory.fifo, memory.adc_codes, memory.seen,
                     levels, losses, timespec.ctypes.data)  # fmt: skip
        _run(*arguments, time.monotonic_ns(), 1e9 / rate_hz, 0, 0)
        memory.facts["version"], memory.facts["channels"], memory.facts["rate_hz"] = VERSION, len(axes), rate_hz
        memory.facts["magic"] = MAGIC
        ready()
        start_ns, index, slice_ticks = time.monotonic_ns(), 0, max(1, round(SLICE_S * rate_hz))
        while not stopped():
            index = _run(*arguments, start_ns, 1e9 / rate_hz, index, slice_ticks)
        memory.facts["magic"] = 0
        return int(memory.words[SEQUENCE])
    finally:
        release(fd)


def take_role(fd: int, byte: int) -> bool:
    """Lock one byte of the file for this open file: BOARD_BYTE or CONTROLLER_BYTE; False where another has it.

    The lock belongs to the open file and not to the process, whose locks would all go when any of its descriptors
    of the file is closed.
    """
    request = struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, byte, 1, 0)
    try:
        fcntl.fcntl(fd, fcntl.F_OFD_SETLK, request)
    except OSError:
        return False
    return True


@jit
def _run(
    coefficients,
    state,
    words,
    sample_ns,
    fifo,
    adc_codes,
    seen,
    past,
    losses,
    timespec,
    start_ns,
    period_ns,
    index,
    count,
):
    """`count` periods of the board's fixed grid; periods that a stall swallowed still move the rig. Next index."""
    actuator_v = np.zeros(coefficients.shape[0])
    for _ in range(count):
        wake_ns = start_ns + np.int64(index * period_ns)
        now_ns = monotonic_ns(timespec)
        while now_ns < wake_ns:
            now_ns = sleep_until(wake_ns, timespec)
        if np.uint64(now_ns - wake_ns) > words[LONGEST_LATE_NS]:
            words[LONGEST_LATE_NS] = np.uint64(now_ns - wake_ns)
        fault = load_acquire(words, FAULT)
        value_arrives, time_arrives = _arrives(losses[0], words)
        frozen = fault == FROZEN_INPUT
        sequence = load_acquire(words, SEQUENCE)
        store_release(words, SEQUENCE, BUSY)
        fence_release()
        for i in range(coefficients.shape[0]):
            volts = sample(coefficients[i], state[i])
            if value_arrives and not frozen:
                adc_codes[i] = np.int64(np.rint(volts / LSB_V))
            _look(seen[i], state[i], index)
        if time_arrives and not frozen:
            sample_ns[0] = now_ns
        store_release(words, SEQUENCE, sequence + np.uint64(1))
        _look_at_outputs(words, fifo, seen, past, coefficients.shape[0], fault != STUCK_OUTPUT, timespec)
        for i in range(coefficients.shape[0]):
            actuator_v[i] = seen[i].last_v
        advance(coefficients, state, actuator_v)
        index += 1
    return index


@jit
def _arrives(losses, words):
    """Whether this sample's value, and whether its time, reach the controller."""
    word = losses.word
    word ^= word << _SHIFTS[0]
    word ^= word >> _SHIFTS[1]
    word ^= word << _SHIFTS[2]
    losses.word = word
    chance = float(word >> _UNUSED_BITS) * _UNIT
    if chance < losses.dropped_share:
        words[DROPPED] += np.uint64(1)
        return False, False
    if chance < losses.dropped_share + losses.repeated_share:
        words[REPEATED] += np.uint64(1)
        return False, True
    return True, True


@jit
def _look(seen, state, index):
    """The true position, and the farthest it ever was."""
    seen.true_position_um = state.true_position_um
    if abs(state.true_position_um) > seen.largest_position_um:
        seen.largest_position_um = abs(state.true_position_um)


@jit
def _look_at_outputs(words, fifo, seen, past, channels, follow, timespec):
    """See the writes since the look before, and what the outputs are at; stuck outputs do not `follow`."""
    look_begin_ns = monotonic_ns(timespec)
    write_count = load_acquire(words, WRITTEN)
    now_ns = monotonic_ns(timespec)
    see_writes(words, fifo, seen, past, channels, write_count, now_ns, follow)
    words[LOOKED_NS] = np.uint64(look_begin_ns)  # what `written` did not count yet was written after this
    for i in range(channels):
        if follow:
            move(seen[i], seen[i].written_v, now_ns)


@jit
def see_writes(words, fifo, seen, past, channels, written, now_ns, follow):
    """See every write up to number `written` that was not seen yet; all of them were made before `now_ns`."""
    examined_count = words[TAKEN]
    if written - examined_count > np.uint64(FIFO):
        words[UNSEEN] += written - examined_count - np.uint64(FIFO)
        examined_count = written - np.uint64(FIFO)
    while examined_count < written:
        write = fifo[np.int64(examined_count % np.uint64(FIFO))]
        written_ns = min(max(write.ns, np.int64(words[LOOKED_NS])), now_ns)
        for i in range(channels):
            words[UNSEEN] += np.uint64(see_write(seen[i], past[i], write.codes[i] * LSB_V, written_ns, follow))
        examined_count += np.uint64(1)
    words[TAKEN] = examined_count


@jit
def latest_sample(words, sample_ns, adc_codes, out_codes, channels, tries):
    """Copy the newest sample; returns its time in ns of CLOCK_MONOTONIC, or −1 where none could be had whole."""
    for _ in range(tries):
        sequence = load_acquire(words, SEQUENCE)
        if sequence == BUSY:
            continue
        for i in range(channels):
            out_codes[i] = adc_codes[i]
        time_ns = sample_ns[0]
        fence_acquire()
        if load_acquire(words, SEQUENCE) == sequence:
            return time_ns
    return np.int64(-1)
