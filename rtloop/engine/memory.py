"""Shared block: all data that the processes of one loop exchange, as named arrays over one mapped file.

The block describes itself: its first page holds a JSON directory of the arrays, so that any process that gets the file
(a memfd or a path in the runtime directory) can attach. A plain mapping is used because Python 3.11's
`multiprocessing.shared_memory` would unlink the segment when the first attached process exits."""

from __future__ import annotations

import fcntl
import json
import mmap
import os
import signal
import struct
import time
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from rtloop.engine.messages import MESSAGE
from rtloop.engine.ring import Ring
from rtloop.foundation.native.word_access import load_acquire, store_release
from rtloop.foundation.trusted import close_descriptor

DIRECTORY_BYTES = 8192
_LOCK = "hhqqi4x"
"""struct flock: kind, whence, start, length, process."""
ATTACH_POLL_S = 0.001
RING_SECONDS = 10.0
# numbers of slots are powers of two: the rings rely on it
MIN_RING_TICKS = 4096
EVENT_SLOTS = 4096
SNAPSHOT_SLOTS = 64
COMMAND_SLOTS = 256
FAULT_BYTES = 960
URGENT_SLOTS = 16
"""Slots of the command queue reserved for commands that make the outputs safe; other commands cannot fill them."""


UNREADABLE = (ValueError, TypeError, KeyError, AttributeError)
"""Raised by `SharedBlock` for a file that holds no block, or a damaged one."""


class Word(IntEnum):
    """Index into `words`, the block's uint64 control words."""

    GO = 0
    STOP = 1
    HEARTBEAT_NS = 2
    RECORDER_CURSOR = 3
    LOOP_STATE = 4
    RECORDER_STATE = 5
    COMMANDS_HEAD = 6
    COMMANDS_TAIL = 7
    LOOP_PID = 8
    RECORDER_PID = 9
    START_UNIX_NS = 10
    FINISHED_TICKS = 11
    FLUSHED_TICKS = 12
    """Ring positions up to which the recorder has written; a new recorder continues there if this one dies."""
    FLUSHED_EVENTS = 13
    FLUSHED_SNAPSHOTS = 14
    LOST_TICKS = 15
    """Ticks before FLUSHED_TICKS that are in no file."""
    RECORDER_FAILURE = 16
    """Cause why ticks from FLUSHED_TICKS on are not recorded: `OutputError.number`; 0 while they are."""
    ANNOUNCED_TICKS = 17
    """Values of FLUSHED_TICKS and the following words after the write in progress; see
    `rtloop.recording.capture.progress`."""
    ANNOUNCED_EVENTS = 18
    ANNOUNCED_SNAPSHOTS = 19
    ANNOUNCED_LOST = 20
    ANNOUNCED_BYTE = 21
    """Offset in its file at which that write begins."""
    SUPERVISOR_PID = 22
    HEART_THREAD = 23
    """Number of the supervisor's thread that renews the heartbeat."""


class ProcessState(IntEnum):
    """Value of LOOP_STATE and RECORDER_STATE."""

    STARTING = 0
    READY = 1
    RUNNING = 2
    FINISHED = 3
    FAILED = 4

    @classmethod
    def has_ended(cls, state: int) -> bool:
        """Return whether a process in this state has reached its end, finished or failed."""
        return state in (cls.FINISHED, cls.FAILED)


class Sizes(NamedTuple):
    """Dimensions of the block's arrays; `snapshot_bytes` is the length of the law's binary snapshot."""

    columns: int
    axes: int
    rate_hz: float
    snapshot_bytes: int
    table_samples: int


class SharedBlock:
    """Named numpy arrays over a mapped file; `fd` may be handed to child processes."""

    def __init__(self, fd: int) -> None:
        """Map the block in the file `fd`, which stays the caller's to close.

        Raises one of UNREADABLE if the file holds no block, or a damaged one.
        """
        self.fd = fd
        self._map = mmap.mmap(fd, 0)
        directory = json.loads(self._map[:DIRECTORY_BYTES].rstrip(b"\0"))
        self._arrays: dict[str, np.ndarray[Any, Any]] = {
            name: np.frombuffer(
                self._map,
                dtype=np.lib.format.descr_to_dtype(_restore_tuples(descr)),
                count=int(np.prod(shape)),
                offset=offset,
            ).reshape(shape)
            for name, (offset, descr, shape) in directory.items()
        }
        words = self._arrays["words"]
        self._word_addresses = range(words.ctypes.data, words.ctypes.data + words.nbytes, words.itemsize)
        """Address of each control word."""

    @staticmethod
    def reserve() -> int:
        """Return the descriptor of a new anonymous file, empty, for a later block.

        The descriptor is closed on exec: a child process inherits it by `pass_fds` alone, also before the block exists.
        """
        return os.memfd_create("rtloop")

    @classmethod
    def attach(cls, fd: int, is_given_up: Callable[[], bool]) -> SharedBlock:
        """Wait until the file `fd` has a block and return it.

        Raises EOFError once `is_given_up` returns True before, and one of UNREADABLE for a damaged block.
        """
        while os.pread(fd, 1, 0) != b"{":
            if is_given_up():
                raise EOFError("no shared block was created")
            time.sleep(ATTACH_POLL_S)
        return cls(fd)

    @classmethod
    def create(cls, sizes: Sizes, fd: int | None = None) -> SharedBlock:
        """Create a zeroed block in `fd`, which must be empty, or in an anonymous file.

        Raises ValueError if its directory is too long.
        """
        specification = _array_specification(sizes)
        offset, directory = DIRECTORY_BYTES, {}
        for name, (dtype, shape) in specification.items():
            directory[name] = (offset, np.lib.format.dtype_to_descr(dtype), shape)
            offset += -(-int(dtype.itemsize * np.prod(shape)) // 64) * 64
        header = json.dumps(directory).encode()
        if len(header) > DIRECTORY_BYTES:
            raise ValueError(
                f"memory shared by the loop's processes: the list of its arrays has {len(header)} bytes; allowed: at "
                f"most {DIRECTORY_BYTES}"
            )
        fd = cls.reserve() if fd is None else fd
        os.ftruncate(fd, offset)
        os.pwrite(fd, header, 0)  # last: a block that can be read is complete
        return cls(fd)

    @classmethod
    def create_private(cls, sizes: Sizes) -> SharedBlock:
        """Create a zeroed block that this process alone uses; its memory is freed with the last array of it."""
        block = cls.create(sizes)
        close_descriptor(block.fd)
        return block

    def clear(self) -> None:
        """Set a block that no other process uses to 0, except the slots of its rings, which then count as unwritten."""
        for name, array in self._arrays.items():
            if not name.endswith("_slots"):
                array.view(np.uint8)[...] = 0

    def __getitem__(self, name: str) -> np.ndarray[Any, Any]:
        """Return the array `name`, a view of the shared memory. Raises KeyError for an unknown name."""
        return self._arrays[name]

    def load(self, word: Word) -> int:
        """Return a control word; all writes before the matching `store` are visible afterwards, on any processor."""
        return load_acquire(self._word_addresses[word])

    def store(self, word: Word, value: int) -> None:
        """Set a control word; a process that loads it sees all writes made before, on any processor."""
        store_release(self._word_addresses[word], int(value))

    @property
    def fault(self) -> str | None:
        """Message of the driver's error, cut to FAULT_BYTES; None if there is none."""
        text = self["fault"].tobytes().rstrip(b"\0").decode(errors="ignore")
        return text or None

    @fault.setter
    def fault(self, text: str) -> None:
        """Store the message of the driver's error, cut to FAULT_BYTES bytes."""
        data = text.encode(errors="replace")[:FAULT_BYTES]
        self["fault"][: len(data)] = np.frombuffer(data, np.uint8)
        self["fault"][len(data) :] = 0

    def claim(self) -> None:
        """Mark the calling process, for as long as it lives, as the one that drives the outputs; store its number in
        LOOP_PID.

        Waits while another process has the claim. The kernel drops the claim with the first descriptor of the file that
        the process closes: keep the block.
        """
        self.store(Word.LOOP_PID, os.getpid())
        fcntl.lockf(self.fd, fcntl.LOCK_EX, 1)

    def driver_pid(self) -> int | None:
        """Return the number of the living process that claimed the block.

        None if there is none, or if it is the calling process.
        """
        return claimant_pid(self.fd)

    def kill_driver(self) -> None:
        """Kill the process that claimed the block, by SIGKILL; do nothing without one, or if it is the calling process.

        Another process that has been given its number is never killed.
        """
        pid = self.driver_pid()
        if pid is None:
            return
        try:
            process = os.pidfd_open(pid)
        except ProcessLookupError:
            return
        try:
            if self.driver_pid() == pid:
                signal.pidfd_send_signal(process, signal.SIGKILL)
        except ProcessLookupError:
            pass
        finally:
            close_descriptor(process)

    def ring(self, name: str) -> Ring:
        """Return the ring `name`: `ticks`, `events` or `snapshots`. Raises KeyError for another name."""
        return Ring(self[f"{name}_head"], self[f"{name}_marks"], self[f"{name}_slots"])


def claimant_pid(fd: int) -> int | None:
    """Return the number of the living process that claimed the block in the file `fd`.

    None if there is none, or if it is the calling process.
    """
    request = struct.pack(_LOCK, fcntl.F_WRLCK, os.SEEK_SET, 0, 1, 0)
    kind, *_, pid = struct.unpack(_LOCK, fcntl.fcntl(fd, fcntl.F_GETLK, request))
    return None if kind == fcntl.F_UNLCK else pid


def ring_ticks(rate_hz: float) -> int:
    """Return the number of slots of the tick ring: a power of two, for at least RING_SECONDS and MIN_RING_TICKS."""
    return 1 << int(np.ceil(np.log2(max(MIN_RING_TICKS, RING_SECONDS * rate_hz))))


def _array_specification(sizes: Sizes) -> dict[str, tuple[np.dtype[np.generic], tuple[int, ...]]]:
    """Return type and shape of each array of the block by name."""
    word, real = np.dtype(np.uint64), np.dtype(np.float64)
    ticks = ring_ticks(sizes.rate_hz)
    arrays: dict[str, tuple[np.dtype[np.generic], tuple[int, ...]]] = {
        "words": (word, (64,)),
        "last_drive_v": (real, (sizes.axes,)),
        "table": (real, (max(sizes.table_samples, 1),)),
        "staged": (np.dtype(np.uint8), (sizes.snapshot_bytes,)),
        "fault": (np.dtype(np.uint8), (FAULT_BYTES,)),
        "commands": (MESSAGE, (COMMAND_SLOTS + URGENT_SLOTS,)),
        "commands_marks": (word, (COMMAND_SLOTS + URGENT_SLOTS,)),
    }
    slots: Sequence[tuple[str, np.dtype[np.generic], tuple[int, ...]]] = (
        ("ticks", real, (ticks, sizes.columns)),
        ("events", MESSAGE, (EVENT_SLOTS,)),
        ("snapshots", np.dtype(np.uint8), (SNAPSHOT_SLOTS, sizes.snapshot_bytes)),
    )
    for name, dtype, shape in slots:
        arrays[f"{name}_head"] = (word, (1,))
        arrays[f"{name}_marks"] = (word, (shape[0],))
        arrays[f"{name}_slots"] = (dtype, shape)
    return arrays


def _restore_tuples(descr: str | list[list[object]]) -> Any:
    """Return a numpy dtype description from JSON with tuples in place of its inner lists; a text is unchanged."""
    if isinstance(descr, str):
        return descr
    return [tuple(tuple(part) if isinstance(part, list) else part for part in field) for field in descr]
