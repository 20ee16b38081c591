"""What the service says of itself twenty times a second, heard once for all clients."""

from __future__ import annotations

import threading
import time
from typing import Any

from rtloop.errors import RtloopError
from rtloop.service.client import Client
from rtloop.service.client.client import NoAnswer

RETRY_S = 0.5
SILENT_S = 3.0
"""A service that says nothing for so long is not there; one whose connection broke is not there at once."""
UNREACHABLE = "unreachable"
NO_ANSWER = "the service does not answer"


class StateListener:
    """Listens to `/watch` in a thread of its own, and again where that ends."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._status: dict[str, Any] = {}
        self._heard_s = float("-inf")
        self._fault = "nothing was heard yet"
        self._thread = threading.Thread(target=self._listen, name="state", daemon=True)

    def start(self) -> None:
        """Begin to listen, for as long as the process lives."""
        self._thread.start()

    @property
    def status(self) -> dict[str, Any]:
        """What was said last; `state` is unreachable, with an `error`, where nothing is said any more."""
        if time.monotonic() - self._heard_s > SILENT_S:
            return {"state": UNREACHABLE, "lock": None, "error": self._fault}
        return self._status

    def _listen(self) -> None:
        while True:
            try:
                for status in self._client.watch():
                    self._status, self._heard_s = status, time.monotonic()
            except NoAnswer as error:
                self._set_fault(f"{NO_ANSWER}: {error.reason}")
            except RtloopError as error:
                self._set_fault(str(error))
            time.sleep(RETRY_S)

    def _set_fault(self, fault: str) -> None:
        self._fault, self._heard_s = fault, float("-inf")
