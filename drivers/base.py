"""The contract of a driver.

To the loop a driver is `read(context, double *in)`, `write(context, const double *out)` and optionally
`wait(context, double *timing)`, all returning int32: 0 good, > 0 degraded (recorded), < 0 failed (trips the loop).

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
    """An analogue channel: range in V, and for an output the value that is safe."""

    name: str
    minimum_v: float = -10.0
    maximum_v: float = 10.0
    safe_v: float = 0.0


@dataclass(frozen=True)
class Facts:
    """What a driver is; known without touching hardware."""

    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    observed: tuple[str, ...] = ()
    max_rate_hz: float = float("inf")
    exclusive: bool = True
    hardware_watchdog: bool = False
    """True where the card itself ramps its outputs to their safe values, when nobody writes and when it is opened."""
    real: bool = True
    """False where no real actuator hangs on the outputs, so that virtual time is allowed."""


class Pointers(NamedTuple):
    """Addresses of C functions and of their context; 0 for no `wait`."""

    context: int
    read: int
    write: int
    wait: int = 0
    abi_version: int = ABI_VERSION


class Driver(ABC):
    """One backend, configured and not yet open. Nothing touches hardware before `open`."""

    kind: ClassVar[str]
    options_model: ClassVar[type[Options]] = Options
    example: ClassVar[Wiring] = Wiring("adc0", "dac0")
    """Channels that it has by default, for a list of what drivers can do."""

    def __init__(self, options: Options, wiring: Mapping[str, Wiring], rate_hz: float) -> None:
        """`wiring` names the channels of each axis, in the order of the axes.

        Raises ValueError where the options do not fit together.
        """
        self.options = options
        self.wiring = dict(wiring)
        self.rate_hz = rate_hz

    @property
    @abstractmethod
    def facts(self) -> Facts:
        """What this driver is, with these options."""

    @abstractmethod
    def open(self) -> Pointers:
        """Take the hardware. Raises DriverError. What the pointers refer to lives until `close`.

        Outputs that the card can read back stay where they are; the others are at their safe values afterwards.
        """

    def outputs_v(self) -> Sequence[float] | None:
        """Volts at the outputs (in the order of the facts) of a driver that was opened and has not written yet.

        Read back where the card can. The default is for a card that cannot, and that `open` has made safe. None is for
        one that keeps its outputs while it is opened and that nobody can ask: they are then taken to be at the drives
        that the loop noted last. A card that parks itself (`hardware_watchdog`) counts as safe. Raises DriverError.
        """
        return [channel.safe_v for channel in self.facts.outputs]

    @abstractmethod
    def close(self) -> None:
        """Bring every output to its safe value and let the hardware go; again and again without harm."""


def channel_index(channels: Sequence[Channel], name: str) -> int:
    """Position of a channel. Raises ValueError that lists the channels there are."""
    names = [channel.name for channel in channels]
    if name not in names:
        raise ValueError(f"{name!r} is not a channel of this driver; it has {', '.join(names)}")
    return names.index(name)


def require_channels(wiring: Mapping[str, Wiring], facts: Facts) -> None:
    """Raise ValueError, naming the axis, for a channel that a driver does not have."""
    for axis, (source, sink) in wiring.items():
        for name, channels in ((source, facts.inputs), (sink, facts.outputs)):
            try:
                channel_index(channels, name)
            except ValueError as error:
                raise ValueError(f"channels.{axis}: {error}") from None
