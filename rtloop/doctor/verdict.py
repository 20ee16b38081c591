"""The verdict on a host: the reasons that make it unsuitable for a loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rtloop.analysis.margins import delay_margin
from rtloop.configuration.prepare import Prepared
from rtloop.doctor.examine import Examination, Latency

LATE_SHARE = 0.001
US_PER_S = 1e6


@dataclass(frozen=True)
class AxisDelay:
    """Phase that the measured lateness costs an axis at its tightest crossover, and the tolerated lateness.

    `p50_deg` and `p99_deg` belong to the median and the 99 % quantile (`p99_us`) of the lateness.
    """

    axis: str
    crossover_hz: float
    tolerated_us: float
    p50_deg: float
    p99_deg: float
    p99_us: float


def axis_delays(prepared: Prepared, latency: Latency) -> list[AxisDelay]:
    """Return for each axis the phase 360° · f · lateness at the crossover f with the least delay margin, for the median
    and for the 99 % quantile of the lateness, and the delay margin.

    Axes whose loop is unstable are left out, and axes without a loop: without a controller that can be linearised, or
    without a model.
    """
    delays, (p50_us, p99_us) = [], (latency.quantile_us(0.5), latency.quantile_us(0.99))
    for check in prepared.checks:
        if check.on_model is None or not check.on_model.is_stable:
            continue
        tolerated_s, crossover_hz = delay_margin(check.on_model)
        p50_deg, p99_deg = (360 * crossover_hz * late_us / US_PER_S for late_us in (p50_us, p99_us))
        delays.append(AxisDelay(check.name, crossover_hz, US_PER_S * tolerated_s, p50_deg, p99_deg, p99_us))
    return delays


def reasons_unsuitable(examination: Examination, delays: Sequence[AxisDelay] = ()) -> list[str]:
    """Return the reasons that make the host unsuitable for the loop, a sentence each; [] where it is suitable.

    Reasons are: a bad condition that can make a tick late by more than a period, measured ticks that were late by more
    than a period, and an axis in `delays` for which one tick in a hundred is later than the axis's loop tolerates.
    """
    latency = examination.latency
    objections = [
        f"{finding.condition}: {finding.value}; {finding.consequence}"
        for finding in examination.findings
        if finding.good is False and finding.late_us > latency.period_us
    ]
    worst_us, missed = latency.quantile_us(1.0), int(latency.missed.sum())
    if latency.late_share >= LATE_SHARE:
        objections.append(f"measured: {100 * latency.late_share:.2f} % of the ticks were late by more than a period")
    elif worst_us > latency.period_us:
        objections.append(f"measured: a tick was {worst_us:.0f} µs late, and {missed} periods were missed")
    for delay in delays:
        if delay.p99_us > delay.tolerated_us:
            objections.append(
                f"axis {delay.axis}: a delay of {delay.tolerated_us:.0f} µs makes its loop unstable, and one tick in "
                f"a hundred is {delay.p99_us:.0f} µs late"
            )
    return objections
