"""Steps of one tick's width, each to be found by the panel's trigger at its tick: `make soak NAME=panel-triggers`.

A service on a simulated board plays pulses of one tick as its reference, PULSES of them at uneven distances. A panel's
feed reads it as it does for a browser, with a scope that looks for edges; what it found is compared with the recording.
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

PULSES, A_TABLE = 10_000, 500
LEAST_TICKS, MOST_TICKS = 20, 60
BASE_UM, PULSE_UM = 20.0, 0.5
KINDS: dict[str, dict[str, Any]] = {
    "edge": {"kind": "edge", "level": BASE_UM + PULSE_UM / 2},
    "window": {"kind": "window", "low": BASE_UM - 0.1, "high": BASE_UM + 0.1},
}


class Found(NamedTuple):
    """Pulses that are recorded; triggers that were missed, made up or more than a tick away; ticks that were lost."""

    pulses: int
    missed: int
    made_up: int
    furthest_ticks: int
    lost_ticks: int


class Catcher:
    """A viewer of the feed that keeps all that its scope finds."""

    def __init__(self, trigger: dict[str, Any]) -> None:
        self._wish = validate_field(
            "view",
            {"signals": ["x_reference_um"], "seconds": 0.001, "pixels": 100,
             "trigger": {"mode": "normal", "source": "x_reference_um", "pre_percent": 25, **trigger}},
        )  # fmt: skip
        self._scope: Scope | None = None
        self.sweeps: list[Sweep] = []

    def begin(self, loop: Description) -> None:
        self._scope = Scope(self._wish, loop)

    def feed(self, stretch: Stretch, commands: Any) -> None:
        assert self._scope is not None
        self.sweeps += self._scope.feed(stretch, commands)

    def end_run(self, past: TickHistory) -> None:
        """There is one run."""


def caught(folder: Path, pulses: int, seed: int = 1) -> dict[str, Found]:
    """What became of `pulses`, by the kind of trigger."""
    random = np.random.default_rng(seed)
    hold = ('kind = "sine"\namplitude = 8.0\noffset = 20.0\nfrequency_hz = 5.0', f'kind = "hold"\nvalue = {BASE_UM}')
    with Bench(folder, hold) as bench:
        bench.await_state("running")
        feed = Feed(Service(bench.client.path))
        catchers = {name: Catcher(trigger) for name, trigger in KINDS.items()}
        feed.start()
        try:
            for catcher in catchers.values():
                feed.add_viewer(catcher)  # type: ignore[arg-type]
            wait_for(lambda: feed.past is not None and feed.past.end > 0, "the feed")
            for first in range(0, pulses, A_TABLE):
                samples = table(random, min(A_TABLE, pulses - first))
                body = {"axis": "x", "samples": samples.tolist()}
                behind = bench.client.post("/waveform", body)["tick"] + samples.size + 10
                wait_for(lambda behind=behind: bench.ticks > behind, "the end of a table", 600)
            end = bench.ticks
            wait_for(lambda: feed.past is not None and feed.past.end >= end, "the last ticks")
            lost = feed.lost_ticks
        finally:
            feed.stop()
        assert bench.stop() == 0
    recording = load(sorted((folder / "recordings").glob("*.mcap")))
    high = recording["x_reference_um"] > BASE_UM + PULSE_UM / 2
    at = recording["tick"][np.flatnonzero(high[1:] & ~high[:-1]) + 1].astype(int)
    return {name: compared(at, catcher.sweeps, lost) for name, catcher in catchers.items()}


def table(random: np.random.Generator, pulses: int) -> np.ndarray:
    """Samples, a tick each, with pulses of one of them; it ends as it began."""
    places = np.cumsum(random.integers(LEAST_TICKS, MOST_TICKS, pulses))
    samples = np.full(int(places[-1]) + MOST_TICKS, BASE_UM)
    samples[places] += PULSE_UM
    return samples


def compared(at: np.ndarray, sweeps: list[Sweep], lost: int) -> Found:
    """Triggers with the pulses that are recorded."""
    triggers = np.array([sweep.trigger for sweep in sweeps], int)
    near = np.array([np.abs(triggers - tick).min(initial=1 << 30) for tick in at])
    alone = np.array([np.abs(at - tick).min(initial=1 << 30) for tick in triggers])
    furthest = int(near[near <= 1].max(initial=0))
    return Found(at.size, int(np.sum(near > 1)), int(np.sum(alone > 1)), furthest, lost)


def main() -> int:
    """The verdict as an exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pulses", type=int, default=PULSES)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = caught(Path(folder), options.pulses)
    for name, one in found.items():
        print(f"{name}: {one.pulses} pulses of one tick, {one.missed} missed, {one.made_up} made up, placed within "
              f"{one.furthest_ticks} ticks; {one.lost_ticks} ticks lost by the reader")  # fmt: skip
    good = all(one.pulses == options.pulses and one.missed == one.made_up == 0 for one in found.values())
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
