"""Kind `shm`: a board behind shared memory, such as `rtloop hil serve` runs. The board outlives its controller.

Codes have 16 bits over ±10 V. The age of a sample is the time since the board took it: it grows when the board stalls.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from rtloop.drivers.base import Channel, Driver, Facts, Pointers, Wiring, require_channels
from rtloop.drivers.errors import DriverError
from rtloop.foundation.native.atomics import load_acquire, store_release
from rtloop.foundation.native.compiled import cfunc
from rtloop.foundation.native.monotonic import monotonic_ns
from rtloop.foundation.native.pointers import SIGNATURE, address_pointer, carray
from rtloop.foundation.trusted import close_descriptor, open_file
from rtloop.hil import board
from rtloop.hil.board import (
    FIFO,
    HIGHEST_CODE,
    LOWEST_CODE,
    LSB_V,
    MAX_CHANNELS,
    WRITTEN,
    BoardMemory,
    copy_latest_sample,
)
from rtloop.hil.options import BoardOptions

CONTEXT = np.dtype(
    [(name, np.int64) for name in ("channels", "words", "sample_ns", "fifo", "adc_codes")]
    + [(name, np.int64) for name in ("copied", "held", "held_ns", "timespec")]
)
TRIES = 1000
NO_SAMPLE = 1
FAILED = -1


class ShmOptions(BoardOptions):
    """Options of the driver (`file`), and of the board and its rig for `rtloop hil serve` (all others)."""

    file: str = "/dev/shm/rtloop-board"
    """File of the board's memory, which `rtloop hil serve` makes; a relative path starts at the working directory."""
    board_rate_hz: float | None = Field(default=None, gt=0, le=1e6)
    """Rate of the board's own clock; the loop's by default."""


@cfunc(SIGNATURE)
def shm_read(context, values):
    """Fill `values` with volts and age in µs of the newest sample, or of the last one read if the board stalls while it
    writes a sample.

    Returns 0; NO_SAMPLE, with an infinite age and the volts unchanged, if no sample has been read before the stall.
    """
    card = carray(context, 1, CONTEXT)[0]
    words = carray(address_pointer(card.words), board.WORDS, np.uint64)
    sample_ns = carray(address_pointer(card.sample_ns), 1, np.int64)
    codes = carray(address_pointer(card.adc_codes), MAX_CHANNELS, np.int64)
    copied_codes = carray(address_pointer(card.copied), MAX_CHANNELS, np.int64)
    held_codes = carray(address_pointer(card.held), MAX_CHANNELS, np.int64)
    out = carray(values, card.channels + 1)
    sample_time_ns = copy_latest_sample(words, sample_ns, codes, copied_codes, card.channels, TRIES)
    if sample_time_ns >= 0:
        card.held_ns = sample_time_ns
        for i in range(card.channels):
            held_codes[i] = copied_codes[i]
    elif card.held_ns < 0:
        out[card.channels] = np.inf
        return NO_SAMPLE
    for i in range(card.channels):
        out[i] = held_codes[i] * LSB_V
    out[card.channels] = (monotonic_ns(card.timespec) - card.held_ns) * 1e-3
    return 0


@cfunc(SIGNATURE)
def shm_write(context, values):
    """Append a write with the codes nearest to the volts and the present time; the newest write sets the outputs.

    Volts beyond the range are clipped; channels without an axis keep their codes. Returns 0; FAILED for NaN, and no
    output moves.
    """
    card = carray(context, 1, CONTEXT)[0]
    words = carray(address_pointer(card.words), board.WORDS, np.uint64)
    fifo = carray(address_pointer(card.fifo), FIFO, board.WRITE)
    out = carray(values, card.channels)
    for i in range(card.channels):
        if np.isnan(out[i]):
            return FAILED
    number = load_acquire(words, WRITTEN)
    write, previous = (
        fifo[np.int64(number % np.uint64(FIFO))],
        fifo[np.int64((number - np.uint64(1)) % np.uint64(FIFO))],
    )
    for i in range(card.channels):
        code = np.int64(np.rint(out[i] / LSB_V))
        write.codes[i] = LOWEST_CODE if code < LOWEST_CODE else (HIGHEST_CODE if code > HIGHEST_CODE else code)
    for i in range(card.channels, MAX_CHANNELS):
        write.codes[i] = previous.codes[i]
    write.ns = monotonic_ns(card.timespec)
    store_release(words, WRITTEN, number + np.uint64(1))
    return 0


class ShmDriver(Driver):
    """The driver of a board behind shared memory."""

    kind = "shm"
    options_model = ShmOptions

    def __init__(self, options: ShmOptions, wiring: Mapping[str, Wiring], rate_hz: float) -> None:
        """Check the wiring; the board is not opened.

        Raises ValueError for more axes than MAX_CHANNELS, and for a channel in `wiring` other than adc<i> or dac<i>,
        with i below the number of axes.
        """
        super().__init__(options, wiring, rate_hz)
        self._file = options.file
        self._fd: int | None = None
        self._memory: BoardMemory | None = None
        self._arrays: tuple[np.ndarray[Any, Any], ...] = ()
        if len(wiring) > MAX_CHANNELS:
            raise ValueError(f"channels: {len(wiring)} axes; allowed: at most the {MAX_CHANNELS} channels of a board")
        require_channels(wiring, self.facts)

    @property
    def facts(self) -> Facts:
        """Properties of the driver: a channel pair adc<i>, dac<i> per axis, with ±10 V."""
        count = len(self.wiring)
        lowest, highest = LOWEST_CODE * LSB_V, -LOWEST_CODE * LSB_V
        return Facts(
            inputs=tuple(Channel(f"adc{i}", lowest, highest) for i in range(count)),
            outputs=tuple(Channel(f"dac{i}", lowest, highest) for i in range(count)),
        )

    def open(self) -> Pointers:
        """Attach to a running board and return the pointers; the board's outputs keep their voltages.

        Raises DriverError if the file cannot be opened, no board runs, the board has another version or too few
        channels, or another controller drives it.
        """
        try:
            self._fd = open_file(Path(self._file), os.O_RDWR, group=True)
        except OSError as error:
            raise DriverError(
                f"{self._file}: {error.strerror}; start the board with `rtloop hil serve CONFIG`"
            ) from None
        try:
            self._claim_board(self._fd)
            memory = self._memory = BoardMemory(self._fd)
        except (DriverError, OSError) as error:
            close_descriptor(self._fd)
            self._fd = None
            if isinstance(error, DriverError):
                raise
            raise DriverError(f"{self._file}: {error.strerror or error}") from None
        copied_codes, held_codes, timespec = (np.zeros(size, np.int64) for size in (MAX_CHANNELS, MAX_CHANNELS, 2))
        context = np.zeros(1, CONTEXT)
        context["channels"], context["held_ns"] = len(self.wiring), -1
        arrays = {"words": memory.words, "sample_ns": memory.sample_ns, "fifo": memory.fifo,
                  "adc_codes": memory.adc_codes, "copied": copied_codes, "timespec": timespec,
                  "held": held_codes}  # fmt: skip
        for name, array in arrays.items():
            context[name] = array.ctypes.data
        self._arrays = context, copied_codes, held_codes, timespec
        return Pointers(context.ctypes.data, shm_read.address, shm_write.address)

    def outputs_v(self) -> list[float]:
        """Return the volts of the newest write to the board, for the outputs of the facts in their order.

        Raises DriverError if the driver is not open.
        """
        if self._memory is None:
            raise DriverError(f"{self._file}: the driver is not open; call open() first")
        return (self._memory.dac_codes[: len(self.wiring)] * LSB_V).tolist()

    def close(self) -> None:
        """Set all outputs of the board, wired or not, to 0 V and release the board; if it is not open, do nothing."""
        if self._fd is not None and self._memory is not None:
            context, safe = self._arrays[0], np.zeros(MAX_CHANNELS)
            context["channels"] = MAX_CHANNELS
            shm_write(context.ctypes.data, safe.ctypes.data)
            self._memory, self._arrays = None, ()
            close_descriptor(self._fd)
            self._fd = None

    def _claim_board(self, fd: int) -> None:
        """Take the controller's role, a lock, on the board whose file is open as `fd`.

        Raises DriverError if the file is no board's or its board has ended, if the board has another version or too few
        channels, and if another controller has the role.
        """
        if os.fstat(fd).st_size < board.file_bytes():
            raise DriverError(
                f"{self._file}: this file is not the memory of a board, or the board has not started; "
                "start the board with `rtloop hil serve CONFIG`"
            )
        facts = BoardMemory(fd).facts
        if facts["magic"][0] != board.MAGIC:
            raise DriverError(f"{self._file}: no board is running; start the board with `rtloop hil serve CONFIG`")
        if facts["version"][0] != board.VERSION:
            raise DriverError(
                f"{self._file}: the board has version {facts['version'][0]}; allowed: {board.VERSION}; "
                "restart the board with `rtloop hil serve CONFIG`"
            )
        if facts["channels"][0] < len(self.wiring):
            raise DriverError(
                f"{self._file}: the board has {facts['channels'][0]} channels; allowed: at least {len(self.wiring)}; "
                "restart the board with `rtloop hil serve CONFIG`"
            )
        if not board.lock_role(fd, board.CONTROLLER_BYTE):
            raise DriverError(f"{self._file}: another controller drives this board; stop the other controller")
