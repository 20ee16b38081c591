"""The state that the service reports twenty times a second, received once for all clients."""

from __future__ import annotations

from rtloop.client import Client
from rtloop.client.control import UnansweredRequest
from rtloop.errors import RtloopError
from rtloop.foundation import timing

RETRY_S = 0.5
SILENT_S = 3.0
"""Silence after which a service counts as unreachable; a broken connection counts at once."""
UNREACHABLE = "unreachable"
NO_ANSWER = "the service does not answer"


class StateListener:
    """Receives `/watch` in a thread, and connects again when the connection ends."""

    def __init__(self, client: Client) -> None:
        """Prepare the thread that receives states through `client`; `start` starts the thread."""
        self._client = client
        self._status: dict[str, object] = {}
        self._heard_s = float("-inf")
        self._fault, self._remedy = "no answer from the service yet", ""

    def start(self) -> None:
        """Start the thread, which lives as long as the process."""
        timing.start_thread(self._listen)

    @property
    def status(self) -> dict[str, object]:
        """The newest state, as `Client.watch` yields it.

        Without a connection, or SILENT_S after the newest one: {state: "unreachable", lock: None, error, remedy (may be
        empty)}.
        """
        if timing.monotonic_s() - self._heard_s > SILENT_S:
            return {"state": UNREACHABLE, "lock": None, "error": self._fault, "remedy": self._remedy}
        return self._status

    def _listen(self) -> None:
        """Receive states for ever; after the end of a connection, wait RETRY_S and connect again."""
        while True:
            try:
                for status in self._client.watch():
                    self._status, self._heard_s = status, timing.monotonic_s()
            except RtloopError as error:
                self._fault, self._remedy = str(error), ""
                if isinstance(error, UnansweredRequest):
                    self._fault, self._remedy = f"{NO_ANSWER}: {error.reason}", error.remedy
                self._heard_s = float("-inf")
            timing.sleep(RETRY_S)
