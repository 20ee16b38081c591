"""Rows of the comparison for loops: damping, |S| and rejection over all scenarios; disturbance and rest on the rig."""

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
from tests.soak.flagship.stage import (
    PERIOD_S,
    RATE_HZ,
    TRUTH,
    linear_controller,
    rig_bench,
    shifted_plant,
    specification,
)
from tests.soak.flagship.table import Row

LARGEST_UM, HELD_UM, ASKED_HZ = 3.285, 0.1, 10.0
"""Amplitude of the disturbance before D, amplitude that may remain, and its required frequency."""
PLACES_UM = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0)
HZ = np.geomspace(0.1, 1000.0, 4001)
SHOWN_HZ = np.unique(np.concatenate([np.geomspace(1.0, 4900.0, 600), np.linspace(400.0, 800.0, 400)]))


def family_loops(controller: DiscreteController, family: Family) -> list[Loop]:
    """Return the closed loops of a controller: on the model, then in every certified scenario."""
    scenarios = [
        family.nominal,
        *family.corner_scenarios(),
        *family.sweep_scenarios(SWEEP_POINTS),
        *family.random_scenarios(RANDOM_PLANTS, specification().robust.seed),
    ]
    return [
        discrete_loop(controller, family.plant(scenario), scenario.delay_ticks) for scenario in dict.fromkeys(scenarios)
    ]


def slowest_ringing_ms(loops: Iterable[Loop]) -> float:
    """Return the time constant (ms) of the slowest mode that turns faster than it decays; infinite if unstable."""
    slowest_ms = 0.0
    for loop in loops:
        if not loop.is_stable:
            return math.inf
        ringing = loop.rates[np.abs(loop.rates.imag) > np.abs(loop.rates.real)]
        slowest_ms = max(slowest_ms, float(np.max(-1e3 / ringing.real, initial=0.0)))
    return slowest_ms


def rejection_limit_hz(loops: Iterable[Loop]) -> float:
    """Return the frequency below which LARGEST_UM leave at most HELD_UM in each loop; 0 where one is unstable."""
    limit_hz = math.inf
    for loop in loops:
        exceeded = np.flatnonzero(loop.sensitivity(HZ) * LARGEST_UM > HELD_UM) if loop.is_stable else np.array([0])
        limit_hz = min(limit_hz, float(HZ[max(exceeded[0] - 1, 0)]) if loop.is_stable else 0.0)
    return limit_hz


def linear_rows(paper: Configuration, ours: Configuration) -> tuple[list[Row], dict[str, Any]]:
    """Return the rows of certificate and rejection, and the curves of each loop for the picture."""
    design, certificates, curves, limits_hz, ringing_ms = specification(), {}, {}, {}, {}
    assert design.plant is not None
    family = Family(design.plant.transfer(), 0, design.scenarios, PERIOD_S)
    for name, configuration in (("paper", paper), ("ours", ours)):
        controller = linear_controller(configuration)
        certificates[name] = certify(controller, family, design_walls(design), design.robust.seed)
        loops = family_loops(controller, family)
        model, ringing_ms[name] = loops[0], slowest_ringing_ms(loops)
        limits_hz[name] = rejection_limit_hz([model]), rejection_limit_hz(loops)
        gains_db = np.array([20 * np.log10(np.abs(loop.open(SHOWN_HZ))) for loop in loops])
        sensitivities = np.array([loop.sensitivity(SHOWN_HZ) for loop in loops if loop.is_stable])
        curves[name] = {
            "hz": SHOWN_HZ, "open": 20 * np.log10(np.abs(model.open(SHOWN_HZ))),
            "phase": np.rad2deg(np.unwrap(np.angle(model.open(SHOWN_HZ)))),
            "open_band": (gains_db.min(axis=0), gains_db.max(axis=0)), "sensitivity": model.sensitivity(SHOWN_HZ),
            "sensitivity_band": (sensitivities.min(axis=0), sensitivities.max(axis=0)),
            "stable": len(sensitivities), "of": len(loops),
        }  # fmt: skip
    paper_range = stability_range(
        loop_builder(linear_controller(paper)), TRUTH.model, PlantChange(shift_resonance, 12.0, 12.0, 0.25)
    )
    ours_range = stability_range(loop_builder(linear_controller(ours)), TRUTH.model,
                                 PlantChange(shift_resonance, 45.0, 45.0, 0.25))  # fmt: skip
    return [
        Row("slowest resonance mode in every scenario", "ms", 1.5, certificates["paper"].decay_ms.value,
            certificates["ours"].decay_ms.value,
            note=f"{certificates['ours'].plants} plants: {certificates['ours'].decay_ms.scenario}"),
        Row("  slowest oscillation at any frequency", "ms", None, ringing_ms["paper"], ringing_ms["ours"]),
        Row("largest |S| in every scenario", "", 2.0, certificates["paper"].sensitivity.value,
            certificates["ours"].sensitivity.value, note=str(certificates["ours"].sensitivity.scenario)),
        Row("resonance may rise before it is unstable", "%", None, paper_range.up, ours_range.up or 45.0),
        Row("resonance may fall", "%", None, paper_range.down, ours_range.down or 45.0,
            note="up and down, 45 % is as far as is looked"),
        Row("3.285 µm held to 0.1 µm up to: the model", "Hz", 10.0, limits_hz["paper"][0], limits_hz["ours"][0], True),
        Row("  in every scenario", "Hz", 10.0, limits_hz["paper"][1], limits_hz["ours"][1], True),
    ], curves  # fmt: skip


def residual_um(configuration: Configuration, truth_percent: float) -> float:
    """Return the amplitude (µm) of x on the rig under a sine of LARGEST_UM before D; infinite if the loop trips."""
    sine = DisturbanceOptions(sine_um=LARGEST_UM, sine_hz=ASKED_HZ, start_s=0.2)
    run = rig_bench(configuration, shifted_plant(truth_percent), disturbance=sine).run("x", (0.0,), 2.2)
    if int(np.bitwise_or.reduce(run["flags"].astype(np.int64))) != 0:
        return math.inf
    return abs(tone(run["x_true_position_um"][-round(RATE_HZ) :], ASKED_HZ, RATE_HZ).amplitude)


def rest_rms_nm(configuration: Configuration, signal: str) -> float:
    """Return the rms (nm) about the mean of a signal at rest, over PLACES_UM."""
    variances_um2 = []
    for place_um in PLACES_UM:
        run = rig_bench(configuration).run("x", (place_um,), SETTLING_S + REST_S)
        variances_um2.append(run[signal][round(SETTLING_S * RATE_HZ) :].var())
    return 1e3 * float(np.sqrt(np.mean(variances_um2)))


def rig_rows(paper: Configuration, ours: Configuration) -> list[Row]:
    """Return the rows of disturbance and rest, measured on the rig."""
    residuals_um = {name: max(residual_um(configuration, percent) for percent in (-10.0, 0.0, 10.0))
                    for name, configuration in (("paper", paper), ("ours", ours))}  # fmt: skip
    rest_nm: dict[str, Real] = {
        signal: np.array([rest_rms_nm(configuration, f"x_{signal}") for configuration in (paper, ours)])
        for signal in ("true_position_um", "position_um", "command_um")
    }
    rows = [Row("3.285 µm before D at 10 Hz, resonance −10, 0, +10 %: left, on the rig", "µm", HELD_UM,
                residuals_um["paper"], residuals_um["ours"])]  # fmt: skip
    rows.append(Row("x at rest, sensor of 10 nm: true", "nm", 5.0, *rest_nm["true_position_um"].tolist()))
    rows.append(Row("  measured", "nm", None, *rest_nm["position_um"].tolist()))
    rows.append(Row("  v", "nm", None, *rest_nm["command_um"].tolist()))
    return rows
