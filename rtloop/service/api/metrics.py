"""Prometheus metrics of a service, computed for each request."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector
from prometheus_client.utils import floatToGoString

from rtloop.service.measuring.condition import Condition
from rtloop.service.measuring.quality import LATENESS_US, Quality
from rtloop.service.service import Service, State
from rtloop.service.status import WINDOW_TICKS, newest_signals, timing
from rtloop.supervision.recording_state import recording_state

US_PER_S = 1e6
Family = type[CounterMetricFamily | GaugeMetricFamily]
Samples = Iterable[tuple[*tuple[str, ...], float | None]]
"""Tuples of label values and a value; values of None are left out."""


def metrics_text(service: Service) -> str:
    """Return all metrics of a service in Prometheus' text format."""
    registry = CollectorRegistry()
    registry.register(ServiceCollector(service))
    registry.register(QualityCollector(service.quality))
    return generate_latest(registry).decode()


def _family(kind: Family, name: str, text: str, samples: Samples, labels: Sequence[str] = ()) -> Metric:
    """Return the metric `name` of class `kind` with the help `text` and all `samples` whose value is not None.

    `labels` are the names of the label values that precede the value in each sample.
    """
    family = kind(name, text, labels=labels)
    for *label_values, value in samples:
        if value is not None:
            family.add_metric(label_values, value)
    return family


class ServiceCollector(Collector):
    """Collector of the present state of a service and of its last measurements."""

    def __init__(self, service: Service) -> None:
        """Collect from `service` at each `collect`."""
        self._service = service

    def collect(self) -> Iterator[Metric]:
        """Yield a gauge for each metric of `_state` and `_measurements`, with the present values."""
        for name, text, labels, samples in (*self._state(), *self._measurements()):
            yield _family(GaugeMetricFamily, name, text, samples, labels)

    def _state(self) -> Iterator[tuple[str, str, tuple[str, ...], Samples]]:
        """Yield (name, help, names of labels, samples) for state, loop, recording, timing, drive limits, trip,
        conditions and newest signals. Without a loop, only state, ticks and restarts have samples.
        """
        service, supervisor, state = self._service, self._service.supervisor, self._service.state
        yield (
            "rtloop_state",
            "1 for the present state of the service, 0 for the others",
            ("state",),
            [(one.value, state is one) for one in State],
        )
        ticks = 0 if supervisor is None else supervisor.ticks
        yield "rtloop_ticks", "Ticks executed by the present loop", (), [(ticks,)]
        yield "rtloop_restarts", "Loops that ended before the present one", (), [(len(service.results),)]
        if supervisor is not None:
            recording, quota = recording_state(supervisor.block), supervisor.recorder.quota
            yield "rtloop_recording", "1 while ticks are recorded, else 0", (), [(recording["reason"] is None,)]
            lost_ticks = recording["ticks_lost"]
            yield "rtloop_ticks_not_recorded", "Ticks of the present loop that are in no file", (), [(lost_ticks,)]
            if quota is not None:
                text = "Size of all recordings of this configuration, bytes"
                yield "rtloop_recordings_bytes", text, (), [(quota.total_bytes,)]
                yield (
                    "rtloop_recordings_removed",
                    "Recording files removed because of recording.keep_gib or recording.min_free_mib",
                    (),
                    [(quota.removed_files,)],
                )
        if timings := timing(service):
            newest = f", over the newest {WINDOW_TICKS} ticks at most"
            yield "rtloop_rate_hz", f"Ticks per second{newest}", (), [(timings["rate_hz"],)]
            text = f"Ticks that ended after the next tick was due{newest}"
            yield "rtloop_overruns", text, (), [(timings["overruns"],)]
            yield "rtloop_periods_missed", f"Periods without a tick{newest}", (), [(timings["periods_missed"],)]
            lateness = [(name, value_us / US_PER_S) for name, value_us in timings["lateness_us"].items()]
            text = f"Lateness of ticks, s: median (p50), 99 % quantile (p99) and largest (max){newest}"
            yield "rtloop_lateness_seconds", text, ("statistic",), lateness
        if (live := service.live) is not None:
            plan, ends = live.prepared.plan, {"lowest": "drive_min_v", "highest": "drive_max_v"}
            limits = [(axis, end, float(coefficients[key])) for end, key in ends.items()
                      for axis, coefficients in zip(plan.axes, plan.coefficients, strict=True)]  # fmt: skip
            yield "rtloop_drive_limit_v", "Limits of the drive, V", ("axis", "end"), limits
        newest = newest_signals(service)
        causes = [(cause, 1) for cause in newest.get("trip", ())]
        yield "rtloop_trip", "1 for each cause of the present trip", ("cause",), causes
        conditions = [(axis, member.value, condition is member) for axis, condition in
                      newest.get("condition", {}).items() for member in Condition]  # fmt: skip
        yield (
            "rtloop_condition",
            "1 for the present condition of an axis in closed loop, 0 for the others",
            ("axis", "condition"),
            conditions,
        )
        values = [(axis, name, value) for axis, signals in newest.get("axes", {}).items()
                  for name, value in signals.items()]  # fmt: skip
        yield "rtloop_signal", "Newest value of a signal", ("axis", "signal"), values

    def _measurements(self) -> Iterator[tuple[str, str, tuple[str, ...], Samples]]:
        """Yield (name, help, names of labels, samples) for the last measurement of each axis; nothing before the first.

        The metrics are time, margins, resonance and gain of the measurement, the last three with standard deviations.
        """
        newest = {axis: results.newest for axis, results in self._service.measurements.items()}
        if not newest:
            return
        times = [(axis, figures["unix_time_s"]) for axis, figures in newest.items()]
        yield (
            "rtloop_measured_unixtime_seconds",
            "Time of the last measurement of the axis, s since 1970",
            ("axis",),
            times,
        )
        for suffix, key, note in (("", "value", " as last measured"), ("_std", "std", ", standard deviation")):
            margins = [(axis, name, margin[key]) for axis, figures in newest.items()
                       for name, margin in figures["margins"].items() if margin["value"] is not None]  # fmt: skip
            yield f"rtloop_margin{suffix}", f"Margin of the loop{note}", ("axis", "margin"), margins
            resonances = [(axis, name, figures["resonance"][name + suffix]) for axis, figures in newest.items()
                          for name in ("hz", "damping") if figures["resonance"]]  # fmt: skip
            yield (
                f"rtloop_resonance{suffix}",
                f"Frequency (hz) and damping ratio (damping) of the resonance{note}",
                ("axis", "of"),
                resonances,
            )
            gains = [(axis, figures["gain"][key]) for axis, figures in newest.items() if figures["gain"]]
            yield f"rtloop_gain{suffix}", f"Static gain, µm of position per µm of command{note}", ("axis",), gains


class QualityCollector(Collector):
    """Collector of the sums of Quality, for rates over any interval, and of the last minute's largest values."""

    def __init__(self, quality: Quality) -> None:
        """Collect from the sums of `quality` at each `collect`."""
        self._quality = quality

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics of `_loop_metrics` and `_axis_metrics`, all of one moment, also while no loop runs."""
        with self._quality.lock:
            yield from [*self._loop_metrics(), *self._axis_metrics()]

    def _loop_metrics(self) -> Iterator[Metric]:
        """Yield counters of ticks, overruns, missed periods, limited ticks and trips, and a histogram of the lateness
        (s), over all loops since the start of the service.
        """
        sums = self._quality
        for name, text, labels, samples in (
            (
                "rtloop_ticks_summed",
                "Ticks that the service has read and summed, in all loops since its start",
                (),
                [(sums.ticks,)],
            ),
            (
                "rtloop_ticks_unseen",
                "Ticks that the loop overwrote before the service read them",
                (),
                [(sums.unread_ticks,)],
            ),
            ("rtloop_tick_overruns", "Ticks that ended after the next tick was due", (), [(sums.overruns,)]),
            ("rtloop_tick_periods_missed", "Periods without a tick", (), [(sums.periods_missed,)]),
            (
                "rtloop_ticks_limited",
                "Ticks in which a limit changed the command, the drive or its slew rate",
                ("limit",),
                sums.limited_ticks.items(),
            ),
            ("rtloop_trips", "Trips by cause", ("cause",), sums.trips.items()),
        ):
            yield _family(CounterMetricFamily, name, text, samples, labels)
        bounds = (*(bound_us / US_PER_S for bound_us in LATENESS_US), math.inf)
        buckets = list(zip(map(floatToGoString, bounds), sums.lateness.cumsum().tolist(), strict=True))
        lateness = HistogramMetricFamily("rtloop_tick_lateness_seconds", "Lateness of ticks, s")
        lateness.add_metric([], buckets, sums.lateness_sum_us / US_PER_S)
        yield lateness

    def _axis_metrics(self) -> Iterator[Metric]:
        """Yield the sums of each axis as counters, and as gauges its largest |error| (µm) and its lowest and highest
        drive (V) of the last minute.
        """
        axes = self._quality.axes
        for name, text, field in (
            ("rtloop_closed_loop_ticks", "Ticks in closed loop", "closed_ticks"),
            ("rtloop_error_square_um2", "Sum of the squared error over all ticks in closed loop, µm²", "error_um2"),
            ("rtloop_drive_square_v2", "Sum of the squared drive over all ticks, V²", "drive_v2"),
        ):
            samples = [(axis, getattr(sums, field)) for axis, sums in axes.items()]
            yield _family(CounterMetricFamily, name, text, samples, ("axis",))
        peaks = {axis: tuple(zip(*sums.peaks, strict=True)) for axis, sums in axes.items() if sums.peaks}
        text = "Largest |error| in closed loop in the last minute, µm"
        yield _family(GaugeMetricFamily, "rtloop_error_peak_um", text,
                      [(axis, max(errors)) for axis, (errors, _, _) in peaks.items()], ("axis",))  # fmt: skip
        ends = [(axis, end, value) for axis, (_, lows, highs) in peaks.items()
                for end, value in (("lowest", min(lows)), ("highest", max(highs)))]  # fmt: skip
        text = "Lowest and highest drive in the last minute, V"
        yield _family(GaugeMetricFamily, "rtloop_drive_peak_v", text, ends, ("axis", "end"))
