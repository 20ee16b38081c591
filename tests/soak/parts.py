"""Hysteresis identified from parts of loops, on rigs drawn at random: unknown memory compared with known memory.

Each rig is recorded one to three times: a loop or less from any point, after a random past, with offset, drift and
noise. The plays are computed here, sample by sample. Held-out errors of both fits are compared in the
samples where the recording itself determines the memory. The true error is over the model's stroke, without noise.
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
MAX_PLAYS = 64
PLAYS_V = np.array(THRESHOLDS_V)
Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Rig:
    """A sum of plays with weights in µm/V. Each recording has the drives since rest before it (V), its drives (V) and
    its positions (µm), each (samples,).
    """

    weights: Array
    past_v: list[Array]
    drives_v: list[Array]
    positions_um: list[Array]
    noise_um: float

    def runs(self) -> list[AxisRecording]:
        """Return the recordings; the position of a tick was measured before its drive was written."""
        period_s = DURATION_S / SAMPLES
        pairs = [
            (np.append(u, u[-1]), np.append(x[0], x)) for u, x in zip(self.drives_v, self.positions_um, strict=True)
        ]
        return [AxisRecording(f"part {i}", period_s, u, x, x, True, "", "") for i, (u, x) in enumerate(pairs)]


def main() -> None:
    """Print a row for each rig; exit with 1 if a ratio of reported errors exceeds ALLOWED_RATIO."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="seed of the first rig")
    options = parser.parse_args()
    print(" rig  files  noise nm  reported µm  known µm  ratio  true ratio  terms")
    ratios, true_ratios, refused = [], [], 0
    for seed in range(options.first, options.first + options.draws):
        rig = random_rig(seed)
        try:
            fit, known_fit = fit_unknown_and_known_memory(rig)
        except UnsuitableData as reason:
            refused += 1
            print(f"{seed:4}{len(rig.drives_v):7}{1e3 * rig.noise_um:10.0f}  refused: {reason}", flush=True)
            continue
        fit_um, known_um = reported_um(fit, fit), reported_um(known_fit, fit)
        true_ratio = true_um(fit, rig, fit.stroke_v) / true_um(known_fit, rig, fit.stroke_v)
        ratios.append(fit_um / known_um)
        true_ratios.append(true_ratio)
        print(
            f"{seed:4}{len(rig.drives_v):7}{1e3 * rig.noise_um:10.0f}{fit_um:13.4f}{known_um:10.4f}"
            f"{fit_um / known_um:7.2f}{true_ratio:12.2f}  {' + '.join(fit.terms) or '–'}",
            flush=True,
        )
    excess_count = sum(ratio > ALLOWED_RATIO for ratio in ratios)
    print(f"{options.draws} rigs, {refused} refused; allowed {ALLOWED_RATIO}")
    for name, values in (("reported", ratios), ("true", true_ratios)):
        count = sum(ratio > ALLOWED_RATIO for ratio in values)
        print(f"ratio, {name}: median {np.median(values):.2f}, largest {max(values):.2f}, {count} above")
    sys.exit(1 if excess_count else 0)


def random_rig(seed: int) -> Rig:
    """Return a random rig: weights of eq (4) ± 20 %, parts of a loop, 10 to 100 nm of noise, ±0.5 µm of drift."""
    random = np.random.default_rng(seed)
    weights = np.array(NOMINAL_WEIGHTS_UM_PER_V) * random.uniform(0.8, 1.2, len(NOMINAL_WEIGHTS_UM_PER_V))
    amplitude_v, noise_um = random.uniform(3, 10), 10 ** random.uniform(-2, -1)
    centre_v = random.uniform(-1, 1) * (10 - amplitude_v)
    rig = Rig(weights, [], [], [], noise_um)
    for _ in range(random.integers(1, 4)):
        angle = random.uniform(0, 2 * np.pi) + random.uniform(0.7, 1.0) * np.linspace(0, 2 * np.pi, SAMPLES)
        drive_v = centre_v + amplitude_v * np.sin(angle)
        past_v = np.array([0.0, *random.uniform(-10, 10, random.integers(0, 6))])
        motion_um = np.array([state @ weights for state in play_states(np.append(past_v, drive_v))[past_v.size :]])
        drift_um = random.uniform(-0.5, 0.5) * np.linspace(0, 1, SAMPLES)
        rig.past_v.append(past_v)
        rig.drives_v.append(drive_v)
        rig.positions_um.append(motion_um + drift_um + random.uniform(-1, 1) + random.normal(0, noise_um, SAMPLES))
    return rig


def fit_unknown_and_known_memory(rig: Rig) -> tuple[PartsFit, PartsFit]:
    """Return the fit with unknown memory, and the fit with known memory.

    The latter has the same plays, and further ones as dense, up to the largest play that can move.
    """
    fit = identify_from_parts(rig.runs())
    thresholds, half_v = fit.hysteresis.model.thresholds, 0.5 * fit.stroke_v
    largest_v = max(float(np.abs(np.append(*drives)).max()) for drives in zip(rig.past_v, rig.drives_v, strict=True))
    count = min(MAX_PLAYS, round(thresholds.size * largest_v / half_v)) - thresholds.size
    further_v = np.linspace(half_v, largest_v, max(0, count), endpoint=False)
    return fit, identify_from_parts(rig.runs(), thresholds_v=[*thresholds, *further_v], before_v=rig.past_v)


def reported_um(fit: PartsFit, blind_fit: PartsFit) -> float:
    """Return the rms (µm) of a fit's held-out errors, in the samples that the fit with unknown memory judged."""
    pairs = zip(fit.judgements, blind_fit.judgements, strict=True)
    squares = [own.error_um[np.isfinite(blind.error_um)] ** 2 for own, blind in pairs if blind.known_share]
    return float(np.sqrt(np.mean([square_um2.mean() for square_um2 in squares])))


def true_um(fit: PartsFit, rig: Rig, stroke_v: float) -> float:
    """Return the standard deviation (µm) of a model's error over loops of `stroke_v` and less, without noise."""
    middle_v = 0.5 * (max(u.max() for u in rig.drives_v) + min(u.min() for u in rig.drives_v))
    sizes = np.interp(np.arange(1200), [0, 600, 1200], [1, 1, 0.3])
    loops_v = middle_v + 0.5 * stroke_v * sizes * np.sin(2 * np.pi * np.arange(1200) / 300)
    truth_um = play_states(loops_v, PLAYS_V, middle_v - PLAYS_V) @ rig.weights
    model = fit.hysteresis.model
    error_um = (play_states(loops_v, model.thresholds, middle_v - model.thresholds) @ model.weights - truth_um)[300:]
    return float(np.std(error_um))


def play_states(drive: Array, thresholds: Array = PLAYS_V, start: Array | float = 0.0) -> Array:
    """Return the states of plays (V), (samples, plays), computed sample by sample from the state `start`."""
    state, states = np.broadcast_to(np.asarray(start, float), thresholds.shape), []
    for u in drive:
        state = np.maximum(u - thresholds, np.minimum(u + thresholds, state))
        states.append(state)
    return np.array(states)


if __name__ == "__main__":
    main()
