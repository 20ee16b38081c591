"""Hysteresis from parts of loops, on rigs drawn at random: memory estimated beside memory known.

Each rig is recorded once to three times: a loop or less from anywhere, after a random past, with an offset, drift and
noise. The plays are stepped one by one here. Held-out errors are compared in the same samples, those in which memory
is known in any case. Beside them stands the true error: of strokes as long as the model is for, without noise.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData
from rtloop.design.identification.hysteresis.identify_from_parts import PartsFit, identify_from_parts
from rtloop.hil.stages.hysteresis import NOMINAL_WEIGHTS_UM_PER_V, THRESHOLDS_V

SAMPLES, DURATION_S = 3000, 30.0
ALLOWED_RATIO = 1.5
MOST_PLAYS = 64
PLAYS_V = np.array(THRESHOLDS_V)
Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Rig:
    """A sum of plays, the drives it is recorded with, in V since rest, and the positions (samples,), in µm."""

    weights: Array
    past_v: list[Array]
    drives_v: list[Array]
    positions_um: list[Array]
    noise_um: float

    def runs(self) -> list[AxisRecording]:
        """Recordings: a tick's position was measured before its drive was written."""
        period_s = DURATION_S / SAMPLES
        pairs = [
            (np.append(u, u[-1]), np.append(x[0], x)) for u, x in zip(self.drives_v, self.positions_um, strict=True)
        ]
        return [AxisRecording(f"part {i}", period_s, u, x, x, True, "", "") for i, (u, x) in enumerate(pairs)]


def main() -> None:
    """A row for each rig; 1 where an error is above what is allowed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    given = parser.parse_args()
    print(" rig  files  noise nm  reported µm  known µm  ratio  true ratio  terms")
    ratios, true_ratios, refused = [], [], 0
    for seed in range(given.first, given.first + given.draws):
        rig = drawn(seed)
        try:
            found, known = both(rig)
        except UnsuitableData as reason:
            refused += 1
            print(f"{seed:4}{len(rig.drives_v):7}{1e3 * rig.noise_um:10.0f}  refused: {reason}", flush=True)
            continue
        reported, best = reported_um(found, found), reported_um(known, found)
        true = true_um(found, rig, found.stroke_v) / true_um(known, rig, found.stroke_v)
        ratios.append(reported / best)
        true_ratios.append(true)
        print(
            f"{seed:4}{len(rig.drives_v):7}{1e3 * rig.noise_um:10.0f}{reported:13.4f}{best:10.4f}{reported / best:7.2f}"
            f"{true:12.2f}  {' + '.join(found.terms) or '–'}",
            flush=True,
        )
    above = sum(ratio > ALLOWED_RATIO for ratio in ratios)
    print(f"{given.draws} rigs, {refused} refused; allowed {ALLOWED_RATIO}")
    for name, found in (("reported", ratios), ("true", true_ratios)):
        many = sum(ratio > ALLOWED_RATIO for ratio in found)
        print(f"ratio, {name}: median {np.median(found):.2f}, largest {max(found):.2f}, {many} above")
    sys.exit(1 if above else 0)


def drawn(seed: int) -> Rig:
    """Weights of eq (4) ± 20 % each, a loop or less about a centre, 10 to 100 nm of noise, ±0.5 µm of drift."""
    random = np.random.default_rng(seed)
    weights = np.array(NOMINAL_WEIGHTS_UM_PER_V) * random.uniform(0.8, 1.2, len(NOMINAL_WEIGHTS_UM_PER_V))
    amplitude_v, noise_um = random.uniform(3, 10), 10 ** random.uniform(-2, -1)
    centre_v = random.uniform(-1, 1) * (10 - amplitude_v)
    rig = Rig(weights, [], [], [], noise_um)
    for _ in range(random.integers(1, 4)):
        angle = random.uniform(0, 2 * np.pi) + random.uniform(0.7, 1.0) * np.linspace(0, 2 * np.pi, SAMPLES)
        drive = centre_v + amplitude_v * np.sin(angle)
        past = np.array([0.0, *random.uniform(-10, 10, random.integers(0, 6))])
        moved = np.array([state @ weights for state in stepped(np.append(past, drive))[past.size :]])
        drift = random.uniform(-0.5, 0.5) * np.linspace(0, 1, SAMPLES)
        rig.past_v.append(past)
        rig.drives_v.append(drive)
        rig.positions_um.append(moved + drift + random.uniform(-1, 1) + random.normal(0, noise_um, SAMPLES))
    return rig


def both(rig: Rig) -> tuple[PartsFit, PartsFit]:
    """With the memory unknown; and known, with the same plays and as dense ones up to the largest that may move."""
    found = identify_from_parts(rig.runs())
    thresholds, half_v = found.hysteresis.model.thresholds, 0.5 * found.stroke_v
    largest_v = max(float(np.abs(np.append(*one)).max()) for one in zip(rig.past_v, rig.drives_v, strict=True))
    count = min(MOST_PLAYS, round(thresholds.size * largest_v / half_v)) - thresholds.size
    more = np.linspace(half_v, largest_v, max(0, count), endpoint=False)
    return found, identify_from_parts(rig.runs(), thresholds_v=[*thresholds, *more], before_v=rig.past_v)


def reported_um(fit: PartsFit, found: PartsFit) -> float:
    """rms of a fit's held-out errors, in those samples that were judged without knowing the memory."""
    pairs = zip(fit.judgements, found.judgements, strict=True)
    squares = [one.error_um[np.isfinite(judged.error_um)] ** 2 for one, judged in pairs if judged.known_share]
    return float(np.sqrt(np.mean([one.mean() for one in squares])))


def true_um(found: PartsFit, rig: Rig, stroke_v: float) -> float:
    """rms error of loops of this length and smaller ones, memory known, without noise."""
    middle = 0.5 * (max(u.max() for u in rig.drives_v) + min(u.min() for u in rig.drives_v))
    sizes = np.interp(np.arange(1200), [0, 600, 1200], [1, 1, 0.3])
    loops = middle + 0.5 * stroke_v * sizes * np.sin(2 * np.pi * np.arange(1200) / 300)
    truth = stepped(loops, PLAYS_V, middle - PLAYS_V) @ rig.weights
    model = found.hysteresis.model
    error = (stepped(loops, model.thresholds, middle - model.thresholds) @ model.weights - truth)[300:]
    return float(np.std(error))


def stepped(drive: Array, thresholds: Array = PLAYS_V, start: Array | float = 0.0) -> Array:
    """Plays one sample after the other, (samples, plays)."""
    state, found = np.broadcast_to(np.asarray(start, float), thresholds.shape), []
    for u in drive:
        state = np.maximum(u - thresholds, np.minimum(u + thresholds, state))
        found.append(state)
    return np.array(found)


if __name__ == "__main__":
    main()
