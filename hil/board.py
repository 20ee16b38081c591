"""The rig as a separate board: a free-running process with its own clock, behind shared memory like a card's.

The controller writes DAC codes and reads ADC codes. The board advances the rig at its own rate, with or without writes,
and holds the last codes, as a card does. Samples can be dropped or repeated at random, like by a bad link; a seed makes
this repeatable. The board records evidence about its outputs (`witness.py`), independent of the tested controller.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtloop.foundation.native.atomics import fence_acquire, fence_release, load_acquire, store_release
from rtloop.foundation.native.compiled import jit, python_entry
from rtloop.foundation.native.monotonic import monotonic_ns, sleep_until
from rtloop.foundation.native.pointers import address_pointer, carray
from rtloop.foundation.trusted import close_descriptor, open_file
from rtloop.hil.options import BoardOptions
from rtloop.hil.rig import COEFFICIENTS, STATE, advance, build_rig, sample
from rtloop.hil.stages.noise import next_word, seed_word
from rtloop.hil.witness import EVIDENCE, LEVEL, MAX_LEVELS, judge_write, record_level

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
"""Record at the begin of the file, written when the board starts."""
WORDS, SEQUENCE, FAULT, LARGEST_LATENESS_NS, DROPPED, REPEATED, WRITTEN, EXAMINED, MISSED_WRITES, LOOKED_NS = (
    9,
    *range(9),
)
"""Indices of uint64 words: number of samples (BUSY while one is written), fault requested by a test, largest lateness
of the board's clock (two examinations of its outputs are at most a period and this apart), numbers of dropped and
repeated samples, of writes, of examined writes, of writes lost or not compared, and the begin of the newest examination
in ns of CLOCK_MONOTONIC."""
FIFO = 1 << 14
"""Number of writes that the card stores for the board; the newest write is at the converters."""
WRITE = np.dtype([("ns", np.int64), ("codes", np.int64, (MAX_CHANNELS,))])
"""A write: its time in ns of CLOCK_MONOTONIC, according to the driver, and the code of each channel."""
NO_FAULT, FROZEN_INPUT, STUCK_OUTPUT = 0, 1, 2
LOSSES = np.dtype([("word", np.uint64), ("dropped_share", np.float64), ("repeated_share", np.float64)])
"""State of the random generator, and the probabilities of a dropped and of a repeated sample."""
_ADDRESSES = (
    "coefficients", "state", "words", "sample_ns", "fifo", "adc_codes", "evidence", "levels", "losses", "actuator_v",
    "timespec",
)  # fmt: skip
RUNNING_BOARD = np.dtype(
    [
        *((name, np.int64) for name in _ADDRESSES),
        ("channels", np.int64),
        ("start_ns", np.int64),
        ("period_ns", np.float64),
    ]
)
"""What the compiled board works on: addresses of its arrays, its first period in ns of CLOCK_MONOTONIC, its period."""
_UNUSED_BITS, _UNIT = np.uint64(11), 2.0**-53


class BoardMemory:
    """Arrays over a board's file: `facts`, `words`, `sample_ns`, `adc_codes`, `evidence` (per channel) and `fifo`."""

    def __init__(self, fd: int) -> None:
        """Map the file `fd` into memory; its contents stay.

        Raises ValueError for a file shorter than `file_bytes()`, OSError if the system refuses.
        """
        self._map = mmap.mmap(fd, file_bytes())
        offset = 0
        arrays = {}
        for name, (dtype, count) in _LAYOUT.items():
            arrays[name] = np.frombuffer(self._map, dtype, count, offset)
            offset += _padded_bytes(dtype.itemsize * count)
        self.facts, self.words, self.sample_ns = arrays["facts"], arrays["words"], arrays["sample_ns"]
        self.adc_codes = arrays["adc_codes"]
        self.fifo, self.evidence = arrays["fifo"].view(np.recarray), arrays["seen"].view(np.recarray)
        self._arrays = tuple(arrays.values())

    @property
    def dac_codes(self) -> npt.NDArray[np.int64]:
        """Codes of the newest write (MAX_CHANNELS,), a copy; zeros before the first write.

        The converters have these codes unless the fault STUCK_OUTPUT holds them.
        """
        written = int(self.words[WRITTEN])
        return self.fifo[(written - 1) % FIFO]["codes"].copy() if written else np.zeros(MAX_CHANNELS, np.int64)

    def reset(self) -> None:
        """Set all memory to 0, like a card after power-on: outputs at 0 V, no writes, no evidence."""
        for array in self._arrays:
            array[:] = np.zeros(1, array.dtype)


_LAYOUT: dict[str, tuple[np.dtype, int]] = {
    "facts": (FACTS, 1),
    "words": (np.dtype(np.uint64), WORDS),
    "sample_ns": (np.dtype(np.int64), 1),
    "adc_codes": (np.dtype(np.int64), MAX_CHANNELS),
    "seen": (EVIDENCE, MAX_CHANNELS),
    "fifo": (WRITE, FIFO),
}


def _padded_bytes(size: int) -> int:
    """Return `size` rounded up to whole cache lines of 64 bytes."""
    return -(-size // 64) * 64


def file_bytes() -> int:
    """Return the length in bytes of every board's file."""
    return sum(_padded_bytes(dtype.itemsize * count) for dtype, count in _LAYOUT.values())


class BoardConflict(OSError):
    """The file belongs to another running board."""


def serve(
    path: Path,
    options: BoardOptions,
    axes: Sequence[str],
    rate_hz: float,
    is_stopped: Callable[[], bool],
    on_ready: Callable[[], None] = lambda: None,
) -> int:
    """Run a board in the file `path` until `is_stopped()`, called every SLICE_S, is True; return the number of samples.

    The memory begins as zeros; `on_ready` is called before the first period. Raises ValueError for too many axes and
    as `build_rig`, BoardConflict if another board serves the file, OSError if it cannot be opened.
    """
    if len(axes) > MAX_CHANNELS:
        raise ValueError(f"channels: {len(axes)} axes; allowed: at most the {MAX_CHANNELS} channels of a board")
    coefficients, state = build_rig(options, axes, 1.0 / rate_hz)
    fd = open_file(path, os.O_RDWR | os.O_CREAT, 0o660, group=True)
    try:
        if not lock_role(fd, BOARD_BYTE):
            raise BoardConflict(f"{path}: another board serves this file; stop that board, or set another driver.file")
        os.ftruncate(fd, file_bytes())  # All boards have this length: a controller may still have the file mapped.
        memory = BoardMemory(fd)
        memory.reset()
        timespec = np.zeros(2, np.int64)
        losses = np.zeros(1, LOSSES).view(np.recarray)
        losses.word = seed_word(options.seed, "losses")
        losses.dropped_share, losses.repeated_share = options.dropped_share, options.repeated_share
        levels = np.zeros((MAX_CHANNELS, MAX_LEVELS), LEVEL).view(np.recarray)
        arrays = (coefficients, state, memory.words, memory.sample_ns, memory.fifo, memory.adc_codes, memory.evidence,
                  levels, losses, np.zeros(len(axes)), timespec)  # fmt: skip
        board = np.zeros(1, RUNNING_BOARD)
        for name, array in zip(_ADDRESSES, arrays, strict=True):
            board[name] = array.ctypes.data
        board["channels"], board["period_ns"] = len(axes), 1e9 / rate_hz
        advance_board(board.ctypes.data, 0, 0)
        memory.facts["version"], memory.facts["channels"], memory.facts["rate_hz"] = VERSION, len(axes), rate_hz
        memory.facts["magic"] = MAGIC
        on_ready()
        board["start_ns"], index, slice_ticks = time.monotonic_ns(), 0, max(1, round(SLICE_S * rate_hz))
        while not is_stopped():
            index = advance_board(board.ctypes.data, index, slice_ticks)
        memory.facts["magic"] = 0
        return int(memory.words[SEQUENCE])
    finally:
        close_descriptor(fd)


def lock_role(fd: int, byte: int) -> bool:
    """Lock `byte` of the file, BOARD_BYTE or CONTROLLER_BYTE; return whether the lock succeeded.

    The lock fails while another opening of the file has it. It belongs to this opening of the file: a lock of the
    process would end when any descriptor of the file is closed.
    """
    request = struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, byte, 1, 0)
    try:
        fcntl.fcntl(fd, fcntl.F_OFD_SETLK, request)
    except OSError:
        return False
    return True


@python_entry("int64(intp, int64, int64)")
def advance_board(address, index, periods):
    """Run `periods` periods of the board at `address` (RUNNING_BOARD), from number `index` on; return the next number.

    Each period sleeps until its time, samples the ADCs, examines the controller's writes and advances the rig. After a
    stall, periods follow one another without sleep until the rig has caught up.
    """
    board = carray(address_pointer(address), 1, RUNNING_BOARD)[0]
    channels, timespec = board.channels, board.timespec
    coefficients = carray(address_pointer(board.coefficients), channels, COEFFICIENTS)
    state = carray(address_pointer(board.state), channels, STATE)
    words = carray(address_pointer(board.words), WORDS, np.uint64)
    sample_ns = carray(address_pointer(board.sample_ns), 1, np.int64)
    fifo = carray(address_pointer(board.fifo), FIFO, WRITE)
    adc_codes = carray(address_pointer(board.adc_codes), MAX_CHANNELS, np.int64)
    evidence = carray(address_pointer(board.evidence), MAX_CHANNELS, EVIDENCE)
    levels = carray(address_pointer(board.levels), (MAX_CHANNELS, MAX_LEVELS), LEVEL)
    losses = carray(address_pointer(board.losses), 1, LOSSES)
    actuator_v = carray(address_pointer(board.actuator_v), channels, np.float64)
    for _ in range(periods):
        wake_ns = board.start_ns + np.int64(index * board.period_ns)
        now_ns = monotonic_ns(timespec)
        while now_ns < wake_ns:
            now_ns = sleep_until(wake_ns, timespec)
        if np.uint64(now_ns - wake_ns) > words[LARGEST_LATENESS_NS]:
            words[LARGEST_LATENESS_NS] = np.uint64(now_ns - wake_ns)
        fault = load_acquire(words, FAULT)
        value_arrives, time_arrives = _draw_delivery(losses[0], words)
        frozen = fault == FROZEN_INPUT
        sequence = load_acquire(words, SEQUENCE)
        store_release(words, SEQUENCE, BUSY)
        fence_release()
        for i in range(channels):
            volts = sample(coefficients[i], state[i])
            if value_arrives and not frozen:
                adc_codes[i] = np.int64(np.rint(volts / LSB_V))
            _record_position(evidence[i], state[i])
        if time_arrives and not frozen:
            sample_ns[0] = now_ns
        store_release(words, SEQUENCE, sequence + np.uint64(1))
        _observe_outputs(words, fifo, evidence, levels, channels, fault != STUCK_OUTPUT, timespec)
        for i in range(channels):
            actuator_v[i] = evidence[i].last_v
        advance(coefficients, state, actuator_v)
        index += 1
    return index


@jit
def _draw_delivery(losses, words):
    """Draw whether this sample's value, and whether its time, reach the controller; count the loss in `words`.

    Returns (False, False) for a dropped sample, (False, True) for a repeated one, (True, True) for all others.
    """
    losses.word = next_word(losses.word)
    chance = float(losses.word >> _UNUSED_BITS) * _UNIT
    if chance < losses.dropped_share:
        words[DROPPED] += np.uint64(1)
        return False, False
    if chance < losses.dropped_share + losses.repeated_share:
        words[REPEATED] += np.uint64(1)
        return False, True
    return True, True


@jit
def _record_position(evidence, state):
    """Store the true position, and its largest magnitude so far, in the evidence of an output."""
    evidence.true_position_um = state.true_position_um
    if abs(state.true_position_um) > evidence.largest_position_um:
        evidence.largest_position_um = abs(state.true_position_um)


@jit
def _observe_outputs(words, fifo, evidence, levels, channels, follows, timespec):
    """Examine all new writes, store the time of this examination, and record the voltages at the outputs.

    Without `follows` the outputs are stuck: they keep their voltages.
    """
    look_begin_ns = monotonic_ns(timespec)
    write_count = load_acquire(words, WRITTEN)
    now_ns = monotonic_ns(timespec)
    examine_writes(words, fifo, evidence, levels, channels, write_count, now_ns, follows)
    words[LOOKED_NS] = np.uint64(look_begin_ns)  # Writes that `write_count` lacks were made after this time.
    for i in range(channels):
        if follows:
            record_level(evidence[i], evidence[i].written_v, now_ns)


@jit
def examine_writes(words, fifo, evidence, levels, channels, write_count, now_ns, follows):
    """Add all writes with numbers below `write_count`, if not examined before, to the evidence. All were made before
    `now_ns`.

    `evidence` (channels,), `levels` (channels, MAX_LEVELS) and the number EXAMINED in `words` change. Without `follows`
    the outputs are stuck: they keep their voltages. Writes that the FIFO no longer has, or that come too fast to be
    compared, are counted in the word MISSED_WRITES.
    """
    examined_count = words[EXAMINED]
    if write_count - examined_count > np.uint64(FIFO):
        words[MISSED_WRITES] += write_count - examined_count - np.uint64(FIFO)
        examined_count = write_count - np.uint64(FIFO)
    while examined_count < write_count:
        write = fifo[np.int64(examined_count % np.uint64(FIFO))]
        written_ns = min(max(write.ns, np.int64(words[LOOKED_NS])), now_ns)
        for i in range(channels):
            words[MISSED_WRITES] += np.uint64(
                judge_write(evidence[i], levels[i], write.codes[i] * LSB_V, written_ns, follows)
            )
        examined_count += np.uint64(1)
    words[EXAMINED] = examined_count


@jit
def copy_latest_sample(words, sample_ns, adc_codes, out_codes, channels, tries):
    """Copy the newest sample's codes to `out_codes` and return its time in ns of CLOCK_MONOTONIC.

    Returns −1, with `out_codes` undefined, if the board wrote a sample during each of the `tries`.
    """
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
