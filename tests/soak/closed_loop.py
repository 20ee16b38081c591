"""Dynamics from loops that stay closed, on many loops drawn at random. `make soak-closed-loop`.

Each draw is a plant of two light modes and a delay, a controller that damps the first of them, and noise far from
white that the loop brings back, simulated by scipy alone (`tests.design.coloured_loops`); the reference is a multisine,
a sweep or steps in turn, of 6 s. Side by side, with the same noise:

- closed: what `identify dynamics` finds in the loop, order and delay and all;
- open: what the same method finds where the plant is moved by the same command without a loop, order and delay given;
- direct: ARMAX by prediction errors on the loop's input and output as if it were open, downhill from the true modes;
- output error: least squares of the simulated output on the same data, downhill from the true modes.

Each error is told in percent, and relative to the Cramér-Rao bound (`tests.design.loop_bound`): the least standard
deviation that any unbiased method can have on such a recording, which is the same for the open loop.

Then runs on the simulated rig in virtual time, recorded and identified as a user does it: eq (5) with its resonance
moved, and rigs of one mode, 10 nm of noise.

Ends with 1 where a frequency is off by more than 0.2 % or a damping by more than 10 %, where the mean over the draws is
not that of nothing but chance, where the standard deviations are not those of the errors, or where the naive methods
are no worse.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop.cli.dynamics import dynamics_report
from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.identification.dynamics.dynamics_fit import Mode
from rtloop.design.identification.dynamics.excitation import LoopExcitation
from rtloop.design.identification.dynamics.identify_delay import delay_input
from rtloop.design.identification.dynamics.identify_in_loop import identify_in_loop
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.markov import fit_residues
from rtloop.design.identification.dynamics.prediction_error import Excitation, minimise_errors, refine
from tests.design.coloured_loops import MOTIONS, PERIOD_S, TrueLoop, coloured, drawn_loop, motion
from tests.design.loop_bound import bounds_percent
from tests.design.measured_loops import TrueLoop as ClosedLoop
from tests.recording.real_loop import record
from tests.soak.response import RESONANCE_HZ, of_eq_5, of_one_mode

HELD = 'kind = "hold"\nvalue = 5.0'
CHIRP = """kind = "chirp"
amplitude = 2.0
start_hz = 5.0
end_hz = 3000.0
duration_s = 4.0
offset = 5.0
logarithmic = true"""
STEPS = 'kind = "steps"\nlevels = [5.0, 15.0, -5.0, 10.0]\ndwell_s = 0.2\nrepeat = true'
EQ_5_DAMPING = 55.0 / 2 / 1.4e7**0.5
SAMPLES, NOISE_UM = 60_000, 0.05
AMPLITUDES_UM = {"multisine": 20.0, "sweep": 8.0, "steps": 20.0}
FREQUENCY_PERCENT, DAMPING_PERCENT = 0.2, 10.0
METHODS = ("closed", "open", "direct", "output error")


class Found(NamedTuple):
    """Errors of the frequencies and dampings of both modes, %; in standard deviations as told, NaN for none; in those
    of the bound."""

    frequencies: tuple[float, float]
    dampings: tuple[float, float]
    normal_frequencies: tuple[float, float]
    normal_dampings: tuple[float, float]
    bound_frequencies: tuple[float, float]
    bound_dampings: tuple[float, float]
    order: int
    late: int


def judged(loop: TrueLoop, bounds: np.ndarray, modes: tuple[Mode, ...], order: int, late: int) -> Found:
    """The nearest mode found beside each of the plant's; `bounds` (modes, 2) in percent."""
    rows = []
    for (hz, damping, _), least in zip(loop.modes, bounds, strict=True):
        mode = min(modes, key=lambda one: abs(np.log(one.frequency_hz / hz)))
        off = 100 * (mode.frequency_hz / hz - 1), 100 * (mode.damping / damping - 1)
        told = 100 * mode.frequency_std_hz / hz, 100 * mode.damping_std / damping
        rows.append((*off, off[0] / told[0], off[1] / told[1], off[0] / least[0], off[1] / least[1]))
    return Found(*zip(*rows, strict=True), order, late)  # type: ignore[arg-type]


def naive(loop: TrueLoop, bounds: np.ndarray, run: Excitation, method: str) -> Found | None:
    """As if the loop were open, from the true modes downhill, as nobody could begin: what is left is bias and noise."""
    rates = np.array([2 * np.pi * hz * (-z + 1j * np.sqrt(1 - z * z)) for hz, z, _ in loop.modes])
    run = delay_input(run, loop.delay_ticks)
    start = fit_residues(Innovations(PERIOD_S, rates, 0 * rates, 0 * rates), run.input, run.position_um)
    found = refine(start, run) if method == "direct" else minimise_errors(start, run, noise=False)
    if found is None:
        return None
    modes = tuple(Mode(abs(s) / 2 / np.pi, np.nan, -s.real / abs(s), np.nan, 0) for s in found.rates)
    return judged(loop, bounds, modes, 4, 0)


def draw(seed: int) -> tuple[str, dict[str, Found | None]]:
    """One loop; None where there is no answer."""
    random = np.random.default_rng(seed)
    loop, kind = drawn_loop(random), MOTIONS[seed % len(MOTIONS)]
    near_hz = loop.modes[0][0] * random.uniform(0.9, 1.1)
    noise = coloured(random, SAMPLES, near_hz, NOISE_UM)
    reference = motion(kind, random, SAMPLES, AMPLITUDES_UM[kind])
    closed, quiet = loop.in_loop(reference, noise), loop.in_loop(reference, 0 * noise)
    opened = loop.open(quiet["command_um"], noise)
    bounds = bounds_percent(loop, quiet["command_um"], near_hz, NOISE_UM)
    swings = [float(np.std(quiet[name]) / np.std(closed[name] - quiet[name])) for name in ("position_um", "command_um")]
    inside, alone = (
        LoopExcitation("drawn", one["command_um"], one["position_um"], PERIOD_S, one["reference_um"][None, :])
        for one in (closed, opened)
    )
    found = {method: naive(loop, bounds, inside, method) for method in ("direct", "output error")}
    runs: tuple[tuple[str, LoopExcitation, dict[str, Any]], ...] = (
        ("closed", inside, {}),
        ("open", alone, {"order": 4, "delay_ticks": loop.delay_ticks}),
    )
    for method, run, known in runs:
        try:
            fit = identify_in_loop(run, **known)
        except UnsuitableData as refusal:
            print(f"draw {seed}, {kind}, {method}: refused: {refusal}", flush=True)
            found[method] = None
        else:
            found[method] = judged(loop, bounds, fit.modes, fit.model.order, fit.delay_ticks - loop.delay_ticks)
    told = "; ".join(f"{method} {_told(found[method])}" for method in METHODS)
    least = ", ".join(f"{f:.3f} % ζ {d:.1f} %" for f, d in bounds)
    hz = " and ".join(f"{mode[0]:.0f}" for mode in loop.modes)
    seen = f"{swings[0]:.0f} in x, {swings[1]:.0f} in v"
    print(f"draw {seed}, {kind}, {hz} Hz, signal over noise {seen}, bound {least}: {told}", flush=True)
    return kind, found


def _told(found: Found | None) -> str:
    if found is None:
        return "–"
    errors = ", ".join(f"{f:+.3f} % ζ {d:+.1f} %" for f, d in zip(found.frequencies, found.dampings, strict=True))
    return f"{errors} (order {found.order}, delay {found.late:+d})"


def show(found: list[dict[str, Found | None]]) -> bool:
    """The distributions; whether the closed loop's keep within what is asked."""
    good, sizes = True, {}
    print(f"\n{'':14}{'':11}{'mean':>9}{'± of it':>9}{'rms':>9}{'largest':>9}{'rms in σ':>10}{'/ bound':>9}")
    for method in METHODS:
        rows = [one[method] for one in found if one[method] is not None]
        for name, limit in (("frequencies", FREQUENCY_PERCENT), ("dampings", DAMPING_PERCENT)):
            values = np.array([getattr(one, name) for one in rows]).ravel()
            normal = np.array([getattr(one, f"normal_{name}") for one in rows]).ravel()
            mean, chance, spread = values.mean(), values.std() / np.sqrt(values.size), np.sqrt(np.mean(normal**2))
            largest, of_bound = np.abs(values).max(), np.array([getattr(one, f"bound_{name}") for one in rows])
            print(
                f"{method:14}{name:11}{mean:9.4f}{chance:9.4f}{np.sqrt(np.mean(values**2)):9.4f}{largest:9.3f}"
                f"{spread:10.2f}{np.sqrt(np.mean(of_bound**2)):9.2f}"
            )
            sizes[method, name] = np.sqrt(np.mean(values**2))
            if method == "closed":
                good &= largest <= limit and abs(mean) <= 3 * chance and 0.7 <= spread <= 1.4
    refused = sum(one["closed"] is None for one in found)
    orders = sum(one["closed"] is not None and one["closed"].order == 4 for one in found)
    delays = sum(one["closed"] is not None and one["closed"].late == 0 for one in found)
    print(f"{len(found)} draws: {refused} refused, order found in {orders}, delay in {delays}")
    for name in ("frequencies", "dampings"):
        pairs = [(one["closed"], one["open"]) for one in found if one["closed"] and one["open"]]
        apart = np.array([np.subtract(getattr(a, name), getattr(b, name)) for a, b in pairs]).ravel()
        chance = apart.std() / np.sqrt(apart.size)
        print(f"{'closed − open':14}{name:11}{apart.mean():9.4f}{chance:9.4f}{np.sqrt(np.mean(apart**2)):9.4f}")
        good &= abs(apart.mean()) <= 3 * chance
    worse = all(sizes[one, name] > sizes["closed", name] for one, name in sizes if one in ("direct", "output error"))
    return good and worse and not refused


RIGS = {
    "320 Hz, chirp": (of_one_mode(ClosedLoop(320.0, 0.01, 2, 25.0)), CHIRP, 320.0, 0.01),
    "1500 Hz, chirp": (of_one_mode(ClosedLoop(1500.0, 0.02, 1, 500.0, kp=0.02)), CHIRP, 1500.0, 0.02),
    "150 Hz, steps": (of_one_mode(ClosedLoop(150.0, 0.02, 0, 20.0)), STEPS, 150.0, 0.02),
    "eq (5) +5 %, chirp": (of_eq_5(0.05, 1, 40.0), CHIRP, 1.05 * RESONANCE_HZ, EQ_5_DAMPING),
    "eq (5) -10 %, chirp": (of_eq_5(-0.1, 0, 40.0), CHIRP, 0.9 * RESONANCE_HZ, EQ_5_DAMPING),
}


def on_the_rig() -> bool:
    """Recordings of the real law on the simulated rig; whether each light mode comes out as it is."""
    good = True
    for name, (case, reference, hz, damping) in RIGS.items():
        with tempfile.TemporaryDirectory() as folder:
            text = case.text.replace(HELD, reference).replace("FOLDER", folder)
            assert reference in text
            path = record(Path(folder) / "loop.mcap", text, 40_000)[0]
            found = dynamics_report([path], input_kind="hysteresis")
        mode = min(found["modes"], key=lambda one: abs(np.log(one["frequency_hz"] / hz)))
        off = 100 * (mode["frequency_hz"] / hz - 1), 100 * (mode["damping"] / damping - 1)
        fine = abs(off[0]) <= FREQUENCY_PERCENT and abs(off[1]) <= DAMPING_PERCENT
        good &= fine
        print(
            f"rig {name}: {mode['frequency_hz']:.3f} ± {mode['frequency_std_hz']:.2g} Hz ({off[0]:+.3f} %), ζ "
            f"{mode['damping']:.5f} ± {mode['damping_std']:.2g} ({off[1]:+.1f} %), order {found['order']}, delay "
            f"{found['delay_ticks']}{'' if fine else '  BAD'}",
            flush=True,
        )
    return good


def main() -> int:
    """All draws, and the rig."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with ProcessPoolExecutor() as pool:
        found = list(pool.map(draw, range(given.seed, given.seed + given.draws)))
    for kind in MOTIONS:
        print(f"\n{kind}")
        show([one for motion_, one in found if motion_ == kind])
    print("\nall")
    return int(not (show([one for _, one in found]) & on_the_rig()))


if __name__ == "__main__":
    sys.exit(main())
