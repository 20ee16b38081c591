"""Plan of a run: all data that the loop's process needs, fixed beforehand and passed as one pickled value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.drivers.base import Driver, Facts, Wiring
from rtloop.drivers.registry import driver_class
from rtloop.engine.memory import Sizes
from rtloop.kernel.extras import Extras
from rtloop.kernel.memory import NO_EXTRAS, Layout
from rtloop.laws.registry import LawReference, law_layout
from rtloop.signals import Mode, column_names


class Hold(NamedTuple):
    """Extra input that holds the references while it is high, at `min_v` or above, or else while it is low."""

    input: str
    min_v: float
    while_high: bool = True


@dataclass(frozen=True)
class Pacing:
    """Timing of the ticks. `paced` False is virtual time: no clock, no real-time scheduling."""

    rate_hz: float
    paced: bool = True
    spin_us: float = 0.0
    """Time before each deadline in which the clock spins instead of sleeping."""
    priority: int = 80
    """Priority of SCHED_FIFO."""
    cpu: int | None = None
    """Processor to which the loop is pinned; None for any."""
    require_realtime: bool = False
    """Whether the run is refused if the host refuses SCHED_FIFO or locked memory."""
    heartbeat_timeout_s: float = 1.0
    """Age of the supervisor's heartbeat from which the loop trips and ends."""
    simulated_lateness_us: tuple[float, ...] = ()
    """Lateness of ticks in virtual time, of which each tick draws one; empty: no tick is late."""
    lateness_seed: int = 0
    """Seed of the draws."""


@dataclass(frozen=True)
class Plan:
    """Plan of one run: laws, driver, references, schedule. With `ticks` None it runs until a stop."""

    name: str
    axes: tuple[str, ...]
    pacing: Pacing
    ticks: int | None
    driver_kind: str
    driver_options: Mapping[str, object]
    wiring: Mapping[str, Wiring]
    laws: tuple[LawReference, ...]
    """Laws available to the loop; the coefficients refer to them by index."""
    coefficients: npt.NDArray[np.void]
    """Coefficients of each axis and its laws, (axes,), records of `layout.coefficients`."""
    mode: Mode
    generators: npt.NDArray[np.void]
    """Reference generators at the start, (axes,), GENERATOR records."""
    table: npt.NDArray[np.float64]
    """Samples of all tables that generators play, one table after the other, in µm (V in mode raw)."""
    schedule: npt.NDArray[np.void]
    """Commands, MESSAGE records in the order of their ticks."""
    observed: tuple[str, ...]
    """Names of the signals that the driver observes; they are recorded and never passed to a law."""
    enable_input: str | None = None
    """Channel of the enable switch; None without one."""
    extras: Extras = NO_EXTRAS
    extra_channels: Mapping[str, str] = field(default_factory=dict)
    """Channel of each extra input and output."""
    hold: Hold | None = None
    """Extra input that holds the references."""
    spare_samples: int = 0
    """Samples reserved behind `table` for waveforms loaded while the loop runs."""

    @property
    def layout(self) -> Layout:
        """Types of the records with which the plan's laws run: an axis's coefficients, and its state."""
        return law_layout(self.laws)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the values in a tick's record, in the order of the record."""
        return column_names(self.axes, self.observed, self.extras.columns)

    @property
    def sizes(self) -> Sizes:
        """Dimensions of the shared block: columns, axes, rate, bytes of a snapshot, samples of `table` plus
        `spare_samples`.
        """
        axes = len(self.axes)
        samples = self.table.size + self.spare_samples
        return Sizes(len(self.columns), axes, self.pacing.rate_hz, self.layout.snapshot_bytes(axes), samples)

    @property
    def trip_slew_v_per_s(self) -> float:
        """Slew rate in V/s of ramps outside the loop (before and after its ticks, parking): the lowest of all axes.

        In the loop, after a trip or stop, each axis ramps with its own slew rate.
        """
        return float(np.min(self.coefficients["trip_slew_v_per_tick"])) * self.pacing.rate_hz

    def driver(self) -> Driver:
        """Return the driver, not opened.

        Raises ValueError for an unknown kind, and for options, wiring or a rate that it does not allow; DriverError if
        a library that it needs is missing.
        """
        kind = driver_class(self.driver_kind)
        return kind(kind.options_model(**self.driver_options), self.wiring, self.pacing.rate_hz)


def require_facts(driver: Driver, rate_hz: float, paced: bool) -> Facts:
    """Return the driver's facts.

    Raises ValueError for a rate above their `max_rate_hz`, and for virtual time (`paced` False) on real hardware.
    """
    facts = driver.facts
    if rate_hz > facts.max_rate_hz:
        raise ValueError(
            f"loop.rate_hz: {rate_hz:g} Hz; allowed with driver {driver.kind!r}: at most {facts.max_rate_hz:g} Hz"
        )
    if facts.real and not paced:
        raise ValueError(
            f"driver {driver.kind!r} moves real hardware and cannot run in virtual time; leave out --unpaced"
        )
    return facts
