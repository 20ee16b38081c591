"""Building a plan from a configuration. A start builds, and refuses faults; `check` judges more (`cautions`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.checks import AxisCheck, Findings, check_axes
from rtloop.configuration.coefficients import axis_coefficients
from rtloop.configuration.extras import build_extras
from rtloop.configuration.file import Configuration
from rtloop.configuration.recording import event_recording_faults
from rtloop.configuration.references import TableOfSamples, generator_values
from rtloop.configuration.rig import rig_options
from rtloop.configuration.schedule import ScheduleOptions
from rtloop.drivers.base import Channel, Driver, Facts, channel_index
from rtloop.drivers.errors import DriverError
from rtloop.drivers.registry import driver_class
from rtloop.drivers.sim import SimDriver
from rtloop.engine.messages import ALL_AXES, MESSAGE, Kind, Origin, message
from rtloop.engine.plan import Hold, Pacing, Plan, require_facts
from rtloop.errors import ConfigError
from rtloop.kernel.extras import Extras
from rtloop.kernel.layout import Records
from rtloop.kernel.reference import GENERATOR
from rtloop.laws.binding import bind_functions
from rtloop.laws.contract import Controller
from rtloop.laws.limited.trial import needs_limited_process, run_limited
from rtloop.signals import Mode

LATENESS_KEY = "loop.simulated_lateness_us"
MOST_TICKS = 2**53
"""A recording numbers its ticks by floating-point numbers."""


@dataclass(frozen=True)
class Prepared:
    """A plan with the driver's facts, the axes' controllers and loops, and warnings."""

    configuration: Configuration
    plan: Plan
    facts: Facts
    checks: tuple[AxisCheck, ...]
    warnings: tuple[str, ...]


def prepare(configuration: Configuration, *, duration_s: float | None = None, paced: bool = True) -> Prepared:
    """Build the plan of a run: laws, references and schedule. Opens no hardware.

    With a user law this is done in the limited process, which is killed if a law does not return. `duration_s` None:
    an endless run; `paced` False: virtual time. Raises ConfigError with all faults, DriverError for a missing library.
    """
    if needs_limited_process(configuration.laws):
        job = partial(prepare, duration_s=duration_s, paced=paced)
        return run_limited(configuration.source, job, configuration, compiles=True)
    findings, rate_hz = Findings(), configuration.loop.rate_hz
    facts = _facts(configuration, paced, findings)
    if configuration.loop.enable_input is not None:
        with findings.collect_faults("loop.enable_input: "):
            channel_index(facts.inputs, configuration.loop.enable_input)
    for law in configuration.laws:
        if law.text:  # shipped laws are compiled in the test suite
            with findings.collect_faults(""):
                bind_functions([law])
    checks, coefficients = check_axes(configuration, findings), []
    modes = {configuration.loop.mode, *(entry.mode for entry in configuration.schedule)}
    for number, axis in enumerate(configuration.axes):
        owner = configuration.owners[number]
        coefficients.append(_coefficients(configuration, axis, checks[owner].law, facts, findings, number - owner))
        if configuration.axes[owner].controller is None and "closed_loop" in modes:
            findings.faults.append(f"axis.{axis.name}.controller: missing; mode closed_loop needs it")
    extras = Extras()
    with findings.collect_faults(""):
        names = [axis.name for axis in configuration.axes]
        extras = build_extras(configuration.inputs, configuration.outputs, names, facts, configuration.wiring)
    table = TableOfSamples()
    generators = _generators(configuration, facts, table, findings)
    schedule = _schedule(configuration, facts, table, findings)
    ticks = _ticks(duration_s, rate_hz, findings)
    findings.faults += _lateness_faults(configuration)
    if findings.faults:
        raise ConfigError(configuration.source, findings.faults)
    plan = Plan(
        name=configuration.name,
        axes=tuple(axis.name for axis in configuration.axes),
        pacing=_pacing(configuration, paced),
        ticks=ticks,
        driver_kind=configuration.driver_kind,
        driver_options=configuration.driver_options.model_dump(exclude_unset=True),
        wiring=configuration.wiring,
        laws=configuration.laws,
        coefficients=np.concatenate(coefficients).view(np.recarray),
        mode=Mode[configuration.loop.mode.upper()],
        generators=generators,
        table=table.samples,
        schedule=schedule,
        observed=facts.observed,
        extras=extras,
        extra_channels={
            name: extra.channel for name, extra in {**configuration.inputs, **configuration.outputs}.items()
        },
        hold=None
        if configuration.loop.hold_input is None
        else Hold(
            configuration.loop.hold_input, configuration.loop.hold_min_v, configuration.loop.hold_while == "high"
        ),
        enable_input=configuration.loop.enable_input,
    )
    faults = event_recording_faults(configuration.recording.around, plan.columns, plan.pacing.rate_hz)
    if faults:
        raise ConfigError(configuration.source, faults)
    return Prepared(configuration, plan, facts, tuple(checks), tuple(findings.warnings))


def _facts(configuration: Configuration, paced: bool, findings: Findings) -> Facts:
    """Return the facts of the driver, which is built but not opened.

    Raises ConfigError, with the faults in `findings`, for an unknown driver, options that the driver refuses, a rate
    above its limit, and real hardware in virtual time: no other check is possible then. Raises MissingLibrary if the
    driver's module cannot be imported.
    """
    with findings.collect_faults("driver."):
        driver = build_driver(configuration)
        with findings.collect_faults(""):
            return require_facts(driver, configuration.loop.rate_hz, paced)
    raise ConfigError(configuration.source, findings.faults)


def build_driver(configuration: Configuration) -> Driver:
    """Return the configuration's driver, which is not open.

    Raises ConfigError if the driver's constructor raises DriverError, ValueError for an unknown kind or options that do
    not fit, MissingLibrary if the driver's module cannot be imported.
    """
    kind = driver_class(configuration.driver_kind)
    try:
        return kind(configuration.driver_options, configuration.wiring, configuration.loop.rate_hz)
    except DriverError as error:
        raise ConfigError(configuration.source, [f"driver: {error}"]) from None


def _pacing(configuration: Configuration, paced: bool) -> Pacing:
    """Return rate, scheduling, heartbeat and simulated lateness of the loop for the plan."""
    loop, rig = configuration.loop, rig_options(configuration)
    return Pacing(
        rate_hz=loop.rate_hz,
        paced=paced,
        spin_us=loop.spin_us,
        priority=loop.priority,
        cpu=loop.cpu,
        require_realtime=loop.require_realtime,
        heartbeat_timeout_s=loop.heartbeat_timeout_s,
        simulated_lateness_us=loop.simulated_lateness_us,
        lateness_seed=0 if rig is None else rig.seed,
    )


def _lateness_faults(configuration: Configuration) -> list[str]:
    """Return a line if loop.simulated_lateness_us is set for a driver other than the simulated rig, else []."""
    if not configuration.loop.simulated_lateness_us or configuration.driver_kind == SimDriver.kind:
        return []
    remedy = f"set driver.kind = {SimDriver.kind!r}, or remove the key"
    return [
        f"{LATENESS_KEY}: set with driver.kind = {configuration.driver_kind!r}; allowed with the simulated rig "
        f"only; {remedy}"
    ]


def refuse_simulated_lateness(prepared: Prepared) -> None:
    """Raise ConfigError for a paced run with simulated lateness, which acts in virtual time alone."""
    if prepared.plan.pacing.paced and prepared.plan.pacing.simulated_lateness_us:
        fault = f"{LATENESS_KEY}: set; allowed in virtual time only; add --unpaced, or remove the key"
        raise ConfigError(prepared.configuration.source, [fault])


def _ticks(duration_s: float | None, rate_hz: float, findings: Findings) -> int | None:
    """Return the duration in ticks, rounded; None for an endless run, and, with a fault in `findings`, for a duration
    that rounds to no tick or exceeds MOST_TICKS.
    """
    if duration_s is None:
        return None
    ticks = duration_s * rate_hz
    if not 0.5 < ticks <= MOST_TICKS:
        allowed = f"one period, {1 / rate_hz:g} s, to {MOST_TICKS / rate_hz:g} s at {rate_hz:g} Hz"
        findings.faults.append(f"--duration: {duration_s:g} s; allowed: {allowed}")
        return None
    return round(ticks)


def _coefficients(
    configuration: Configuration,
    axis: AxisOptions,
    controller: Controller | None,
    facts: Facts,
    findings: Findings,
    place: int,
) -> Records | None:
    """Return the coefficients (1,) of an axis; None where its output channel is unknown or its options do not fit.

    Faults, also an unknown input channel, go to `findings`. An axis that shares its `controller` is number `place`,
    from 0, of the controller's axes.
    """
    channel, prefix = configuration.channels[axis.name], f"driver.channels.{axis.name}."
    output: Channel | None = None
    with findings.collect_faults(prefix + "input: "):
        channel_index(facts.inputs, channel.input)
    with findings.collect_faults(prefix + "output: "):
        output = facts.outputs[channel_index(facts.outputs, channel.output)]
    if output is None:
        return None
    with findings.collect_faults(f"axis.{axis.name}."):
        period_s, has_enable = 1.0 / configuration.loop.rate_hz, configuration.loop.enable_input is not None
        return axis_coefficients(
            configuration.laws, axis, controller, channel.um_per_v, channel.offset, output, period_s, has_enable, place
        )
    return None


def _generators(
    configuration: Configuration, facts: Facts, table: TableOfSamples, findings: Findings
) -> npt.NDArray[np.void]:
    """Return the reference generators that the axes begin with, (axes,) of GENERATOR; samples go to `table`.

    A faulty reference stays all zeros, and its fault goes to `findings`.
    """
    generators = np.zeros(len(configuration.axes), GENERATOR)
    for i, axis in enumerate(configuration.axes):
        with findings.collect_faults(f"axis.{axis.name}.reference."):
            values = generator_values(
                axis.reference, configuration.loop.rate_hz, facts.inputs, configuration.folder, table
            )
            generators["kind"][i] = values[0]
            generators["volts"][i] = configuration.loop.mode == "raw"
            generators["parameters"][i, : len(values) - 1] = values[1:]
    return generators


def _schedule(
    configuration: Configuration, facts: Facts, table: TableOfSamples, findings: Findings
) -> npt.NDArray[np.void]:
    """Return the schedule's commands, (n,) of MESSAGE, by rising tick; entries of one tick keep the file's order.

    Samples go to `table`. A faulty entry is left out, and its fault goes to `findings`.
    """
    names = [axis.name for axis in configuration.axes]
    entries = sorted(configuration.schedule, key=lambda entry: entry.at_tick)
    commands = [np.zeros(0, MESSAGE)]
    for entry in entries:
        with findings.collect_faults(f"schedule, at_tick {entry.at_tick}: "):
            commands.append(_command(entry, names, configuration, facts, table))
    return np.concatenate(commands)


def _command(
    entry: ScheduleOptions, names: list[str], configuration: Configuration, facts: Facts, table: TableOfSamples
) -> npt.NDArray[np.void]:
    """Return the message (1,), of MESSAGE, for one entry of the schedule; samples of its reference go to `table`.

    `names` are the axes of the configuration. Raises ValueError for a wrong reference.
    """
    if entry.mode is not None:
        kind, values = Kind.SET_MODE, (float(Mode[entry.mode.upper()]),)
    elif entry.reference is not None:
        kind = Kind.SET_REFERENCE
        values = generator_values(
            entry.reference, configuration.loop.rate_hz, facts.inputs, configuration.folder, table
        )
    else:
        kind, values = Kind.RESET_TRIP, ()
    axis = ALL_AXES if entry.axis is None else names.index(entry.axis)
    return message(kind, tick=entry.at_tick, axis=axis, origin=Origin.SCHEDULE, values=values)
