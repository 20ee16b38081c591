"""Rows of other stages: a robust controller is searched and certified for each, which takes minutes."""

from __future__ import annotations

import math

from rtloop.configuration.axis import ModelOptions
from rtloop.design.robust.search import find_robust_controller
from rtloop.design.synthesis.hinf.assumptions import NoController
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.linear.discretise import discretise_controller
from tests.soak.flagship.looped import family_loops, slowest_ringing_ms
from tests.soak.flagship.stage import PERIOD_S, specification
from tests.soak.flagship.stepped import Progress
from tests.soak.flagship.table import Row

RIGS = ((150.0, 0.004, 0), (320.0, 0.02, 1), (700.0, 0.008, 0), (1500.0, 0.02, 1))
"""Resonance (Hz), damping ratio, samples of delay beyond the one of every loop."""
RESTARTS, GENERATIONS = 6, 800


def stage_rows(show_progress: Progress) -> list[Row]:
    """Return the rows of τ and max |S| of each stage, over resonance ±10 %, damping × 0.5 … 2, gain ±5 %."""
    rows = []
    for hz, damping, delay_ticks in RIGS:
        name = f"{hz:g} Hz, damping {damping:g}, {1 + delay_ticks} samples of delay"
        try:
            design = find_robust_controller(stage_specification(hz, damping, delay_ticks))
            certificate, loops = (
                design.certificate,
                family_loops(discretise_controller(design.controller, PERIOD_S, "matched"), design.family),
            )
            decay_ms, ringing_ms, peak, reason = (
                certificate.decay_ms.value,
                slowest_ringing_ms(loops),
                certificate.sensitivity.value,
                "",
            )
        except NoController as error:
            decay_ms, ringing_ms, peak, reason = math.nan, math.nan, math.nan, str(error)
        show_progress(f"{name}: τ {decay_ms:.3g} ms, anywhere {ringing_ms:.3g} ms, max |S| {peak:.3g} {reason}")
        rows += [Row(f"{name}: slowest resonance mode", "ms", 2.0, None, decay_ms, note=reason),
                  Row("  slowest oscillation anywhere", "ms", None, None, ringing_ms),
                  Row("  largest |S|", "", 2.0, None, peak)]  # fmt: skip
    return rows


def stage_specification(hz: float, damping: float, delay_ticks: int) -> DesignOptions:
    """Return the paper's specification for another stage; a lower resonance lowers the bandwidth of the disturbance."""
    design, omega = specification(), 2 * math.pi * hz
    plant = ModelOptions.model_validate(
        {"form": "factors", "gain": omega**2, "numerator": [[1.0]],
         "denominator": [[1.0, 2 * damping * omega, omega**2]], "delay_ticks": delay_ticks}
    )  # fmt: skip
    specified = design.specification
    assert specified.disturbance is not None
    disturbance = specified.disturbance.model_copy(update={"up_to_hz": 10.0 * min(1.0, hz / 595.5)})
    effort = {"restarts": RESTARTS, "generations": GENERATIONS, "decay_ms": None}
    return design.model_copy(
        update={"plant": plant, "specification": specified.model_copy(update={"disturbance": disturbance}),
                "robust": design.robust.model_copy(update=effort)}
    )  # fmt: skip
