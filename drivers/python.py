"""Base of drivers written in plain Python: their methods become C functions.

A call costs about 0.4 µs while the interpreter is otherwise idle, as it is in the loop's process. An exception is
kept for `error`, and the loop sees a failed driver.
"""

from __future__ import annotations

import ctypes
from abc import abstractmethod
from collections.abc import Callable, Sequence

from drivers.base import Driver, Facts, Pointers

FAILED = -1
_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.POINTER(ctypes.c_double))


class PythonDriver(Driver):
    """Override `facts`, `start`, `read`, `write` and `stop`; set `sample_age_us` where the hardware knows it."""

    error: Exception | None = None
    sample_age_us: float = 0.0

    @abstractmethod
    def start(self) -> None:
        """Take the hardware, outputs at their safe values. Raises DriverError."""

    @abstractmethod
    def read(self) -> Sequence[float]:
        """Volts of every input channel."""

    @abstractmethod
    def write(self, volts: Sequence[float]) -> None:
        """Set every output channel, in volts."""

    @abstractmethod
    def stop(self) -> None:
        """Let the hardware go; outputs are at their safe values already. May be called again."""

    def observe(self) -> Sequence[float]:
        """Values of the observed signals, as many as the facts declare."""
        return ()

    _callbacks: tuple[Callable[..., int], ...] = ()

    def open(self) -> Pointers:
        """Start the hardware and wrap `read` and `write`."""
        self.start()
        facts: Facts = self.facts
        age, outputs = len(facts.inputs), len(facts.outputs)
        observed = age + 1, age + 1 + len(facts.observed)

        def read(_: int, values: ctypes.Array[ctypes.c_double]) -> int:
            try:
                values[0:age] = self.read()
                values[age] = self.sample_age_us
                if facts.observed:
                    values[observed[0] : observed[1]] = self.observe()
                return 0
            except Exception as error:  # nothing may propagate into compiled code
                self.error = error
                return FAILED

        def write(_: int, values: ctypes.Array[ctypes.c_double]) -> int:
            try:
                self.write(values[0:outputs])
                return 0
            except Exception as error:
                self.error = error
                return FAILED

        self._callbacks = _FUNCTION(read), _FUNCTION(write)
        addresses = [ctypes.cast(callback, ctypes.c_void_p).value or 0 for callback in self._callbacks]  # type: ignore[arg-type]
        return Pointers(0, *addresses)

    def close(self) -> None:
        """Write the safe values, then stop the hardware."""
        if self._callbacks:
            self._callbacks = ()
            try:
                self.write([channel.safe_v for channel in self.facts.outputs])
            finally:
                self.stop()
