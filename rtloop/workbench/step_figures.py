"""Figures of the recorded steps of each axis, and the limits and claims of its specification."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration
from rtloop.errors import RtloopError
from rtloop.recording.load import Recording
from rtloop.recording.views.steps import StepMetrics, step_metrics
from rtloop.recording.views.summary import Summary
from rtloop.signals import Mode

MAX_STEP_ANALYSIS_TICKS = 6_000_000
STEP_QUANTITIES = ("overshoot_percent", "settling_ms", "static_error_percent")
"""Keys of a specification, in the order of the table's columns."""
MISSED = ", MISSED"
"""Mark behind a limit that is not met."""


class SpecificationRow(NamedTuple):
    """One row of a specification beside the steps: `label`, and a cell for each of STEP_QUANTITIES.

    For a specification that cannot be read, `error` is the reason, and there are no cells.
    """

    label: str
    cells: list[str]
    error: str | None = None


def steps_of_run(summary: Summary, recording: Recording) -> dict[str, StepMetrics]:
    """Return `recorded_steps`; {} after a trip or damage, for an import, and beyond MAX_STEP_ANALYSIS_TICKS."""
    if summary.trips or summary.problems or summary.imported or not 0 < summary.ticks_logged <= MAX_STEP_ANALYSIS_TICKS:
        return {}
    return recorded_steps(recording)


def recorded_steps(recording: Recording) -> dict[str, StepMetrics]:
    """Return the figures of each axis's steps by its name; axes without steps are missing.

    Only ticks in the modes feedforward and closed_loop count, whose reference is in µm.
    """
    is_in_um = np.isin(recording["mode"], (Mode.FEEDFORWARD, Mode.CLOSED_LOOP))
    steps = {}
    for name in recording.header["axes"]:
        reference_um, position_um = (recording[f"{name}_{signal}_um"][is_in_um] for signal in ("reference", "position"))
        metrics = step_metrics(reference_um, position_um, recording.header["rate_hz"])
        if metrics is not None:
            steps[name] = metrics
    return steps


def specification_rows(
    configuration: Configuration, axis: AxisOptions, steps: StepMetrics
) -> Iterator[SpecificationRow]:
    """Yield the limits of an axis's specification, and the figures that it claims, if any.

    A limit that the worst of the `steps` does not meet is marked MISSED. Yields one row with the error for a
    specification that cannot be read, and no row for an axis without one.
    """
    if axis.specification is None:
        return
    from rtloop.design.synthesis.specification_file import load_axis_specification  # slow, and seldom needed
    from rtloop.design.verification.judgement import required_limits

    try:
        specification = load_axis_specification(configuration, axis).design.specification
    except RtloopError as error:
        yield SpecificationRow(axis.specification, [], str(error))
        return
    limits = required_limits(specification)
    worst_values = steps.overshoot_percent_worst, steps.settling_time_ms_worst, steps.static_error_percent_worst
    limit_cells = ["–"] * len(STEP_QUANTITIES)
    for place, (key, worst) in enumerate(zip(STEP_QUANTITIES, worst_values, strict=True)):
        if (limit := limits.get(key)) is not None:
            limit_cells[place] = f"≤ {limit.value:g}" + ("" if limit.accepts(worst) else MISSED)
    yield SpecificationRow(f"{axis.specification} asks", limit_cells)
    if specification.claims:
        claim_cells = [specification.claim_words(key) or "–" for key in STEP_QUANTITIES]
        yield SpecificationRow(f"{axis.specification} claims", claim_cells)
