"""`rtloop ctl retune`: resonance and gain measured in a running loop, taps made anew for them, swapped in at a tick."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from rtloop.analysis.perturbation import change_gain, resonance_hz, shift_resonance
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration, parse
from rtloop.design.robust.programme import Taps
from rtloop.design.robust.section import taps_values
from rtloop.design.robust.shape import ALLOWED_EXCESS, PROOF_POINTS, StepMeasures, Subject, design_taps, measure_step
from rtloop.design.robust.subject import load_subject
from rtloop.design.toml_text import write_section
from rtloop.errors import ConfigError, LoopFault
from rtloop.service.client import Client
from rtloop.terminal.machine import echo_json
from rtloop.terminal.table import console, table

STAGES = 4
"""In which new taps take over from old ones, so that a scan that goes on meanwhile feels none of them."""
GAIN_PART = 4.0
"""The gain is measured over this part of the largest step: over less, what is left of hysteresis counts for more."""
GAIN_CERTAIN_PERCENT = 1.0
"""A gain that is less certain than this is not taken into the model: it would cost half as much overshoot."""
MEASURED_S, MEASUREMENT_S = 1.0, 120.0
"""How long the loop is excited at most amplitude, and how long an answer may take."""


class Asked(NamedTuple):
    """What a retuning may do: move the position, and hold references so far from the one held (None: a quarter of the
    largest step); how far resonance and gain may be from the model's; for how much around the resonance the taps are
    made; whether it may swap them in without asking.
    """

    axis: str
    amplitude_um: float
    gain_um: float | None
    bound_percent: float
    within_percent: float
    yes: bool
    spec: Path | None


class Stage(NamedTuple):
    """The stage as it was measured: `percent` is its resonance's distance from the model's. `gain` is None where it was
    not measured; its distance `gain_percent` is None where the model's gain is taken instead.
    """

    mode: dict[str, Any]
    percent: float
    gain: dict[str, Any] | None
    gain_percent: float | None


def retune(client: Client, asked: Asked, as_json: bool) -> int:
    """Measure, redesign, show, swap; 0 where the taps in force are the new ones. Raises RtloopError."""
    configuration = _running(client)
    axis, subject, _ = load_subject(configuration, asked.axis, asked.spec)
    stage = _measured(client, asked, subject)
    shifted = change_gain(shift_resonance(subject.plant, stage.percent), stage.gain_percent or 0.0)
    there = replace(subject.restrict_resonance(asked.within_percent), plant=shifted)
    found, in_force = design_taps(there, may_be_late=True), _taps_of(axis)
    nominal = there.family().nominal
    before, after = measure_step(there, in_force, nominal), measure_step(there, found.taps, nominal)
    better, swapped = _is_better(there, before, after), False
    if not as_json:
        _show(stage, before, after, _with_gain_off(stage, there, found.taps))
    if better:
        swapped = asked.yes or (not as_json and click.confirm("swap the taps in?", err=True))
    tick = None
    if swapped:
        tick = _swap_in(client, asked.axis, in_force, found.taps)
    if as_json:
        measured = {"resonance": stage.mode, "percent_from_model": stage.percent, "gain": stage.gain,
                    "gain_percent_from_model": stage.gain_percent}  # fmt: skip
        steps = {"before": before._asdict(), "after": after._asdict(), "better": better}
        taps = {"replaces": taps_values(in_force), "prefilter": taps_values(found.taps)}
        echo_json({**measured, **steps, "settling_ms": found.settling_ms, "tick": tick, **taps})
    elif tick is not None:
        click.echo(f"swapped at tick {tick}")
    elif not better:
        click.echo("the new taps are no better than those in force, which stay")
    return 0 if swapped else LoopFault.exit_code


def _measured(client: Client, asked: Asked, subject: Subject) -> Stage:
    """Measure resonance and gain. Raises LoopFault for what is missing or too far from the model's."""
    model_hz = resonance_hz(subject.plant)
    if model_hz is None:
        raise ConfigError("retune", [f"axis.{asked.axis}.model: no light mode; there is no resonance to measure"])
    gain_um = subject.bounds.step_um / GAIN_PART if asked.gain_um is None else asked.gain_um
    body = {"axis": asked.axis, "amplitude_um": asked.amplitude_um, "duration_s": MEASURED_S, "resonance_only": True,
            "gain_um": gain_um}  # fmt: skip
    content = client.post("/response", body, MEASUREMENT_S)
    mode, gain = content["resonance"], content["gain"]
    if mode is None:
        raise LoopFault("retune: no light mode stands out about the model's; the taps stay as they are")
    percent, model_gain = 100 * (mode["hz"] / model_hz[0] - 1), subject.plant.dc_gain
    _require_near(f"resonance is at {mode['hz']:.2f} Hz", percent, asked.bound_percent)
    if gain is None or 100 * gain["std"] > GAIN_CERTAIN_PERCENT * gain["value"]:
        return Stage(mode, percent, gain, None)
    gain_percent = 100 * (gain["value"] / model_gain - 1)
    _require_near(f"gain is {gain['value']:.4f}", gain_percent, asked.bound_percent)
    return Stage(mode, percent, gain, gain_percent)


def _require_near(measured: str, percent: float, bound_percent: float) -> None:
    """Raise LoopFault for what was measured further than `bound_percent` from the model's."""
    if abs(percent) > bound_percent:
        raise LoopFault(
            f"retune: the {measured}, {percent:+.2f} % from the model's; within ±{bound_percent:g} % is allowed, and "
            "the taps stay as they are"
        )


def _is_better(subject: Subject, before: StepMeasures, after: StepMeasures) -> bool:
    """Whether new taps settle sooner, by more than a point between ticks, or mend what the ones in force do not keep:
    the specification's overshoot, and the limits of v.
    """
    point_ms = 1e3 * subject.controller.period_s / PROOF_POINTS
    return (
        round((before.settling_ms - after.settling_ms) / point_ms) > 1
        or before.overshoot > max(subject.overshoot, after.overshoot)
        or before.excess > max(ALLOWED_EXCESS, after.excess)
    )


def swap(client: Client, name: str, proposal: str, as_json: bool) -> int:
    """Swap in the taps of an earlier `retune --json`, whose text `proposal` is, on the axis `name`; 0 when it is done.

    Raises ConfigError for another text, LoopFault where the taps in force are no longer those that were compared.
    """
    axis = next((one for one in _running(client).axes if one.name == name), None)
    if axis is None:
        raise ConfigError("retune", [f"axis: {name!r} is not there"])
    try:
        parts = json.loads(proposal)
        replaced, new = (_taps_from(parts[key]) for key in ("replaces", "prefilter"))
    except (ValueError, KeyError, TypeError, RecursionError):
        fault = "proposal: is no output of `rtloop ctl retune AXIS --json`, which is needed"
        raise ConfigError("retune", [fault]) from None
    if taps_values(replaced) != taps_values(_taps_of(axis)):
        raise LoopFault(f"retune: the taps of axis {name} were changed since the proposal was made; retune again")
    tick = _swap_in(client, name, replaced, new)
    if as_json:
        echo_json({"tick": tick})
    else:
        click.echo(f"swapped at tick {tick}")
    return 0


def _running(client: Client) -> Configuration:
    """The configuration as it runs."""
    running = client.get("/configuration")
    text, folder = write_section("", running["values"]), Path(running["folder"])
    return parse(text, "running", folder, "the running configuration")


def _taps_from(values: dict[str, list[float]]) -> Taps:
    """Taps from the values that `taps_values` made of them. Raises KeyError, TypeError, ValueError for others."""
    reference, command = (np.array(values[key], float) for key in ("taps", "command_taps"))
    if reference.ndim != 1 or command.shape != reference.shape:
        raise ValueError("two rows of as many taps are needed")
    return Taps(reference, command, 0.0)


def _swap_in(client: Client, axis: str, old: Taps, new: Taps) -> int:
    """Change from the old taps to the new ones in STAGES; the tick of the last one."""
    ticks = [_swapped(client, axis, _between(old, new, part)) for part in np.arange(1, STAGES + 1) / STAGES]
    return ticks[-1]


def _swapped(client: Client, axis: str, taps: Taps) -> int:
    change = {"axis": axis, "section": "prefilter", "values": taps_values(taps)}
    return int(client.post("/tune", change, MEASUREMENT_S)["tick"])


def _between(old: Taps, new: Taps, part: float) -> Taps:
    """Old ones with so much of the new ones in them."""
    count = max(old.reference.size, new.reference.size)
    rows = (
        (1 - part) * np.pad(one, (0, count - one.size)) + part * np.pad(other, (0, count - other.size))
        for one, other in ((old.reference, new.reference), (old.command, new.command))
    )
    reference, command = rows
    return Taps(reference, command, new.overshoot)


def _taps_of(axis: AxisOptions) -> Taps:
    """Those in force."""
    rows = axis.prefilter.taps or (1.0,), axis.prefilter.command_taps or (0.0,)
    length = max(map(len, rows))
    reference, command = (np.pad(np.asarray(row, float), (0, length - len(row))) for row in rows)
    return Taps(reference, command, 0.0)


def _with_gain_off(stage: Stage, subject: Subject, taps: Taps) -> StepMeasures | None:
    """Judge the new taps with the gain off by its standard deviation, to the worse side in each figure; None where the
    gain is the model's.
    """
    if stage.gain is None or stage.gain_percent is None:
        return None
    off, nominal = 100 * stage.gain["std"] / stage.gain["value"], subject.family().nominal
    ends = [measure_step(subject, taps, nominal._replace(gain=percent)) for percent in (-off, off)]
    return StepMeasures(*(max(values) for values in zip(*ends, strict=True)))


def _show(stage: Stage, before: StepMeasures, after: StepMeasures, with_gain_off: StepMeasures | None) -> None:
    """Print what was measured, and a step with either taps."""
    mode, gain, percent = stage.mode, stage.gain, stage.gain_percent
    click.echo(f"resonance {mode['hz']:.2f} ± {mode['hz_std']:.2f} Hz, {stage.percent:+.2f} % from the model's")
    if gain is None:
        click.echo("gain not measured; the model's is taken")
    else:
        used = "too uncertain; the model's is taken" if percent is None else f"{percent:+.2f} % from the model's"
        span = f"between {gain['from_um']:.4g} and {gain['to_um']:.4g} µm"
        click.echo(f"gain {gain['value']:.4f} ± {gain['std']:.4f} {span}, {used}")
    shown = table("of a step there", "settling / ms", "overshoot / %", "largest v per unit")
    rows = {"with the taps in force": before, "with the new ones": after, "the same, gain off by its ±": with_gain_off}
    for name, one in rows.items():
        if one is not None:
            shown.add_row(name, f"{one.settling_ms:.3f}", f"{100 * one.overshoot:.3f}", f"{one.highest_command:.4f}")
    console().print(shown)
