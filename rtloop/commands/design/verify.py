"""`rtloop design verify`: a configuration judged by a specification, in the terminal, as JSON and as pages."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from rtloop.commands.output import write_over
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.checks import AxisCheck, Findings, check_axes
from rtloop.configuration.file import Configuration, load
from rtloop.configuration.simulated import compare_with_rig
from rtloop.design.robust.scenarios import Family
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.design.verification.bench import Bench, HardwareModel
from rtloop.design.verification.json_values import as_dict
from rtloop.design.verification.page import page
from rtloop.design.verification.robustness import Plants
from rtloop.design.verification.simulation import simulate
from rtloop.design.verification.verify import Verification, VerifiedLoop, verify
from rtloop.errors import ConfigError, RtloopError
from rtloop.linear.transfer import Transfer
from rtloop.supervision.host_delay import load_host_delay, spent_margin
from rtloop.terminal.design import print_verification
from rtloop.terminal.machine import echo_json


def verify_configuration(config: Path, spec: Path | None, out: Path | None, as_json: bool) -> int:
    """Judge every axis that has a controller; 1 where one misses its specification. Raises ConfigError, OutputError."""
    configuration = load(config)
    findings = Findings()
    checks = check_axes(configuration, findings)
    if any(check.law is None and configuration.axes[i].controller for i, check in enumerate(checks)):
        raise ConfigError(str(config), findings.faults)
    judged = {check.name: verified(configuration, check, spec) for check in checks if check.law}
    if not judged:
        raise ConfigError(str(config), ["axis: none has a controller; nothing can be verified"])
    _require_second_opinion(configuration, checks, judged)
    judged = with_simulation(configuration, judged)
    meets = all(found.meets_specification for found, _ in judged.values())
    report: dict[str, Any] = {
        "name": configuration.name,
        "meets": meets,
        "axes": [{"name": name, **as_dict(found)} for name, (found, _) in judged.items()],
    }
    files = [] if out is None else _write_report(out, configuration.name, judged, report)
    if as_json:
        echo_json({**report, "files": [str(file) for file in files]})
    else:
        for name, (found, _) in judged.items():
            print_verification(name, found)
        for file in files:
            click.echo(file, err=True)
    return 0 if meets else 1


def _scenarios(design: DesignOptions, plant: Transfer, delay_ticks: int, period_s: float) -> Plants:
    """The plants of [scenarios], where a specification has it."""
    if "scenarios" not in design.model_fields_set:
        return ()
    family = Family(plant, delay_ticks, design.scenarios, period_s)
    return [(str(one), family.plant(one), one.delay_ticks) for one in family.corner_scenarios()]


def verified(configuration: Configuration, check: AxisCheck, spec: Path | None) -> tuple[Verification, DesignOptions]:
    """An axis against the specification at `spec`, else against its own. Raises ConfigError."""
    axis = next(one for one in configuration.axes if one.name == check.name)
    if spec is None and axis.specification is not None:
        spec = configuration.folder / axis.specification
    design = DesignOptions() if spec is None else load_specification(spec).design
    model, where = axis.model or design.plant, f"axis.{axis.name}"
    if model is None:
        raise ConfigError(configuration.source, [f"{where}.model: missing; there is no plant to verify against"])
    margins = None if check.together is None else check.together.margins
    try:
        subject = VerifiedLoop(check.loop, check.controller, check.discrete)
        plant, delay = model.transfer(), max(model.delay_ticks, check.delay_ticks)
        plants = _scenarios(design, plant, delay, 1 / configuration.loop.rate_hz)
        found, host = verify(subject, plant, design, delay, margins, plants), load_host_delay(configuration)
        found = replace(found, host=None if host is None else spent_margin(check, host))
        return _with_contradictions(found, configuration, check, design), design
    except ValueError as error:
        raise ConfigError(configuration.source, [f"{where}: {error}"]) from None


def _with_contradictions(
    found: Verification, configuration: Configuration, check: AxisCheck, design: DesignOptions
) -> Verification:
    """Add the contradictions of the axis, if any, and its loop judged on the simulated rig. Raises ValueError."""
    axis = next(axis for axis in configuration.axes if axis.name == check.name)
    (lines, on_rig), judged = compare_with_rig(configuration, axis, check), None
    if on_rig is not None and on_rig.plant is not None:
        sensor = design.sensor.model_copy(update={"bandwidth_hz": None})  # the rig's plant has its sensor's lag
        rig_design = design.model_copy(update={"sensor": sensor})
        judged = verify(VerifiedLoop(on_rig.loop), on_rig.plant, rig_design, on_rig.delay_ticks)
    return replace(found, contradictions=tuple(lines), on_rig=judged, warnings=(*found.warnings, *lines))


Judged = dict[str, tuple[Verification, DesignOptions]]
"""Of each axis, by its name: what was found, and what it was judged by."""


def _require_second_opinion(configuration: Configuration, checks: Sequence[AxisCheck], judged: Judged) -> None:
    """Raise ConfigError with every quantity of a loop for which python-control computes another value."""
    from rtloop.design.verification.second_opinion import axis_faults  # more than a second of import

    faults = list[str]()
    for axis, check in zip(configuration.axes, checks, strict=True):
        if check.name in judged:
            verification, design = judged[check.name]
            model, loop = axis.model or design.plant, verification.running
            faults += axis_faults(
                check, model, axis.prefilter, loop, verification.delay_ticks, design.sensor.bandwidth_hz
            )
    if faults:
        raise ConfigError(configuration.source, faults)


def with_simulation(configuration: Configuration, judged: Judged) -> Judged:
    """With steps of every stable axis simulated; where no rig can stand for the hardware, a warning that says so."""
    axes = {axis.name: axis for axis in configuration.axes}
    stands = {name: _stand(axes[name], design) for name, (_, design) in judged.items()}
    try:
        bench = Bench(configuration, stands)
    except (ValueError, RtloopError) as error:
        note = f"steps are not simulated: {error}"
        return {name: (replace(found, warnings=(*found.warnings, note)), of) for name, (found, of) in judged.items()}
    return {
        name: (replace(found, simulated=simulate(bench, axes[name], found.slowest_s, of)), of)
        if found.running.is_stable
        else (found, of)
        for name, (found, of) in judged.items()
    }


def _stand(axis: AxisOptions, design: DesignOptions) -> HardwareModel:
    """What is known of an axis's hardware."""
    sensor, residual_percent = design.sensor, design.simulation.residual_percent
    model = axis.model or design.plant
    return HardwareModel(model, sensor.noise_um, sensor.resolution_um, sensor.bandwidth_hz, residual_percent)


def _write_report(folder: Path, name: str, judged: Judged, report: dict[str, Any]) -> list[Path]:
    """verify.json, verify.html and the pictures of each axis."""
    from rtloop.design.verification.plots import draw_pictures

    drawn = {
        axis: draw_pictures(found, design.specification, f"{name}, axis {axis}")
        for axis, (found, design) in judged.items()
    }
    html = page(f"{name}: verification", [(axis, found, drawn[axis]) for axis, (found, _) in judged.items()])
    contents = {
        "verify.json": json.dumps(report, indent=2, allow_nan=False).encode(),
        "verify.html": html.encode(),
        **{f"{axis}-{label}.png": png for axis, files in drawn.items() for label, png in files.items()},
    }
    for file, content in contents.items():
        write_over(folder / file, content)
    return [folder / file for file in contents]
