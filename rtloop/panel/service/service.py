"""The service that a panel shows, and its description of the running loop."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtloop.client import Client
from rtloop.client.ticks.tick_stretch import column_index
from rtloop.errors import RtloopError, UnavailableError
from rtloop.foundation import timing
from rtloop.signals import Signal

CACHE_S = 1.0


@dataclass(frozen=True)
class Description:
    """A loop: name, rate, signals of its records, paths of shared block and recordings, configuration."""

    name: str
    rate_hz: float
    columns: tuple[Signal, ...]
    block: Path
    recordings: Path
    values: dict[str, Any]
    """The running configuration, with all changes since its start."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the recorded signals."""
        return tuple(column.name for column in self.columns)

    @property
    def axes(self) -> dict[str, dict[str, Any]]:
        """Table [axis] of the running configuration for each axis, by the axis's name."""
        return {axis["name"]: axis for axis in self.values["axis"]}

    def unit(self, name: str) -> str:
        """Return the unit of a signal. Raises ValueError for a signal that the loop does not have."""
        return self.columns[column_index(name, self.names)].unit

    def has_signals_of(self, loop: Description) -> bool:
        """Return whether another loop has signals of the same names, in the same order, at the same rate."""
        return (self.names, self.rate_hz) == (loop.names, loop.rate_hz)


class Service:
    """Access to the service whose control socket is at `path`; the service may be stopped or start later."""

    def __init__(self, path: Path) -> None:
        """Make the client of the control socket at `path`; no description is cached yet."""
        self.client = Client(path)
        self._cached: tuple[float, Description] | None = None

    def describe(self) -> Description:
        """Return the description of the running loop, at most CACHE_S old; raises as `refresh_description`."""
        cached = self._cached
        if cached is not None and timing.monotonic_s() - cached[0] < CACHE_S:
            return cached[1]
        return self.refresh_description()

    def refresh_description(self) -> Description:
        """Request, cache and return the description of the running loop.

        Raises UnavailableError without a loop, and for a service that refuses, is not trusted or has another version.
        """
        try:
            configuration = self.client.get("/configuration")
            description = Description(
                name=configuration["name"],
                rate_hz=float(configuration["rate_hz"]),
                columns=tuple(Signal(**column) for column in configuration["columns"]),
                block=Path(configuration["block"]),
                recordings=Path(configuration["recordings"]),
                values=configuration["values"],
            )
        except UnavailableError:
            raise
        except RtloopError as error:
            raise UnavailableError(str(error)) from None
        except (KeyError, TypeError):
            reason = "the service has another version of rtloop; start service and panel with the same version"
            raise UnavailableError(f"{self.client.path}: {reason}") from None
        self._cached = timing.monotonic_s(), description
        return description
