"""`rtloop.connect`: a running loop from Python and notebooks, by the control API."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from rtloop.errors import RtloopError
from rtloop.service.client.client import Client
from rtloop.service.client.finding import socket_of


class Connection:
    """A loop that runs. What commands return is the tick at which they took effect.

    Commands are given, and recorded, under a name, which takes the lock with the first of them; while somebody else
    holds it, only `stop` is done. As a context manager it releases the lock at its end. Every method raises
    UnavailableError where no service answers, and RtloopError with what the service says against it.
    """

    def __init__(self, client: Client) -> None:
        self._client = client

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(RtloopError):  # somebody else drives, or the service has ended
            self.release()

    @property
    def status(self) -> dict[str, Any]:
        """State, who drives (`lock`), rate, lateness, faults and the newest signals."""
        return self._client.get("/status")

    def take(self, emergency_key: str | None = None) -> dict[str, Any]:
        """Take the lock; from whoever holds it by the emergency key. Says until when it is held."""
        return self._client.lock(emergency_key)

    def release(self) -> None:
        """Drive no longer."""
        self._client.delete("/lock")

    def arm(self) -> None:
        """Allow the outputs to be driven."""
        self._client.post("/arm")

    def start(self) -> int:
        """Set the configured mode."""
        return self._tick("/start")

    def stop(self) -> int:
        """Ramp the outputs to safe and stay there, whoever holds the lock."""
        return self._tick("/stop")

    def reset(self) -> int:
        """Forget latched trips; the outputs stay off."""
        return self._tick("/reset")

    def setpoint(self, axis: str, um: float) -> int:
        """Hold the reference of an axis at a value, in µm (V in raw mode)."""
        return self._tick("/setpoint", axis=axis, value=um)

    def reference(self, axis: str, **settings: Any) -> int:
        """Change the reference of an axis, as in [axis.reference]: `kind="sine", amplitude=5.0, frequency_hz=2.0`."""
        return self._tick("/reference", axis=axis, reference=settings)

    def tune(self, axis: str, section: str, **values: Any) -> int:
        """Change keys of [axis.SECTION]: `"controller", gain=0.012`; verified first, then swapped in bumplessly."""
        return self._tick("/tune", axis=axis, section=section, values=values)

    def _tick(self, resource: str, **body: Any) -> int:
        return int(self._client.post(resource, body)["tick"])


def connect(service: str | Path | None = None, *, as_: str | None = None) -> Connection:
    """A connection to a service: by its name, the path of its control socket, or to the only one that runs.

    `as_` is who drives; without it, everybody who gives no name is one `operator`. Raises UnavailableError where no
    service answers, HostRefused where one is not to be believed, RtloopError for a name that is none.
    """
    if isinstance(service, str) and "/" in service:
        service = Path(service)
    path = service if isinstance(service, Path) else socket_of(service)
    connection = Connection(Client(path, as_))
    _ = connection.status
    return connection
