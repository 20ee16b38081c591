"""The account of a parking: what was parked, what is to be said beside it, and what failed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rtloop.drivers.errors import DriverError
from rtloop.errors import RtloopError, UnavailableError


class ParkingAccount:
    """Of one `rtloop park`: `from_v` is where the parked outputs were, in V, `remarks` are sentences."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.from_v: list[float] = []
        self.remarks: list[str] = []
        self.failures: list[RtloopError | DriverError] = []

    @contextmanager
    def collect_failures(self) -> Iterator[None]:
        """Enter into the account what fails within, but for UnavailableError: a service is alive."""
        try:
            yield
        except UnavailableError:
            raise
        except (RtloopError, DriverError) as error:
            self.failures.append(error)

    def result(self) -> str:
        """The message of what was done. Raises what failed: one error, or an RtloopError that lists all.

        Its exit code is that of the first failure.
        """
        volts = ", ".join(f"{value:.3f} V" for value in self.from_v)
        message = f"{self._name}: {f'parked from {volts}' if volts else 'no output was parked'}"
        if not self.failures:
            return "\n".join([message, *self.remarks])
        first = self.failures[0]
        if len(self.failures) == 1 and not self.remarks and not volts:
            raise first
        error = RtloopError("\n".join([message, *map(str, self.failures), *self.remarks]))
        error.exit_code = UnavailableError.exit_code if isinstance(first, DriverError) else first.exit_code
        raise error
