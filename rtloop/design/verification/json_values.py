"""A verification as plain values, for JSON."""

from __future__ import annotations

from dataclasses import asdict

from rtloop.analysis.perturbation import PercentRange
from rtloop.design.verification.verify import Row, ScenarioResults, Verification
from rtloop.values import to_jsonable


def as_dict(verification: Verification) -> dict[str, object]:
    """Return a verification for JSON; null stands for an undefined or infinite value and a missing limit.

    Robustness is computed if it was not before. Keys: meets; stable {continuous, running}; delay_ticks; rate_hz; rows
    (`_row`); resonance_shift_percent {"continuous" or the samples of delay: [−down, up]}; robustness_percent {plant
    parameter: {"continuous", "running" or "running_missed": [−down, up]}}; delay_margin_us; more_delay_ticks, None
    beyond the range searched; together; scenarios (`_scenarios`); host_delay; simulated; warnings, as texts.
    """
    robustness = verification.robustness
    values = {
        "meets": verification.meets_specification,
        "stable": {
            "continuous": None if verification.continuous is None else verification.continuous.is_stable,
            "running": verification.running.is_stable,
        },
        "delay_ticks": verification.delay_ticks,
        "rate_hz": 1 / verification.running.period_s if verification.running.period_s else None,
        "rows": [_row(row) for row in verification.rows],
        "resonance_shift_percent": {name: _percent(value) for name, value in robustness.shifts.items()},
        "robustness_percent": {
            name: {limit_kind: value and _percent(value) for limit_kind, value in ranges.items()}
            for name, ranges in robustness.ranges.items()
        },
        "delay_margin_us": robustness.delay_us,
        "more_delay_ticks": robustness.delay_ticks,
        "together": None if verification.together is None else verification.together.as_dict(),
        "scenarios": None if verification.scenarios is None else _scenarios(verification.scenarios),
        "host_delay": None if verification.host is None else asdict(verification.host),
        "simulated": None if verification.simulated is None else verification.simulated.as_dict(),
        "warnings": list(verification.warnings),
    }
    return to_jsonable(values)


def _scenarios(scenarios: ScenarioResults) -> dict[str, object]:
    """Return {count, rows}; each row has `name`, `worst`, the worst value (may be infinite or NaN), its `plant`, and
    the verdict `met`.
    """
    rows = [
        {
            "name": row.name,
            "worst": worst_value.value,
            "plant": worst_value.plant,
            "met": scenarios.is_met(row, worst_value),
        }
        for row, worst_value in scenarios.rows
    ]
    return {"count": scenarios.count, "rows": rows}


def _row(row: Row) -> dict[str, object]:
    """Return one quantity for JSON: name, unit, required (value, at_most), continuous and running (the values of both
    loops) with continuous_met and running_met, claim; null for none.
    """
    limit = row.limit
    return {
        "name": row.name,
        "unit": row.unit,
        "required": None if limit is None else {"value": limit.value, "at_most": limit.at_most},
        "continuous": row.continuous,
        "continuous_met": row.is_met(row.continuous),
        "running": row.running,
        "running_met": row.is_met(row.running),
        "claim": row.claim or None,
    }


def _percent(tolerated: PercentRange) -> list[float | None]:
    """Return [−down, up] in percent; None for an end at which the search found no failure."""
    return [None if tolerated.down is None else -tolerated.down, tolerated.up]
