"""Names of the operators who gave commands, in memory shared by the service and the recorder.

The loop knows the origin of a command, but no names. This table stores the name under the identity of the command,
which the event of the command bears too. It has as many slots as the ring of events.
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
"""A name has at most four bytes a character and no NUL. Identity 0 marks an empty slot."""


class RequesterNames:
    """Table of names in the memory file `fd`; one writer, which stores a name before it sends the command."""

    def __init__(self, fd: int) -> None:
        """Map the table in the memory file `fd`, which `create` made."""
        self.fd = fd
        self._slots = np.frombuffer(mmap.mmap(fd, EVENT_SLOTS * SLOT.itemsize), SLOT)

    @classmethod
    def create(cls) -> RequesterNames:
        """Create an empty table in a memory file, whose descriptor can be passed to a child process."""
        fd = os.memfd_create("rtloop-names")
        os.ftruncate(fd, EVENT_SLOTS * SLOT.itemsize)
        return cls(fd)

    def close(self) -> None:
        """Close the descriptor, so that no further process receives it; this process can still use the table."""
        close_descriptor(self.fd)

    def store(self, identity: int, name: str) -> None:
        """Store `name`, at most MAX_NAME characters, as the requester of command `identity` (1 or more).

        The name for command `identity` − EVENT_SLOTS is overwritten.
        """
        store_release(self._identity_address(identity), 0)
        self._slots[identity % EVENT_SLOTS]["name"] = name.encode()
        store_release(self._identity_address(identity), identity)

    def requester(self, identity: int) -> str | None:
        """Name of the requester of command `identity`; None if none was stored or a later name replaced it."""
        if identity <= 0 or load_acquire(self._identity_address(identity)) != identity:
            return None
        name = bytes(self._slots[identity % EVENT_SLOTS]["name"]).decode(errors="replace")
        return name if load_acquire(self._identity_address(identity)) == identity else None

    def _identity_address(self, identity: int) -> int:
        """Address in memory of the field `identity` in the slot of command `identity`."""
        return self._slots.ctypes.data + identity % EVENT_SLOTS * SLOT.itemsize
