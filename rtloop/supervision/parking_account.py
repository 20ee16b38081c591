"""The account of a parking: voltages of the parked outputs, remarks and failures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rtloop.drivers.errors import DriverError
from rtloop.errors import RtloopError, UnavailableError


class ParkingAccount:
    """Record of one `rtloop park`: name of the service, voltages of the outputs before parking, remarks, failures."""

    def __init__(self, name: str) -> None:
        """Begin an empty account for the service `name`: no voltages, remarks (sentences for the user) or failures."""
        self.name = name
        self.from_v: list[float] = []
        self.remarks: list[str] = []
        self.failures: list[RtloopError | DriverError] = []

    @contextmanager
    def collect_failures(self) -> Iterator[None]:
        """Catch an RtloopError or DriverError within and add it to `failures`.

        An UnavailableError is not caught: it says that a service is alive.
        """
        try:
            yield
        except UnavailableError:
            raise
        except (RtloopError, DriverError) as error:
            self.failures.append(error)

    def result(self) -> str:
        """Return the message for the user, with all remarks, if there is no failure.

        Raises a single failure unchanged if there are no voltages and no remarks; else raises an RtloopError with the
        message, all failures and all remarks. Its exit code is the first failure's; for a DriverError,
        UnavailableError's.
        """
        volts = ", ".join(f"{value:.3f} V" for value in self.from_v)
        message = f"{self.name}: {f'parked from {volts}' if volts else 'no output was parked'}"
        if not self.failures:
            return "\n".join([message, *self.remarks])
        first = self.failures[0]
        if len(self.failures) == 1 and not self.remarks and not volts:
            raise first
        error = RtloopError("\n".join([message, *map(str, self.failures), *self.remarks]))
        error.exit_code = UnavailableError.exit_code if isinstance(first, DriverError) else first.exit_code
        raise error
