"""Ctrl-C and SIGTERM, for one run or for several runs in sequence.

This module must import quickly: the handlers are installed before other imports. An exception raised by a signal in
the middle of an import or a compilation may be lost there, and the run would continue.
"""

from __future__ import annotations

import signal
import threading
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from rtloop.supervision.supervisor import Supervisor


class Interruption:
    """Handlers of SIGINT and SIGTERM that stop the current run and the runs after it.

    `requested` is True after the first signal. A second signal outside a run raises KeyboardInterrupt. Outside the main
    thread no handler can be installed, and no signal is touched.
    """

    def __init__(self) -> None:
        """Set the state before any signal; the handlers are installed by `with`."""
        self.requested = False
        self._supervisor: Supervisor | None = None

    def __enter__(self) -> Self:
        """Install the handlers of SIGINT and SIGTERM, in the main thread only."""
        is_main = threading.current_thread() is threading.main_thread()
        names = (signal.SIGINT, signal.SIGTERM) if is_main else ()
        self._previous = {name: signal.signal(name, self._handle) for name in names}
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous handlers."""
        for name, handler in self._previous.items():
            signal.signal(name, handler)

    def set_supervisor(self, supervisor: Supervisor | None) -> None:
        """Set the run that a signal stops, None between runs; stop it now if a signal has come already."""
        self._supervisor = supervisor
        if supervisor is not None and self.requested:
            supervisor.stop()

    def _handle(self, *_: object) -> None:
        """Set `requested` and stop the current run. A second signal without a run raises KeyboardInterrupt."""
        if self.requested and self._supervisor is None:
            raise KeyboardInterrupt
        self.requested = True
        if self._supervisor is not None:
            self._supervisor.stop()
