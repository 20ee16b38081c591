"""A verification as plain values, for JSON."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from rtloop.analysis.perturbation import Range
from rtloop.design.verification.verify import Row, Scenarios, Verification


def as_dict(found: Verification) -> dict[str, Any]:
    """Null for what is not defined or has no limit."""
    robustness = found.robustness
    return {
        "meets": found.meets,
        "stable": {
            "continuous": None if found.continuous is None else found.continuous.is_stable,
            "running": found.running.is_stable,
        },
        "delay_ticks": found.delay_ticks,
        "rate_hz": 1 / found.running.period_s if found.running.period_s else None,
        "rows": [_row(row) for row in found.rows],
        "resonance_shift_percent": {name: _percent(value) for name, value in robustness.shifts.items()},
        "robustness_percent": {
            name: {limit_kind: value and _percent(value) for limit_kind, value in ranges.items()}
            for name, ranges in robustness.ranges.items()
        },
        "delay_margin_us": _number(robustness.delay_us),
        "more_delay_ticks": robustness.delay_ticks,
        "together": None if found.together is None else found.together.as_dict(),
        "scenarios": None if found.scenarios is None else _scenarios(found.scenarios),
        "host_delay": None if found.host is None else asdict(found.host),
        "simulated": None if found.simulated is None else found.simulated.as_dict(),
        "warnings": list(found.warnings),
    }


def _scenarios(found: Scenarios) -> dict[str, Any]:
    rows = [
        {"name": row.name, "worst": _number(worst.value), "plant": worst.plant, "met": found.met(row, worst)}
        for row, worst in found.rows
    ]
    return {"count": found.count, "rows": rows}


def _row(row: Row) -> dict[str, Any]:
    limit = row.limit
    return {
        "name": row.name,
        "unit": row.unit,
        "required": None if limit is None else {"value": _number(limit.value), "at_most": limit.at_most},
        "continuous": _number(row.continuous),
        "continuous_met": row.met(row.continuous),
        "running": _number(row.running),
        "running_met": row.met(row.running),
        "claim": row.claim or None,
    }


def _percent(found: Range) -> list[float | None]:
    return [None if found.down is None else -found.down, found.up]


def _number(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
