"""The contract of a driver.

The loop calls a driver's C functions `read(context, double *in)`, `write(context, const double *out)` and optionally
`wait(context, double *timing)`. Each returns an int32. A status of `read` or `write` below 0 is a failure: the loop
ramps its outputs down and ends. The loop records the status of `read`; above 0 means degraded. `wait` returns 0; any
other value ends the run.

`in` holds the volts of every input channel in the order of the facts, then the age of the sample in µs, then the
observed signals. `out` holds the volts of every output channel. A card that is itself the clock offers `wait`, with
`timing` as rtloop's clocks fill it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from rtloop.foundation.options import Options

ABI_VERSION = 1


class Wiring(NamedTuple):
    """Names of the input and the output channel that an axis uses."""

    input: str
    output: str


@dataclass(frozen=True)
class Channel:
    """An analogue channel: its range in V, and for an output its safe value in V."""

    name: str
    minimum_v: float = -10.0
    maximum_v: float = 10.0
    safe_v: float = 0.0


@dataclass(frozen=True)
class Facts:
    """Properties of a configured driver, known without access to the hardware."""

    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    observed: tuple[str, ...] = ()
    """Names of further signals that `read` returns; they are recorded and never passed to a law."""
    max_rate_hz: float = float("inf")
    """Largest tick rate that the driver allows."""
    exclusive: bool = True
    """Whether one process at a time can open the driver; `open` refuses a second one.

    A statement for other programs: rtloop does not read it.
    """
    hardware_watchdog: bool = False
    """Whether the card itself ramps its outputs to their safe values, when writes cease and when it is opened."""
    delay_ticks: int = 0
    """Ticks from the conversion of a sample to the tick that uses it: 1 for a node whose answer the next tick uses."""
    real: bool = True
    """False if no real actuator is connected to the outputs: virtual time is then allowed."""


class Exchanges(NamedTuple):
    """Measured exchanges with hardware that answers requests: durations in µs of the answered, number of the lost."""

    durations_us: tuple[float, ...]
    lost: int


class Pointers(NamedTuple):
    """Addresses of a driver's C functions and of their context; `wait` is 0 for a driver without it."""

    context: int
    read: int
    write: int
    wait: int = 0
    abi_version: int = ABI_VERSION


class Driver(ABC):
    """A configured driver. The hardware is not accessed before `open`."""

    kind: ClassVar[str]
    options_model: ClassVar[type[Options]] = Options
    example: ClassVar[Wiring] = Wiring("adc0", "dac0")
    """Names of an input and an output channel, for the list of drivers and for examples."""

    def __init__(self, options: Options, wiring: Mapping[str, Wiring], rate_hz: float) -> None:
        """Store options, wiring (channels of each axis, in the order of the axes) and tick rate; nothing is opened or
        checked.

        A driver's own constructor raises ValueError for options or channels that do not fit together.
        """
        self.options = options
        self.wiring = dict(wiring)
        self.rate_hz = rate_hz

    @property
    @abstractmethod
    def facts(self) -> Facts:
        """Facts about the driver with its options and wiring: channels, observed signals, largest rate, delay."""

    @abstractmethod
    def open(self) -> Pointers:
        """Open the hardware and return pointers that are valid until `close`.

        Each output keeps its voltage or goes to its safe value; `outputs_v` then returns the voltages. Raises
        DriverError if the hardware is missing, is used by another program or fails.
        """

    def outputs_v(self) -> Sequence[float] | None:
        """Return the volts at the outputs (in the order of the facts) after `open` and before the first write.

        A card that can read its outputs back returns the readings. The default, all safe values, is for a card that
        `open` has made safe, and for one that parks itself (`hardware_watchdog`). None is for a card that keeps its
        outputs on `open` but cannot read them: the loop then assumes the drives that it recorded last. Raises
        DriverError if the outputs cannot be read or the driver is not open.
        """
        return [channel.safe_v for channel in self.facts.outputs]

    def cautions(self) -> Sequence[str]:
        """Return warnings about the options, a line each, which begins with "driver." and the option's name."""
        return ()

    def measure_exchanges(self, count: int) -> Exchanges | None:
        """Return the durations of `count` exchanges (request and answer) with the hardware, one in each tick's period.

        The outputs are at their safe values. The method opens the driver, which must be closed before, and closes it
        at the end. The default returns None without a measurement, for hardware that answers no requests. Raises
        DriverError like `open`.
        """
        return None

    @abstractmethod
    def close(self) -> None:
        """Set every output to its safe value and release the hardware.

        A call before `open`, or a second call, does nothing. Raises DriverError, after the release, if the outputs
        cannot be set.
        """


def channel_index(channels: Sequence[Channel], name: str) -> int:
    """Return the index in `channels` of the channel with the name `name`.

    Raises ValueError, which lists the names of all channels, if no channel has this name.
    """
    names = [channel.name for channel in channels]
    if name not in names:
        raise ValueError(f"{name!r} is not a channel of this driver; allowed: {', '.join(names)}")
    return names.index(name)


def require_channels(wiring: Mapping[str, Wiring], facts: Facts) -> None:
    """Raise ValueError, which names the axis, if its input is not among the inputs of `facts`, or its output not among
    the outputs.
    """
    for axis, (source, sink) in wiring.items():
        for name, channels in ((source, facts.inputs), (sink, facts.outputs)):
            try:
                channel_index(channels, name)
            except ValueError as error:
                raise ValueError(f"channels.{axis}: {error}") from None
