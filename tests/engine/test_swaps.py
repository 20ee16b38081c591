"""A thousand changes of controller, gain and mode in one run at 10 kHz under a sine: no bump, identical in replay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.engine.commands import send
from rtloop.engine.messages import Kind, message
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.signals import TRIP_MASK, Mode
from tests.recording.real_loop import ROOT, RealLoop, changed_configuration

SWAPS, SETTLE_TICKS, SPACING = 1000, 4000, 97
SINE = ('kind = "steps"\nlevels = [20.0, 0.0, -20.0, 0.0]\ndwell_s = 0.2',
        'kind = "sine"\namplitude = 20.0\nfrequency_hz = 5.0')  # fmt: skip
LAWS = (
    (),
    (("gain = 0.016", "gain = 0.013"),),
    (('method = "tustin"', 'method = "matched"'), ("prewarp_hz = 595.5\n", "\n")),
    (("[1.0, 974.0]", "[1.0, 900.0]"),),
)
"""Changes to the paper's configuration: none, another gain, another discretisation, another pole."""
MODES = (Mode.FEEDFORWARD, Mode.CLOSED_LOOP)


def record_swaps(path: Path, swaps: int) -> tuple[Path, list[int]]:
    """Record a run with `swaps` swaps, equally long for any number; return its file and the ticks of the swaps."""
    loop = RealLoop(changed_configuration(SINE))
    laws = [
        prepare(parse(changed_configuration(SINE, *law), "law", ROOT, "law"), paced=False).plan.coefficients
        for law in LAWS
    ]
    session = Session(loop.block, path, loop.header, Options(min_free_bytes=0))
    ticks = []

    def advance(count: int) -> None:
        """Run `count` ticks and record them."""
        loop.run(count)
        while session.cursor < loop.tick:
            session.drain()
            session.write_due()

    for _ in range(SETTLE_TICKS // 1000):
        advance(1000)
    for number in range(SWAPS):
        if number < swaps:
            ticks.append(loop.tick)
            if number % 4 < 2:
                law = laws[number // 2 % len(laws)].tobytes()
                loop.block["staged"][: len(law)] = np.frombuffer(law, np.uint8)
                send(loop.block, message(Kind.LOAD_LAW, axis=0, values=[1.0]))
            else:
                send(loop.block, message(Kind.SET_MODE, values=[float(MODES[number % 2])]))
        advance(SPACING)
    session.finish("finished")
    return path, ticks


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a new folder for the recordings."""
    return tmp_path_factory.mktemp("swaps")


def test_a_thousand_swaps(folder: Path):
    swapped, ticks = record_swaps(folder / "swapped.mcap", SWAPS)
    steady, _ = record_swaps(folder / "steady.mcap", 0)
    recording = load(swapped)
    events = [event["kind"] for event in recording.events]
    assert events.count("load_law") == events.count("set_mode") == SWAPS // 2
    assert not np.any(recording["flags"].astype(int) & TRIP_MASK)
    steps_v = np.abs(np.diff(recording["x_demand_v"]))
    steady_v = np.abs(np.diff(load(steady)["x_demand_v"]))[SETTLE_TICKS:].max()
    at_swap_v, next_v = steps_v[np.array(ticks) - 1].max(), steps_v[np.array(ticks)].max()
    print(
        f"{len(ticks)} swaps, largest |Δdemand|: at a swap {at_swap_v:.2g} V, in the tick after it {next_v:.4f} V, "
        f"in the whole run {steps_v[SETTLE_TICKS:].max():.4f} V; in the run without swaps {steady_v:.4f} V"
    )
    assert at_swap_v <= 1.1 * steady_v
    assert next_v <= 1.3 * steady_v  # the demand stands still in the swap's tick and catches up in the next
    verdict = replay(recording)
    assert verdict.identical, verdict.first_difference
    assert verdict.ticks == SETTLE_TICKS + SWAPS * SPACING
