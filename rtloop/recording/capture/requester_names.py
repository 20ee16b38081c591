"""Who asked for what: the names behind commands, in shared memory between the service and the recorder.

The loop knows the origin of a command and nothing of people. A name stands here under the identity that the command,
and the event that it becomes, bear; there is room for as many as the ring of events holds.
"""

from __future__ import annotations

import mmap
import os

import numpy as np

from rtloop.engine.memory import EVENT_SLOTS
from rtloop.foundation.native.word_access import load_acquire, store_release
from rtloop.foundation.trusted import close_descriptor
from rtloop.recording.file.topics.events import MAX_NAME

SLOT = np.dtype([("identity", np.uint64), ("name", f"S{4 * MAX_NAME}")])
"""At most four bytes a character; no name has NULs. Identity 0 stands for none."""


class RequesterNames:
    """The names in the file `fd`. One writer: what it notes before it sends a command is seen with its event."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._slots = np.frombuffer(mmap.mmap(fd, EVENT_SLOTS * SLOT.itemsize), SLOT)

    @classmethod
    def create(cls) -> RequesterNames:
        """None yet, in a file that child processes may inherit."""
        fd = os.memfd_create("rtloop-names")
        os.ftruncate(fd, EVENT_SLOTS * SLOT.itemsize)
        return cls(fd)

    def close(self) -> None:
        """No further process gets the file; what is mapped stays."""
        close_descriptor(self.fd)

    def store(self, identity: int, name: str) -> None:
        """The command `identity`, from 1 on, is asked for by `name`."""
        store_release(self._identity_address(identity), 0)
        self._slots[identity % EVENT_SLOTS]["name"] = name.encode()
        store_release(self._identity_address(identity), identity)

    def requester(self, identity: int) -> str | None:
        """Who asked for a command; None where no name was given, or others have taken its place."""
        if identity <= 0 or load_acquire(self._identity_address(identity)) != identity:
            return None
        name = bytes(self._slots[identity % EVENT_SLOTS]["name"]).decode(errors="replace")
        return name if load_acquire(self._identity_address(identity)) == identity else None

    def _identity_address(self, identity: int) -> int:
        """Address of the first field of the slot of `identity`."""
        return self._slots.ctypes.data + identity % EVENT_SLOTS * SLOT.itemsize
