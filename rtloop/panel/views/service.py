"""The service that a panel looks at: its control socket, and what it says of the loop that runs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtloop.errors import RtloopError, UnavailableError
from rtloop.service.client import Client
from rtloop.signals import Signal

CACHE_S = 1.0


@dataclass(frozen=True)
class Description:
    """Of a loop: what its records hold, where they lie, and what it is configured for."""

    name: str
    rate_hz: float
    columns: tuple[Signal, ...]
    block: Path
    recordings: Path
    values: dict[str, Any]
    """The configuration as it runs."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the columns."""
        return tuple(column.name for column in self.columns)

    @property
    def axes(self) -> dict[str, dict[str, Any]]:
        """What is configured of each."""
        return {axis["name"]: axis for axis in self.values["axis"]}

    def unit(self, name: str) -> str:
        """Of a signal. Raises ValueError for one that the loop does not have."""
        for column in self.columns:
            if column.name == name:
                return column.unit
        raise ValueError(f"signal {name!r}: not in the record; {', '.join(self.names)} are")


class Service:
    """The service behind the control socket at `path`, whether or not it runs now."""

    def __init__(self, path: Path) -> None:
        self.client = Client(path)
        self._cached: tuple[float, Description] | None = None

    def describe(self) -> Description:
        """As it runs now, at most KEPT_S old. Raises UnavailableError where no loop runs."""
        cached = self._cached
        if cached is not None and time.monotonic() - cached[0] < CACHE_S:
            return cached[1]
        return self.refresh_description()

    def refresh_description(self) -> Description:
        """As `describe`, asked for now."""
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
            configuration = "a service of another version, which does not say where its ticks are"
            raise UnavailableError(f"{self.client.path}: {configuration}") from None
        self._cached = time.monotonic(), description
        return description
