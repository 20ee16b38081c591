"""`rtloop.connect`: a running loop from Python and notebooks, by the control API."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtloop.errors import RtloopError
from rtloop.service.client import Client
from rtloop.service.client.control_socket import find_control_socket

if TYPE_CHECKING:  # half a second of import, for those who capture
    from rtloop.panel.conditions import Condition
    from rtloop.recording.load import Recording


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

    def mode(self, mode: str) -> int:
        """Change the mode bumplessly: "off", "raw", "feedforward" or "closed_loop"."""
        return self._tick("/mode", mode=mode)

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

    def capture(
        self,
        seconds: float,
        trigger: Condition | None = None,
        *,
        at: int | None = None,
        pre_percent: float = 50.0,
        timeout_s: float = 60.0,
        folder: Path | str | None = None,
    ) -> Recording:
        """A stretch of `seconds`, every tick of it, as a recording of its own: what `rtloop.load` returns.

        With `trigger`, an `rtloop.Edge("x_position_um", 5.0)`, `Window`, `Stepped`, `Tripped`, `ModeChanged` or
        `Late`, it lies about the first tick from now on that meets it, looked for at the loop's full rate; no more
        than `timeout_s` are waited. With `at` it lies about that tick, such as one that a command returned.
        `pre_percent` of it, 0 … 100, come before that tick. With neither it is what comes from now on.

        The file is NAME.capture-TICK.mcap beside the run's recording, or in `folder`. In front of the stretch it has
        what leads to it from the last recorded state of the law, at most a second, so that it replays by itself.
        Raises ValueError for arguments that are not allowed, RtloopError where no trigger came or nothing is recorded.
        """
        from rtloop.panel.triggered_capture import capture_stretch

        return capture_stretch(self._client, seconds, trigger, at, pre_percent, timeout_s, folder)

    def _tick(self, resource: str, **body: Any) -> int:
        return int(self._client.post(resource, body)["tick"])


def connect(service: str | Path | None = None, *, as_: str | None = None) -> Connection:
    """A connection to a service: by its name, the path of its control socket, or to the only one that runs.

    `as_` is who drives; without it, everybody who gives no name is one `operator`. Raises UnavailableError where no
    service answers, HostRefused where one is not to be believed, RtloopError for a name that is none.
    """
    if isinstance(service, str) and "/" in service:
        service = Path(service)
    path = service if isinstance(service, Path) else find_control_socket(service)
    connection = Connection(Client(path, as_))
    _ = connection.status
    return connection
