"""`rtloop drivers --selftest`: what the configured channels do, with every output wired back to its input.

It runs the loop that a run would, in raw mode: a small staircase within the axis's limits, ramped at its slew, parked
in the end; then, with outputs off, at one rate after another until periods are missed. Only the one who wired the
channels knows that a wire is there: without tolerances there are numbers and no verdict.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from rtloop.configuration.axis import AxisOptions, PrefilterOptions, StepsOptions
from rtloop.configuration.file import Configuration, load
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.configuration.schedule import ModeName
from rtloop.doctor.loopback import Pair, measure
from rtloop.drivers.base import Channel, channel_index
from rtloop.errors import LoopFault
from rtloop.recording.load import Recording
from rtloop.recording.load import load as load_recording
from rtloop.supervision.host_delay import store_host_delay
from rtloop.supervision.interruption import Interruption
from rtloop.supervision.supervisor import Processes, RunResult, Supervisor
from rtloop.terminal.machine import echo_json
from rtloop.terminal.progress import StatusLine
from rtloop.terminal.table import console, table

CYCLES, LEVELS = 5, 4
SHORTEST_DWELL_S, SHORTEST_DWELL_TICKS = 0.05, 40
RATE_TRIAL_S = 0.5
TRIALS = 3
"""A shared host may stop for a while in one of them."""
MISSED_SHARE = 0.01
TOP_RATE_HZ = 100_000.0
"""Nothing faster is tried; a tenth of what a configuration may ask for."""
RUNGS = 6


@dataclass(frozen=True)
class Tolerances:
    """What a wire may show at most: |gain − 1| and |offset|."""

    gain: float
    offset_v: float


def selftest_configuration(config: Path, amplitude_v: float, tolerances: Tolerances | None, as_json: bool) -> int:
    """Measure and report; 1 where a loopback is claimed and does not show. Raises RtloopError, DriverError."""
    configuration = load(config)
    facts = prepare(_bare(configuration, "off", configuration.loop.rate_hz)).facts
    axes = [_staircase(configuration, axis, facts.outputs, amplitude_v) for axis in configuration.axes]
    for line in _statement(configuration, axes):
        click.echo(line, err=True)
    with StatusLine("staircase", sys.stderr) as status:
        recording, realtime = _staircase_run(configuration, axes)
        settling = {axis.name: _dwell_ticks(axis, configuration.loop.rate_hz) // 2 for axis in axes}
        pairs = {name: _measured(recording, name, ticks) for name, ticks in settling.items()}
        top_hz = min(facts.max_rate_hz, TOP_RATE_HZ)
        rates = list(_rates(configuration, top_hz, status))
    report = _report(configuration, axes, pairs, rates, tolerances) | {"realtime": realtime, "real": facts.real}
    if report["passed"]:  # only then is it known that nothing but a wire lies between output and input
        store_host_delay(
            configuration, wire_ticks={name: pair.delay_ticks for name, pair in pairs.items() if pair.delay_ticks}
        )
    if as_json:
        echo_json(report)
    else:
        _print(report)
    return LoopFault.exit_code if report["passed"] is False else 0


def _staircase(
    configuration: Configuration, axis: AxisOptions, outputs: tuple[Channel, ...], amplitude_v: float
) -> AxisOptions:
    """The axis without its controller, asking for steps about the safe value, and no further."""
    output = outputs[channel_index(outputs, configuration.channels[axis.name].output)]
    lowest = max(output.safe_v - amplitude_v, output.minimum_v, axis.limits.lowest_v)
    highest = min(output.safe_v + amplitude_v, output.maximum_v, axis.limits.drive_v)
    slew = min(axis.limits.slew_v_per_s or math.inf, axis.limits.trip_slew_v_per_s)
    dwell_s = max(SHORTEST_DWELL_S, SHORTEST_DWELL_TICKS / configuration.loop.rate_hz, 4.0 * (highest - lowest) / slew)
    levels = (output.safe_v, highest, output.safe_v, lowest)
    return axis.model_copy(
        update={
            "limits": axis.limits.model_copy(update={"slew_v_per_s": slew}),
            "reference": StepsOptions(kind="steps", levels=levels, dwell_s=dwell_s),
        }
    )


def _bare(configuration: Configuration, mode: ModeName, rate_hz: float) -> Configuration:
    """The configuration at a rate of our own, without what closes the loop."""
    loop = configuration.loop.model_copy(update={"mode": mode, "rate_hz": rate_hz})
    nothing = {"controller": None, "model": None, "prefilter": PrefilterOptions()}
    axes = tuple(axis.model_copy(update=nothing) for axis in configuration.axes)
    return replace(configuration, loop=loop, axes=axes, schedule=())


def _steps(axis: AxisOptions) -> StepsOptions:
    assert isinstance(axis.reference, StepsOptions)
    return axis.reference


def _dwell_ticks(axis: AxisOptions, rate_hz: float) -> int:
    return round(_steps(axis).dwell_s * rate_hz)


def _statement(configuration: Configuration, axes: list[AxisOptions]) -> Iterator[str]:
    """What is about to move, for whoever may want to pull a plug first."""
    yield f"self-test of {configuration.name}, driver {configuration.driver_kind!r}: drives the outputs now"
    for axis in axes:
        levels = _steps(axis).levels
        yield (
            f"  {axis.name}: {configuration.channels[axis.name].output} from {min(levels):g} V to {max(levels):g} V, "
            f"at most {axis.limits.slew_v_per_s:g} V/s, for {_steps(axis).dwell_s * LEVELS * CYCLES:.1f} s; "
            f"reads {configuration.channels[axis.name].input}"
        )


def _staircase_run(configuration: Configuration, axes: list[AxisOptions]) -> tuple[Recording, dict[str, Any]]:
    changed = _bare(replace(configuration, axes=tuple(axes)), "raw", configuration.loop.rate_hz)
    duration_s = max(_steps(axis).dwell_s for axis in axes) * LEVELS * CYCLES
    return _run(prepare(changed, duration_s=duration_s))


def _run(prepared: Prepared) -> tuple[Recording, dict[str, Any]]:
    """One run; its recording, read, and what the host granted. Raises LoopFault unless it went to its end."""
    with tempfile.TemporaryDirectory(prefix="rtloop-selftest-") as folder, Processes() as processes:
        supervisor = Supervisor(processes, prepared, Path(folder) / "selftest.mcap")
        with Interruption() as interruption:
            interruption.set_supervisor(supervisor)
            result: RunResult = supervisor.run()
        if result.error or result.outcome != "done":
            raise LoopFault(f"the self-test did not go to its end ({result.outcome}): {result.error or 'stopped'}")
        recording = load_recording(result.recordings)
        for event in recording.events:
            if event["kind"] == "tripped":
                causes = ", ".join(event["what"]["causes"])
                raise LoopFault(f"the self-test tripped at tick {event['tick']}: {causes}")
        recording.read(*recording.columns)  # the file goes with its folder
    return recording, supervisor.realtime


def _measured(recording: Recording, axis: str, settling_ticks: int) -> Pair:
    try:
        return measure(recording[f"{axis}_drive_v"], recording[f"{axis}_adc_v"], settling_ticks)
    except ValueError as error:
        raise LoopFault(f"axis {axis}: {error}") from None


def _rates(configuration: Configuration, top_hz: float, status: StatusLine) -> Iterator[tuple[float, float]]:
    """Rates that were tried, each with the share of periods that was missed: doubled, or halved, until it turns."""
    rate_hz, step = configuration.loop.rate_hz, 2.0
    for rung in range(RUNGS):
        status.update(f"{rate_hz:g} Hz, outputs off")
        missed = _missed_share(configuration, rate_hz)
        yield rate_hz, missed
        if rung == 0 and missed > MISSED_SHARE:
            step = 0.5
        elif (missed > MISSED_SHARE) == (step > 1.0):
            return
        if rate_hz * step > top_hz:
            return
        rate_hz *= step


def _missed_share(configuration: Configuration, rate_hz: float) -> float:
    """Share of the periods that passed unused with outputs off; the best of a few trials."""
    prepared = prepare(_bare(configuration, "off", rate_hz), duration_s=RATE_TRIAL_S)
    best = 1.0
    for _ in range(TRIALS):
        recording, _realtime = _run(prepared)
        missed = float(np.sum(recording["periods_missed"]))
        best = min(best, missed / (missed + len(recording)))
        if best <= MISSED_SHARE:
            break
    return best


def _report(
    configuration: Configuration,
    axes: list[AxisOptions],
    pairs: dict[str, Pair],
    rates: list[tuple[float, float]],
    tolerances: Tolerances | None,
) -> dict[str, Any]:
    """Everything that was found, as one JSON object."""
    reached = [rate_hz for rate_hz, missed in rates if missed <= MISSED_SHARE]
    rows = []
    for axis in axes:
        channel, pair = configuration.channels[axis.name], pairs[axis.name]
        levels = _steps(axis).levels
        rows.append(
            {"axis": axis.name, "output": channel.output, "input": channel.input, "lowest_v": min(levels),
             "highest_v": max(levels), **asdict(pair), "passed": tolerances and _holds(pair, tolerances)}
        )  # fmt: skip
    return {
        "configuration": configuration.name,
        "driver": configuration.driver_kind,
        "rate_hz": configuration.loop.rate_hz,
        "axes": rows,
        "highest_rate_hz": max(reached, default=None),
        "rates": [{"rate_hz": rate_hz, "missed_share": missed} for rate_hz, missed in rates],
        "tolerances": tolerances and asdict(tolerances),
        "passed": tolerances and all(row["passed"] for row in rows),
    }


def _holds(pair: Pair, tolerances: Tolerances) -> bool:
    return abs(pair.gain - 1.0) <= tolerances.gain and abs(pair.offset_v) <= tolerances.offset_v


def _print(report: dict[str, Any]) -> None:
    out, rows = console(), table("axis", "gain", "offset", "noise, rms", "delay, ticks", "")
    for row in report["axes"]:
        delay = "does not follow" if row["delay_ticks"] is None else f"{row['delay_ticks']}"
        verdict = {None: "", True: "holds", False: "[red]no loopback[/]"}[row["passed"]]
        rows.add_row(f"{row['axis']}: {row['output']} → {row['input']}", f"{row['gain']:.5f}",
                     f"{row['offset_v'] * 1e3:.3f} mV", f"{row['noise_v'] * 1e3:.3f} mV", delay, verdict)  # fmt: skip
    out.print(rows)
    for rate in report["rates"]:
        out.print(f"{rate['rate_hz']:g} Hz: {rate['missed_share']:.2%} of the periods missed")
    highest = report["highest_rate_hz"]
    out.print(f"highest rate reached: {'none of these' if highest is None else f'{highest:g} Hz'}")
    if report["passed"] is None:
        what = "" if report["real"] else " (this driver simulates one)"
        out.print(
            f"no verdict: gain and offset are those of what lies between output and input{what}; "
            "with every output wired to its input, --loopback judges them"
        )
