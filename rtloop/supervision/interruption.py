"""Ctrl-C and SIGTERM, for a run or for several that follow each other.

Nothing here is slow to import: the handlers stand before anything else is imported, for what is raised out of a signal
in the middle of an import or a compilation may be lost there, and the run would go on.
"""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from rtloop.supervision.supervisor import Supervisor


class Interruption:
    """SIGINT and SIGTERM stop the present run and all that would follow; a second one ends what is no run."""

    def __init__(self) -> None:
        self.requested = False
        self._supervisor: Supervisor | None = None

    def __enter__(self) -> Self:
        self._previous = {name: signal.signal(name, self._handle) for name in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for name, handler in self._previous.items():
            signal.signal(name, handler)

    def set_supervisor(self, supervisor: Supervisor | None) -> None:
        """What is to be stopped from now on."""
        self._supervisor = supervisor
        if supervisor is not None and self.requested:
            supervisor.stop()

    def _handle(self, *_: object) -> None:
        if self.requested and self._supervisor is None:
            raise KeyboardInterrupt
        self.requested = True
        if self._supervisor is not None:
            self._supervisor.stop()
