"""The panel's trigger finds each pulse of one tick at its tick: `make soak NAME=panel-triggers`.

A service on a simulated board plays PULSES pulses of one tick as its reference, at uneven distances. A panel's feed
reads the service as for a browser, with a scope that triggers; the triggers are compared with the recording.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop import load
from rtloop.client.capture.trigger import Sweep
from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.panel.feed.feed import Feed
from rtloop.panel.feed.tick_history import TickHistory
from rtloop.panel.protocol.subscriptions import validate_field
from rtloop.panel.service.service import Description, Service
from rtloop.panel.views.scope import Scope
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for

PULSES, TABLE_PULSES = 10_000, 500
"""Pulses in all, and in one table of samples."""
LEAST_TICKS, MOST_TICKS = 20, 60
"""Distance from one pulse to the next."""
BASE_UM, PULSE_UM = 20.0, 0.5
KINDS: dict[str, dict[str, Any]] = {
    "edge": {"kind": "edge", "level": BASE_UM + PULSE_UM / 2},
    "window": {"kind": "window", "low": BASE_UM - 0.1, "high": BASE_UM + 0.1},
}


class TriggerCounts(NamedTuple):
    """Recorded pulses; pulses without a trigger within a tick; triggers without a pulse within a tick (`made_up`);
    largest distance of the other triggers from their pulses; ticks lost by the feed.
    """

    pulses: int
    missed: int
    made_up: int
    furthest_ticks: int
    lost_ticks: int


class SweepCollector:
    """A viewer of the feed that stores all sweeps of its scope."""

    def __init__(self, trigger: dict[str, Any]) -> None:
        self._subscription = validate_field(
            "view",
            {"signals": ["x_reference_um"], "seconds": 0.001, "pixels": 100,
             "trigger": {"mode": "normal", "source": "x_reference_um", "pre_percent": 25, **trigger}},
        )  # fmt: skip
        self._scope: Scope | None = None
        self.sweeps: list[Sweep] = []

    def begin(self, loop: Description) -> None:
        """Build the scope of a run."""
        self._scope = Scope(self._subscription, loop)

    def feed(self, stretch: Stretch, commands: Any) -> None:
        """Store the sweeps in a stretch of ticks."""
        assert self._scope is not None
        self.sweeps += self._scope.feed(stretch, commands)

    def end_run(self, past: TickHistory) -> None:
        """Do nothing: the service has only one run."""


def play_pulses(folder: Path, pulses: int, seed: int = 1) -> dict[str, TriggerCounts]:
    """Play `pulses` pulses; return the counts by kind of trigger."""
    random = np.random.default_rng(seed)
    change = ('kind = "sine"\namplitude = 8.0\noffset = 20.0\nfrequency_hz = 5.0', f'kind = "hold"\nvalue = {BASE_UM}')
    with Bench(folder, change) as bench:
        bench.await_state("running")
        feed = Feed(Service(bench.client.path))
        collectors = {name: SweepCollector(trigger) for name, trigger in KINDS.items()}
        feed.start()
        try:
            for collector in collectors.values():
                feed.add_viewer(collector)  # type: ignore[arg-type]
            wait_for(lambda: feed.past is not None and feed.past.end > 0, "the feed")
            for first in range(0, pulses, TABLE_PULSES):
                samples = pulse_samples(random, min(TABLE_PULSES, pulses - first))
                body = {"axis": "x", "samples": samples.tolist()}
                end_tick = bench.client.post("/waveform", body)["tick"] + samples.size + 10
                wait_for(lambda end_tick=end_tick: bench.ticks > end_tick, "the end of a table", 600)
            end = bench.ticks
            wait_for(lambda: feed.past is not None and feed.past.end >= end, "the last ticks")
            lost_ticks = feed.lost_ticks
        finally:
            feed.stop()
        assert bench.stop() == 0
    recording = load(sorted((folder / "recordings").glob("*.mcap")))
    high = recording["x_reference_um"] > BASE_UM + PULSE_UM / 2
    pulse_ticks = recording["tick"][np.flatnonzero(high[1:] & ~high[:-1]) + 1].astype(int)
    return {name: compare_triggers(pulse_ticks, collector.sweeps, lost_ticks) for name, collector in collectors.items()}


def pulse_samples(random: np.random.Generator, pulses: int) -> np.ndarray:
    """Return samples (µm), one a tick, with `pulses` pulses of one sample; the first and the last are BASE_UM."""
    places = np.cumsum(random.integers(LEAST_TICKS, MOST_TICKS, pulses))
    samples = np.full(int(places[-1]) + MOST_TICKS, BASE_UM)
    samples[places] += PULSE_UM
    return samples


def compare_triggers(pulse_ticks: np.ndarray, sweeps: list[Sweep], lost_ticks: int) -> TriggerCounts:
    """Compare the triggers with the ticks of the recorded pulses."""
    triggers = np.array([sweep.trigger for sweep in sweeps], int)
    pulse_distances = np.array([np.abs(triggers - tick).min(initial=1 << 30) for tick in pulse_ticks])
    trigger_distances = np.array([np.abs(pulse_ticks - tick).min(initial=1 << 30) for tick in triggers])
    furthest_ticks = int(pulse_distances[pulse_distances <= 1].max(initial=0))
    return TriggerCounts(
        pulse_ticks.size,
        int(np.sum(pulse_distances > 1)),
        int(np.sum(trigger_distances > 1)),
        furthest_ticks,
        lost_ticks,
    )


def main() -> int:
    """Print the counts; return 1 if a pulse was missed or a trigger has no pulse."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pulses", type=int, default=PULSES)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        counts = play_pulses(Path(folder), options.pulses)
    for name, count in counts.items():
        print(f"{name}: {count.pulses} pulses of one tick, {count.missed} missed, {count.made_up} triggers "
              f"without a pulse, placed within {count.furthest_ticks} ticks; "
              f"{count.lost_ticks} ticks lost by the reader")  # fmt: skip
    passed = all(count.pulses == options.pulses and count.missed == count.made_up == 0 for count in counts.values())
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
