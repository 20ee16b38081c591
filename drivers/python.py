"""Base of drivers written in Python: their methods become C functions.

A call costs about 0.8 µs in the loop's process, whose interpreter is otherwise idle. An exception is stored in `error`,
and the loop sees a failed driver. An output outside its channel's range also fails.
"""

from __future__ import annotations

import ctypes
from abc import abstractmethod
from collections.abc import Callable, Sequence

from rtloop.drivers.base import Driver, Facts, Pointers
from rtloop.drivers.errors import DriverError

FAILED = -1
_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.POINTER(ctypes.c_double))


class PythonDriver(Driver):
    """Base class: override `facts`, `start`, `read`, `write` and `stop`, and set `sample_age_us` if it is known."""

    error: Exception | None = None
    """First exception of `read` or `write`; None without one."""
    sample_age_us: float = 0.0
    status: int = 0
    """Status of successful reads, recorded by the loop; above 0 means degraded."""

    @abstractmethod
    def start(self) -> None:
        """Open the hardware and make its outputs safe, unless `outputs_v` reads them back.

        Raises DriverError if the hardware is not available.
        """

    @abstractmethod
    def read(self) -> Sequence[float]:
        """Return the volts of every input channel, in the order of the facts; the loop gets `sample_age_us` with them.

        A driver that knows the age of the sample sets `sample_age_us`, in µs, in this method.
        """

    @abstractmethod
    def write(self, volts: Sequence[float]) -> None:
        """Set every output channel to `volts`, in the order of the facts; each value is within its channel's range."""

    @abstractmethod
    def stop(self) -> None:
        """Release the hardware; `close` has written the safe values just before, unless that write failed.

        A repeated call must have no effect.
        """

    def observe(self) -> Sequence[float]:
        """Return the values of the observed signals, in the order of the facts; by default none."""
        return ()

    _callbacks: tuple[Callable[..., int], ...] = ()

    def open(self) -> Pointers:
        """Call `start` and return pointers to C functions that call `read` and `write`.

        They return FAILED, and store the first exception in `error`, if a method raises, if `read` and `observe` return
        another number of values than the facts say, and for an output voltage that is NaN or outside its channel's
        range, before `write` is called. Raises DriverError as `start` does.
        """
        self.start()
        facts: Facts = self.facts
        value_count = len(facts.inputs) + 1 + len(facts.observed)
        output_count, ranges = len(facts.outputs), [(channel.minimum_v, channel.maximum_v) for channel in facts.outputs]

        def read(_: int, values: ctypes.Array[ctypes.c_double]) -> int:
            """Fill `values` with inputs (V), age (µs) and observed signals; return the driver's `status`.

            An exception is stored in the driver's `error`, if it is the first, and FAILED is returned.
            """
            try:
                row = (*self.read(), self.sample_age_us, *self.observe())
                if len(row) != value_count:
                    raise ValueError(
                        f"driver {self.kind!r}: the methods `read` and `observe` together returned {len(row) - 1} "
                        f"numbers; allowed: {value_count - 1}, one for each input and each observed signal in `facts`"
                    )
                for i, value in enumerate(row):
                    values[i] = value
                return self.status
            except Exception as error:  # An exception must not reach compiled code.
                self.error = self.error or error
                return FAILED

        def write(_: int, values: ctypes.Array[ctypes.c_double]) -> int:
            """Set all outputs to the volts at `values` and return 0.

            Returns FAILED for an exception, and for NaN or volts outside a channel's range, without a write. The first
            such error is stored in the driver's `error`.
            """
            try:
                volts = values[0:output_count]
                for value, (minimum_v, maximum_v) in zip(volts, ranges, strict=True):
                    if not minimum_v <= value <= maximum_v:
                        raise ValueError(
                            f"driver {self.kind!r}: write of {value} V; allowed: {minimum_v} … {maximum_v} V"
                        )
                self.write(volts)
                return 0
            except Exception as error:
                self.error = self.error or error
                return FAILED

        self._callbacks = _FUNCTION(read), _FUNCTION(write)
        addresses = [ctypes.cast(callback, ctypes.c_void_p).value or 0 for callback in self._callbacks]  # type: ignore[arg-type]
        return Pointers(0, *addresses)

    def close(self) -> None:
        """Write the safe values, then call `stop`; if the driver is not open, do nothing.

        Raises DriverError, after `stop`, if `write` raises; errors of `stop` pass through.
        """
        if self._callbacks:
            self._callbacks = ()
            try:
                self.write([channel.safe_v for channel in self.facts.outputs])
            except Exception as error:
                raise DriverError(
                    f"driver {self.kind!r}: the outputs could not be made safe ({error}) and may still carry voltage; "
                    "check the amplifier"
                ) from error
            finally:
                self.stop()
