"""Prometheus metrics, made when they are asked for."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Gauge, generate_latest

from rtloop.service.service import Service, State
from rtloop.service.status import newest_signals, timing
from rtloop.supervision.recording_state import recording_state


def metrics_text(service: Service) -> str:
    """All metrics of a service, in Prometheus' text format."""
    registry = CollectorRegistry()
    state = Gauge("rtloop_state", "1 for the state in force", ["state"], registry=registry)
    for one in State:
        state.labels(one.value).set(float(service.state is one))
    supervisor, measured = service.supervisor, timing(service)
    Gauge("rtloop_ticks", "Ticks executed by the present loop", registry=registry).set(
        0 if supervisor is None else supervisor.ticks
    )
    if supervisor is not None:
        said = recording_state(supervisor.block)
        Gauge("rtloop_recording", "1 while ticks are recorded, else 0", registry=registry).set(said["reason"] is None)
        Gauge("rtloop_ticks_not_recorded", "Ticks of the present loop that are in no recording", registry=registry).set(
            said["ticks_lost"]
        )
        if (quota := supervisor.recorder.quota) is not None:
            Gauge("rtloop_recordings_bytes", "What this configuration's recordings take", registry=registry).set(
                quota.bytes
            )
            Gauge("rtloop_recordings_removed", "Files that the quota removed in this run", registry=registry).set(
                quota.removed
            )
    Gauge("rtloop_restarts", "Loops that ended before the present one", registry=registry).set(len(service.results))
    if measured:
        Gauge("rtloop_rate_hz", "Rate over the last ticks", registry=registry).set(measured["rate_hz"])
        Gauge("rtloop_overruns", "Overruns in the last ticks", registry=registry).set(measured["overruns"])
        Gauge("rtloop_periods_missed", "Periods missed in the last ticks", registry=registry).set(
            measured["periods_missed"]
        )
        lateness = Gauge("rtloop_lateness_us", "Lateness over the last ticks", ["quantile"], registry=registry)
        for quantile, value in measured["lateness_us"].items():
            lateness.labels(quantile).set(value)
    _measured(service, registry)
    newest = newest_signals(service)
    trip = Gauge("rtloop_trip", "1 for each cause of the trip in force", ["cause"], registry=registry)
    for cause in newest.get("trip", ()):
        trip.labels(cause).set(1)
    axes = newest.get("axes", {})
    signal = Gauge("rtloop_signal", "Newest value of a signal", ["axis", "signal"], registry=registry)
    for axis, values in axes.items():
        for name, value in values.items():
            if value is not None:
                signal.labels(axis, name).set(value)
    return generate_latest(registry).decode()


def _measured(service: Service, registry: CollectorRegistry) -> None:
    """Margins and resonance as they were last measured, with standard deviations."""
    if not service.measured:
        return
    at = Gauge("rtloop_measured_unixtime_seconds", "When the loop was last measured", ["axis"], registry=registry)
    margin = Gauge("rtloop_margin", "Margin of the loop as last measured", ["axis", "margin"], registry=registry)
    margin_std = Gauge("rtloop_margin_std", "Its standard deviation", ["axis", "margin"], registry=registry)
    mode = Gauge("rtloop_resonance", "Light mode as last measured: hz, damping", ["axis", "of"], registry=registry)
    mode_std = Gauge("rtloop_resonance_std", "Its standard deviation", ["axis", "of"], registry=registry)
    for axis, results in service.measured.items():
        newest = results.newest
        at.labels(axis).set(newest["unix_time_s"])
        for name, found in newest["margins"].items():
            if found["value"] is not None:
                margin.labels(axis, name).set(found["value"])
                margin_std.labels(axis, name).set(found["std"])
        for name in ("hz", "damping") if newest["resonance"] else ():
            mode.labels(axis, name).set(newest["resonance"][name])
            mode_std.labels(axis, name).set(newest["resonance"][f"{name}_std"])
