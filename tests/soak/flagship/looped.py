"""The loops by themselves: damping of the resonance, |S|, disturbances, rest; linear ones over all scenarios."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from rtloop.analysis.closed_loop import Loop, discrete_loop
from rtloop.analysis.perturbation import PlantChange, loop_builder, shift_resonance, stability_range
from rtloop.configuration.file import Configuration
from rtloop.design.robust.certificate import RANDOM_PLANTS, SWEEP_POINTS, certify
from rtloop.design.robust.scenarios import Family
from rtloop.design.robust.search import design_walls
from rtloop.design.verification.simulation import REST_S, SETTLING_S
from rtloop.experiments.lockin import tone
from rtloop.foundation.arrays import Real
from rtloop.hil.options import DisturbanceOptions
from rtloop.linear.discretise import DiscreteController
from tests.soak.flagship.stage import PERIOD_S, RATE_HZ, TRUTH, bench, controller_of, shifted, specification
from tests.soak.flagship.table import Row

LARGEST_UM, HELD_UM, ASKED_HZ = 3.285, 0.1, 10.0
PLACES_UM = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0)
HZ = np.geomspace(0.1, 1000.0, 4001)
SHOWN_HZ = np.unique(np.concatenate([np.geomspace(1.0, 4900.0, 600), np.linspace(400.0, 800.0, 400)]))


def family_loops(controller: DiscreteController, family: Family) -> list[Loop]:
    """On the model, then in every scenario that is certified."""
    scenarios = [
        family.nominal,
        *family.corner_scenarios(),
        *family.sweep_scenarios(SWEEP_POINTS),
        *family.random_scenarios(RANDOM_PLANTS, specification().robust.seed),
    ]
    return [discrete_loop(controller, family.plant(one), one.delay_ticks) for one in dict.fromkeys(scenarios)]


def slowest_ringing_ms(loops: Iterable[Loop]) -> float:
    """Time constant of the slowest pair of modes that turns faster than it decays, at any frequency."""
    found = 0.0
    for loop in loops:
        if not loop.is_stable:
            return math.inf
        ringing = loop.rates[np.abs(loop.rates.imag) > np.abs(loop.rates.real)]
        found = max(found, float(np.max(-1e3 / ringing.real, initial=0.0)))
    return found


def held_up_to_hz(loops: Iterable[Loop]) -> float:
    """Below it 3.285 µm of displacement leave at most 0.1 µm, in each of these loops; 0 where one is unstable."""
    found = math.inf
    for loop in loops:
        beyond = np.flatnonzero(loop.sensitivity(HZ) * LARGEST_UM > HELD_UM) if loop.is_stable else np.array([0])
        found = min(found, float(HZ[max(beyond[0] - 1, 0)]) if loop.is_stable else 0.0)
    return found


def linear_rows(paper: Configuration, ours: Configuration) -> tuple[list[Row], dict[str, Any]]:
    """Certificate and disturbance; curves for the picture."""
    design, proofs, curves, held, ringing = specification(), {}, {}, {}, {}
    assert design.plant is not None
    family = Family(design.plant.transfer(), 0, design.scenarios, PERIOD_S)
    for name, one in (("paper", paper), ("ours", ours)):
        linear = controller_of(one)
        proofs[name] = certify(linear, family, design_walls(design), design.robust.seed)
        others = family_loops(linear, family)
        model, ringing[name] = others[0], slowest_ringing_ms(others)
        held[name] = held_up_to_hz([model]), held_up_to_hz(others)
        answers = np.array([20 * np.log10(np.abs(other.open(SHOWN_HZ))) for other in others])
        sensitivities = np.array([other.sensitivity(SHOWN_HZ) for other in others if other.is_stable])
        curves[name] = {
            "hz": SHOWN_HZ, "open": 20 * np.log10(np.abs(model.open(SHOWN_HZ))),
            "phase": np.rad2deg(np.unwrap(np.angle(model.open(SHOWN_HZ)))),
            "open_band": (answers.min(axis=0), answers.max(axis=0)), "sensitivity": model.sensitivity(SHOWN_HZ),
            "sensitivity_band": (sensitivities.min(axis=0), sensitivities.max(axis=0)),
            "stable": len(sensitivities), "of": len(others),
        }  # fmt: skip
    limits = stability_range(
        loop_builder(controller_of(paper)), TRUTH.model, PlantChange(shift_resonance, 12.0, 12.0, 0.25)
    )
    ours_limits = stability_range(loop_builder(controller_of(ours)), TRUTH.model,
                                 PlantChange(shift_resonance, 45.0, 45.0, 0.25))  # fmt: skip
    return [
        Row("slowest resonance mode in every scenario", "ms", 1.5, proofs["paper"].decay_ms.value,
            proofs["ours"].decay_ms.value, note=f"{proofs['ours'].plants} plants: {proofs['ours'].decay_ms.scenario}"),
        Row("  slowest oscillation at any frequency", "ms", None, ringing["paper"], ringing["ours"]),
        Row("largest |S| in every scenario", "", 2.0, proofs["paper"].sensitivity.value,
            proofs["ours"].sensitivity.value, note=str(proofs["ours"].sensitivity.scenario)),
        Row("resonance may rise before it is unstable", "%", None, limits.up, ours_limits.up or 45.0),
        Row("resonance may fall", "%", None, limits.down, ours_limits.down or 45.0,
            note="up and down, 45 % is as far as is looked"),
        Row("3.285 µm held to 0.1 µm up to: the model", "Hz", 10.0, held["paper"][0], held["ours"][0], True),
        Row("  in every scenario", "Hz", 10.0, held["paper"][1], held["ours"][1], True),
    ], curves  # fmt: skip


def disturbed(configuration: Configuration, truth_percent: float) -> float:
    """Amplitude in µm that a sine of 3.285 µm at 10 Hz, before D, leaves of x on the rig; infinite if it trips."""
    sine = DisturbanceOptions(sine_um=LARGEST_UM, sine_hz=ASKED_HZ, start_s=0.2)
    run = bench(configuration, shifted(truth_percent), disturbance=sine).run("x", (0.0,), 2.2)
    if int(np.bitwise_or.reduce(run["flags"].astype(np.int64))) != 0:
        return math.inf
    return abs(tone(run["x_true_position_um"][-round(RATE_HZ) :], ASKED_HZ, RATE_HZ).amplitude)


def at_rest(configuration: Configuration, name: str) -> float:
    """rms in nm about the mean, over places of the range, of one signal."""
    squares = []
    for place_um in PLACES_UM:
        run = bench(configuration).run("x", (place_um,), SETTLING_S + REST_S)
        squares.append(run[name][round(SETTLING_S * RATE_HZ) :].var())
    return 1e3 * float(np.sqrt(np.mean(squares)))


def rig_rows(paper: Configuration, ours: Configuration) -> list[Row]:
    """Disturbance and rest, as the rig has them."""
    left = {name: max(disturbed(one, percent) for percent in (-10.0, 0.0, 10.0))
            for name, one in (("paper", paper), ("ours", ours))}  # fmt: skip
    still: dict[str, Real] = {
        signal: np.array([at_rest(one, f"x_{signal}") for one in (paper, ours)])
        for signal in ("true_position_um", "position_um", "command_um")
    }
    rows = [Row("3.285 µm before D at 10 Hz, resonance −10, 0, +10 %: left, on the rig", "µm", HELD_UM,
                left["paper"], left["ours"])]  # fmt: skip
    rows.append(Row("x at rest, sensor of 10 nm: true", "nm", 5.0, *still["true_position_um"].tolist()))
    rows.append(Row("  measured", "nm", None, *still["position_um"].tolist()))
    rows.append(Row("  v", "nm", None, *still["command_um"].tolist()))
    return rows
