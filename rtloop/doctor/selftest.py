"""Self-test of the configured channels: gain, offset, noise, delay and the highest rate, with each output wired back.

The loop runs in raw mode, as a run would: each output follows a small staircase within the axis's limits, ramped at the
axis's slew rate, and is parked at the end. Then the loop runs with outputs off, at one rate after another until too
many periods are missed. Only the user knows whether a wire connects output and input: without tolerances the report has
figures, and a verdict only on a wrong sign.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from rtloop.configuration.axis import AxisOptions, PrefilterOptions
from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import Prepared, build_driver, prepare
from rtloop.configuration.reference_options import StepsOptions
from rtloop.configuration.schedule import ModeName
from rtloop.doctor.loopback import ChannelPair, measure_pair
from rtloop.drivers.base import Channel, channel_index
from rtloop.errors import LoopFault
from rtloop.recording.load import Recording, load
from rtloop.supervision.host_delay import store_host_delay
from rtloop.supervision.interruption import Interruption
from rtloop.supervision.supervisor import Processes, Supervisor

CYCLES, LEVELS = 5, 4
MIN_DWELL_S, MIN_DWELL_TICKS = 0.05, 40
RATE_TRIAL_S = 0.5
TRIALS = 3
"""Trials at each rate, since a shared host may stop for a while during one of them."""
MISSED_SHARE = 0.01
MAX_RATE_HZ = 100_000.0
"""Highest rate that is tried, a tenth of the highest that a configuration may name."""
MAX_RATE_TRIALS = 6
EXCHANGES = 2000


@dataclass(frozen=True)
class Tolerances:
    """Largest |gain − 1| (V/V) and |offset| (V) of a wire from an output to an input."""

    gain: float
    offset_v: float

    def allow(self, pair: ChannelPair) -> bool:
        """Whether gain and offset of the pair are within the tolerances."""
        return abs(pair.gain - 1.0) <= self.gain and abs(pair.offset_v) <= self.offset_v


@dataclass(frozen=True)
class Staircase:
    """An axis in raw mode with steps about its safe value as its reference."""

    axis: AxisOptions
    steps: StepsOptions

    @property
    def duration_s(self) -> float:
        """Duration of all cycles of the staircase in s."""
        return self.steps.dwell_s * LEVELS * CYCLES


class SelfTest:
    """The self-test of one configuration, with steps of up to `amplitude_v` from the safe value."""

    def __init__(self, configuration: Configuration, amplitude_v: float) -> None:
        """Prepare the staircases; opens no hardware. Raises RtloopError or DriverError for a configuration that cannot
        run.
        """
        self._configuration = configuration
        self._rate_hz = configuration.loop.rate_hz
        self._facts = prepare(_open_loop(configuration, "off", self._rate_hz)).facts
        self._staircases = [
            _staircase(configuration, axis, self._facts.outputs, amplitude_v) for axis in configuration.axes
        ]

    def announcement(self) -> Iterator[str]:
        """Yield lines that say which outputs move, how far and for how long, to be printed before they do."""
        configuration = self._configuration
        yield f"self-test of {configuration.name}, driver {configuration.driver_kind!r}: the outputs move now"
        for staircase in self._staircases:
            axis, levels = staircase.axis, staircase.steps.levels
            channel = configuration.channels[axis.name]
            yield (
                f"  {axis.name}: {channel.output} from {min(levels):g} V to {max(levels):g} V, at most "
                f"{axis.limits.slew_v_per_s:g} V/s, for {staircase.duration_s:.1f} s; measures {channel.input}"
            )

    def run(self, tolerances: Tolerances | None, progress: Callable[[str], None]) -> dict[str, object]:
        """Drive the outputs, measure, and return the report of `_report` as JSON values, with `realtime` (the host's
        grants), `real` (whether the hardware is no simulation), and `exchange` as `_measure_exchanges` returns it.

        `passed` with tolerances: whether all wires are within them. Without: False if a position falls as its drive
        rises, else None. If `passed` is True, the measured delay of each wire is stored for this host. The delay that
        exchanges with a node add is stored whatever `passed` is. `progress` receives a text before the exchanges and
        for each rate. Raises LoopFault for a run that trips, ends early or whose drive did not stand still, and if a
        node answers no exchange; RtloopError and DriverError if a run cannot start, or a delay cannot be stored.
        """
        configuration = self._configuration
        exchange = self._measure_exchanges(progress)
        axes = tuple(staircase.axis for staircase in self._staircases)
        raw = _open_loop(replace(configuration, axes=axes), "raw", self._rate_hz)
        duration_s = max(staircase.duration_s for staircase in self._staircases)
        recording, realtime = _run_and_load(prepare(raw, duration_s=duration_s))
        pairs = {staircase.axis.name: self._measure(recording, staircase) for staircase in self._staircases}
        report = self._report(pairs, list(self._try_rates(progress)), tolerances)
        if report["passed"]:  # a failed loopback does not say what lies between output and input
            wires = {name: pair.delay_ticks for name, pair in pairs.items() if pair.delay_ticks}
            store_host_delay(configuration, wire_ticks=wires)
        if exchange is not None:
            store_host_delay(configuration, exchange_us=exchange["added_us"])
        return report | {"realtime": realtime, "real": self._facts.real, "exchange": exchange}

    def _measure_exchanges(self, progress: Callable[[str], None]) -> dict[str, float] | None:
        """Measure EXCHANGES exchanges with a node; return {count, p50_us, p99_us, max_us, lost, late, added_us}.

        None for a driver without such exchanges. `lost` were not answered, `late` took longer than a period. `added_us`
        is the delay that is added to the model's delay: p99 if a tick waits for its own sample, else the whole periods
        within p99. `progress` receives a text first. Raises DriverError, LoopFault if no exchange was answered.
        """
        configuration = self._configuration
        driver = build_driver(configuration)
        progress(f"{EXCHANGES} exchanges with the node")
        exchanges = driver.measure_exchanges(EXCHANGES)
        if exchanges is None:
            return None
        if not exchanges.durations_us:
            raise LoopFault(f"the node answered none of {exchanges.lost} exchanges; check the line to the node")
        p50_us, p99_us = np.percentile(exchanges.durations_us, [50, 99]).tolist()
        period_us = 1e6 / self._rate_hz
        added_us = p99_us if self._facts.delay_ticks == 0 else math.floor(p99_us / period_us) * period_us
        figures = {"count": EXCHANGES, "p50_us": p50_us, "p99_us": p99_us, "max_us": max(exchanges.durations_us)}
        late = sum(duration_us > period_us for duration_us in exchanges.durations_us)
        return figures | {"lost": exchanges.lost, "late": late, "added_us": added_us}

    def _measure(self, recording: Recording, staircase: Staircase) -> ChannelPair:
        """Return gain, offset, noise and delay of an axis's wire, from its recorded staircase.

        Raises LoopFault if its drive never stood still at two different values.
        """
        name, settling_ticks = staircase.axis.name, round(staircase.steps.dwell_s * self._rate_hz) // 2
        try:
            return measure_pair(recording[f"{name}_drive_v"], recording[f"{name}_adc_v"], settling_ticks)
        except ValueError as error:
            raise LoopFault(f"axis {name}: {error}") from None

    def _try_rates(self, progress: Callable[[str], None]) -> Iterator[tuple[float, float]]:
        """Run the loop at one rate after another, outputs off. Yields (Hz, fraction of periods missed) of each.

        The first rate is the configured one. The rate is doubled while at most MISSED_SHARE of the periods is missed;
        if the first rate misses more, the rate is halved until one does not. At most MAX_RATE_TRIALS rates are tried,
        none above the driver's highest rate or MAX_RATE_HZ.
        """
        rate_hz, factor = self._rate_hz, 2.0
        for index in range(MAX_RATE_TRIALS):
            progress(f"{rate_hz:g} Hz, outputs off")
            missed = self._missed_share(rate_hz)
            yield rate_hz, missed
            if index == 0 and missed > MISSED_SHARE:
                factor = 0.5
            elif (missed > MISSED_SHARE) == (factor > 1.0):
                return
            rate_hz *= factor
            if rate_hz > min(self._facts.max_rate_hz, MAX_RATE_HZ):
                return

    def _missed_share(self, rate_hz: float) -> float:
        """Run with outputs off. Returns the fraction of periods missed, 0 … 1, in the best of up to TRIALS trials."""
        prepared = prepare(_open_loop(self._configuration, "off", rate_hz), duration_s=RATE_TRIAL_S)
        least_share = 1.0
        for _ in range(TRIALS):
            recording, _realtime = _run_and_load(prepared)
            missed = float(np.sum(recording["periods_missed"]))
            least_share = min(least_share, missed / (missed + len(recording)))
            if least_share <= MISSED_SHARE:
                break
        return least_share

    def _report(
        self, pairs: dict[str, ChannelPair], rates: list[tuple[float, float]], tolerances: Tolerances | None
    ) -> dict[str, object]:
        """Return the report, one JSON object, of measured pairs and of rates with their fractions of missed periods.

        Keys: configuration, driver, rate_hz, axes, highest_rate_hz (None if all rates miss too many periods), rates
        ([{rate_hz, missed_share}, …]), tolerances ({gain, offset_v} or None), passed. Each of the list `axes` has:
        axis, output, input, lowest_v, highest_v, gain, offset_v, noise_v, delay_ticks, slope_um_per_v, passed; delay
        and slope are None where the reading does not follow the drive. `passed` is True, False or None as in `run`.
        """
        configuration, rows = self._configuration, []
        for staircase in self._staircases:
            name, levels = staircase.axis.name, staircase.steps.levels
            channel, pair = configuration.channels[name], pairs[name]
            row = {"axis": name, "output": channel.output, "input": channel.input, "lowest_v": min(levels)}
            slope = None if pair.delay_ticks is None else pair.gain * channel.um_per_v
            row |= {"highest_v": max(levels), **asdict(pair), "slope_um_per_v": slope}
            rows.append({**row, "passed": tolerances.allow(pair) if tolerances else _sign_verdict(slope)})
        return {
            "configuration": configuration.name,
            "driver": configuration.driver_kind,
            "rate_hz": self._rate_hz,
            "axes": rows,
            "highest_rate_hz": max((rate_hz for rate_hz, missed in rates if missed <= MISSED_SHARE), default=None),
            "rates": [{"rate_hz": rate_hz, "missed_share": missed} for rate_hz, missed in rates],
            "tolerances": tolerances and asdict(tolerances),
            "passed": False if any(row["passed"] is False for row in rows) else True if tolerances else None,
        }


def _sign_verdict(slope_um_per_v: float | None) -> bool | None:
    """Return False if the position falls as the drive rises, which makes a loop unstable; else None, never True.

    A slope above 0 alone does not show that gain and offset are right.
    """
    return False if slope_um_per_v is not None and slope_um_per_v < 0.0 else None


def _staircase(
    configuration: Configuration, axis: AxisOptions, outputs: tuple[Channel, ...], amplitude_v: float
) -> Staircase:
    """Return the staircase of an axis: safe value, `amplitude_v` above it, safe value, `amplitude_v` below it.

    The axis's limits and the range of its output, one of `outputs`, reduce the steps. Each level is held for longer
    than the ramp to it takes.
    """
    output = outputs[channel_index(outputs, configuration.channels[axis.name].output)]
    lowest = max(output.safe_v - amplitude_v, output.minimum_v, axis.limits.lowest_v)
    highest = min(output.safe_v + amplitude_v, output.maximum_v, axis.limits.drive_v)
    slew = min(axis.limits.slew_v_per_s or math.inf, axis.limits.trip_slew_v_per_s)
    dwell_s = max(MIN_DWELL_S, MIN_DWELL_TICKS / configuration.loop.rate_hz, 4.0 * (highest - lowest) / slew)
    steps = StepsOptions(kind="steps", levels=(output.safe_v, highest, output.safe_v, lowest), dwell_s=dwell_s)
    limits = axis.limits.model_copy(update={"slew_v_per_s": slew})
    return Staircase(axis.model_copy(update={"limits": limits, "reference": steps}), steps)


def _open_loop(configuration: Configuration, mode: ModeName, rate_hz: float) -> Configuration:
    """Return the configuration with `mode` and `rate_hz`, without controllers, models, pre-filters and schedule."""
    loop = configuration.loop.model_copy(update={"mode": mode, "rate_hz": rate_hz})
    update = {"controller": None, "model": None, "prefilter": PrefilterOptions()}
    axes = tuple(axis.model_copy(update=update) for axis in configuration.axes)
    return replace(configuration, loop=loop, axes=axes, schedule=())


def _run_and_load(prepared: Prepared) -> tuple[Recording, dict[str, object]]:
    """Run the loop once, and delete the file of its recording. Returns (recording in memory, host's real-time grants).

    Raises LoopFault for a run that trips or ends early, as by Ctrl-C or SIGTERM; RtloopError or DriverError for a run
    that cannot start.
    """
    with tempfile.TemporaryDirectory(prefix="rtloop-selftest-") as folder, Processes() as processes:
        supervisor = Supervisor(processes, prepared, Path(folder) / "selftest.mcap")
        with Interruption() as interruption:
            interruption.set_supervisor(supervisor)
            result = supervisor.run()
        if result.error or result.outcome != "done":
            raise LoopFault(
                f"the self-test did not finish ({result.outcome}): {result.error or 'ended by Ctrl-C or a signal'}"
            )
        recording = load(result.recordings)
        for event in recording.events:
            if event["kind"] == "tripped":
                causes = ", ".join(event["what"]["causes"])
                raise LoopFault(f"the self-test tripped at tick {event['tick']}: {causes}")
        recording.read(*recording.columns)  # before the file is deleted with its folder
    return recording, supervisor.realtime
