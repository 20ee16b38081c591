"""Prometheus metrics of a service, computed for each request."""

from __future__ import annotations

import math
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Gauge, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector
from prometheus_client.utils import floatToGoString

from rtloop.service.measuring.condition import Condition
from rtloop.service.measuring.quality import LATENESS_US, Quality
from rtloop.service.service import Service, State
from rtloop.service.status import newest_signals, timing
from rtloop.supervision.recording_state import recording_state


def metrics_text(service: Service) -> str:
    """Return all metrics of a service in Prometheus' text format."""
    registry = CollectorRegistry()
    state = Gauge("rtloop_state", "1 for the state in force", ["state"], registry=registry)
    for member in State:
        state.labels(member.value).set(float(service.state is member))
    supervisor, timings = service.supervisor, timing(service)
    Gauge("rtloop_ticks", "Ticks executed by the present loop", registry=registry).set(
        0 if supervisor is None else supervisor.ticks
    )
    if supervisor is not None:
        recording = recording_state(supervisor.block)
        Gauge("rtloop_recording", "1 while ticks are recorded, else 0", registry=registry).set(
            recording["reason"] is None
        )
        Gauge("rtloop_ticks_not_recorded", "Ticks of the present loop that are in no recording", registry=registry).set(
            recording["ticks_lost"]
        )
        if (quota := supervisor.recorder.quota) is not None:
            Gauge("rtloop_recordings_bytes", "What this configuration's recordings take", registry=registry).set(
                quota.total_bytes
            )
            Gauge("rtloop_recordings_removed", "Files that the quota removed in this run", registry=registry).set(
                quota.removed_files
            )
    Gauge("rtloop_restarts", "Loops that ended before the present one", registry=registry).set(len(service.results))
    if timings:
        Gauge("rtloop_rate_hz", "Rate over the last ticks", registry=registry).set(timings["rate_hz"])
        Gauge("rtloop_overruns", "Overruns in the last ticks", registry=registry).set(timings["overruns"])
        Gauge("rtloop_periods_missed", "Periods missed in the last ticks", registry=registry).set(
            timings["periods_missed"]
        )
        lateness = Gauge("rtloop_lateness_us", "Lateness over the last ticks", ["quantile"], registry=registry)
        for quantile, value in timings["lateness_us"].items():
            lateness.labels(quantile).set(value)
    _add_measurements(service, registry)
    registry.register(_QualityCollector(service.quality))
    if service.live is not None:
        plan = service.live.prepared.plan
        limit = Gauge("rtloop_drive_limit_v", "Limits of the drive", ["axis", "end"], registry=registry)
        for axis, coefficients in zip(plan.axes, plan.coefficients, strict=True):
            for end, name in (("lowest", "drive_min_v"), ("highest", "drive_max_v")):
                limit.labels(axis, end).set(float(coefficients[name]))
    newest = newest_signals(service)
    trip = Gauge("rtloop_trip", "1 for each cause of the trip in force", ["cause"], registry=registry)
    for cause in newest.get("trip", ()):
        trip.labels(cause).set(1)
    condition = Gauge("rtloop_condition", "1 for the condition of an axis in closed loop", ["axis", "condition"],
                      registry=registry)  # fmt: skip
    for axis, axis_condition in newest.get("condition", {}).items():
        for member in Condition:
            condition.labels(axis, member.value).set(float(axis_condition is member))
    axes = newest.get("axes", {})
    signal = Gauge("rtloop_signal", "Newest value of a signal", ["axis", "signal"], registry=registry)
    for axis, values in axes.items():
        for name, value in values.items():
            if value is not None:
                signal.labels(axis, name).set(value)
    return generate_latest(registry).decode()


def _add_measurements(service: Service, registry: CollectorRegistry) -> None:
    """Add margins, resonance and gain of the last measurement, with standard deviations."""
    if not service.measurements:
        return
    measured_at = Gauge(
        "rtloop_measured_unixtime_seconds", "When the loop was last measured", ["axis"], registry=registry
    )
    margin = Gauge("rtloop_margin", "Margin of the loop as last measured", ["axis", "margin"], registry=registry)
    margin_std = Gauge("rtloop_margin_std", "Its standard deviation", ["axis", "margin"], registry=registry)
    mode = Gauge("rtloop_resonance", "Light mode as last measured: hz, damping", ["axis", "of"], registry=registry)
    mode_std = Gauge("rtloop_resonance_std", "Its standard deviation", ["axis", "of"], registry=registry)
    gain = Gauge("rtloop_gain", "Position per command at rest as last measured", ["axis"], registry=registry)
    gain_std = Gauge("rtloop_gain_std", "Its standard deviation", ["axis"], registry=registry)
    for axis, results in service.measurements.items():
        figures = results.newest
        measured_at.labels(axis).set(figures["unix_time_s"])
        for name, margin_figures in figures["margins"].items():
            if margin_figures["value"] is not None:
                margin.labels(axis, name).set(margin_figures["value"])
                margin_std.labels(axis, name).set(margin_figures["std"])
        for name in ("hz", "damping") if figures["resonance"] else ():
            mode.labels(axis, name).set(figures["resonance"][name])
            mode_std.labels(axis, name).set(figures["resonance"][f"{name}_std"])
        if figures["gain"]:
            gain.labels(axis).set(figures["gain"]["value"])
            gain_std.labels(axis).set(figures["gain"]["std"])


class _QualityCollector(Collector):
    """Collector of the sums of Quality, for rates over any interval, and of the last minute's largest values."""

    def __init__(self, quality: Quality) -> None:
        self._quality = quality

    def collect(self) -> Iterator[Metric]:
        """Yield the present values."""
        with self._quality.lock:
            yield from [*self._loop_metrics(), *self._axis_metrics()]

    def _loop_metrics(self) -> Iterator[Metric]:
        sums = self._quality
        for name, help_text, value in (
            ("rtloop_ticks_summed", "Ticks of all loops that the sums are of", sums.ticks),
            ("rtloop_ticks_unseen", "Ticks that were overwritten before they could be summed up", sums.unread_ticks),
            ("rtloop_tick_overruns", "Ticks that ended behind the next deadline", sums.overruns),
            ("rtloop_tick_periods_missed", "Periods that passed unused", sums.periods_missed),
        ):
            yield CounterMetricFamily(name, help_text, value)
        limited = CounterMetricFamily("rtloop_ticks_limited", "Ticks at a limit", labels=["limit"])
        for name, value in sums.limited_ticks.items():
            limited.add_metric([name], value)
        trips = CounterMetricFamily("rtloop_trips", "Trips by cause", labels=["cause"])
        for cause, value in sums.trips.items():
            trips.add_metric([cause], value)
        counts = sums.lateness.cumsum().tolist()
        buckets = list(zip(map(floatToGoString, (*LATENESS_US, math.inf)), counts, strict=True))
        lateness = HistogramMetricFamily("rtloop_tick_lateness_us", "How late ticks began")
        lateness.add_metric([], buckets, sums.lateness_sum_us)
        yield from (limited, trips, lateness)

    def _axis_metrics(self) -> Iterator[Metric]:
        closed_ticks = CounterMetricFamily("rtloop_closed_loop_ticks", "Ticks with an error", labels=["axis"])
        error = CounterMetricFamily(
            "rtloop_error_square_um2", "Sum of the squared error in closed loop", labels=["axis"]
        )
        drive = CounterMetricFamily("rtloop_drive_square_v2", "Sum of the squared drive", labels=["axis"])
        error_peak = GaugeMetricFamily(
            "rtloop_error_peak_um", "Largest error in closed loop, of a minute", labels=["axis"]
        )
        drive_peaks = GaugeMetricFamily(
            "rtloop_drive_peak_v", "Least and largest drive of a minute", labels=["axis", "end"]
        )
        for axis, sums in self._quality.axes.items():
            closed_ticks.add_metric([axis], sums.closed_ticks)
            error.add_metric([axis], sums.error_um2)
            drive.add_metric([axis], sums.drive_v2)
            if sums.peaks:
                errors, lowest, highest = zip(*sums.peaks, strict=True)
                error_peak.add_metric([axis], max(errors))
                drive_peaks.add_metric([axis, "lowest"], min(lowest))
                drive_peaks.add_metric([axis, "highest"], max(highest))
        yield from (closed_ticks, error, drive, error_peak, drive_peaks)
