"""`rtloop ctl retune`: the resonance measured in a running loop, taps made anew for it, and swapped in at a tick."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from rtloop.analysis.perturbation import resonance_hz, with_resonance_shifted
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration, parse
from rtloop.design.robust.programme import Taps
from rtloop.design.robust.section import taps_values
from rtloop.design.robust.shape import Judged, judged_of, shaped
from rtloop.design.robust.subject import subject_in
from rtloop.design.toml_text import section
from rtloop.errors import ConfigError, LoopFault
from rtloop.service.client import Client
from rtloop.terminal.machine import echo_json
from rtloop.terminal.table import console, table

STAGES = 4
"""In which new taps take over from old ones, so that a scan that goes on meanwhile feels none of them."""
MEASURED_S, MEASUREMENT_S = 1.0, 120.0
"""How long the loop is excited at most amplitude, and how long an answer may take."""


class Asked(NamedTuple):
    """What a retuning may do: move the position, how far the resonance may be from the model's, for how much around it
    the taps are made, and whether it may swap them in without asking.
    """

    axis: str
    amplitude_um: float
    bound_percent: float
    within_percent: float
    yes: bool
    spec: Path | None


def retune(client: Client, asked: Asked, as_json: bool) -> int:
    """Measure, redesign, show, swap; 0 where the taps in force are the new ones. Raises RtloopError."""
    configuration = _running(client)
    axis, subject, _ = subject_in(configuration, asked.axis, asked.spec)
    model_hz = resonance_hz(subject.plant)
    if model_hz is None:
        raise ConfigError("retune", [f"axis.{asked.axis}.model: no light mode; there is no resonance to measure"])
    body = {"axis": asked.axis, "amplitude_um": asked.amplitude_um, "duration_s": MEASURED_S, "resonance_only": True}
    mode = client.post("/response", body, MEASUREMENT_S)["resonance"]
    if mode is None:
        raise LoopFault("retune: no light mode stands out about the model's; the taps stay as they are")
    percent = 100 * (mode["hz"] / model_hz[0] - 1)
    if abs(percent) > asked.bound_percent:
        raise LoopFault(
            f"retune: the resonance is at {mode['hz']:.2f} Hz, {percent:+.2f} % from the model's; within "
            f"±{asked.bound_percent:g} % is allowed, and the taps stay as they are"
        )
    there = replace(subject.around(asked.within_percent), plant=with_resonance_shifted(subject.plant, percent))
    found = shaped(there)
    nominal = there.family().nominal
    before, after = judged_of(there, _taps_of(axis), nominal), judged_of(there, found.taps, nominal)
    swapped = asked.yes
    if not as_json:
        _show(mode, percent, before, after)
        swapped = asked.yes or click.confirm("swap the taps in?", err=True)
    tick = None
    if swapped:
        tick = _swap_in(client, asked.axis, _taps_of(axis), found.taps)
    if as_json:
        said = {"resonance": mode, "percent_from_model": percent, "before": before._asdict(), "after": after._asdict()}
        taps = {"replaces": taps_values(_taps_of(axis)), "prefilter": taps_values(found.taps)}
        echo_json({**said, "settling_ms": found.settling_ms, "tick": tick, **taps})
    elif tick is not None:
        click.echo(f"swapped at tick {tick}")
    return 0 if swapped else LoopFault.exit_code


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
    text, folder = section("", running["values"]), Path(running["folder"])
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


def _show(mode: dict[str, Any], percent: float, before: Judged, after: Judged) -> None:
    click.echo(f"resonance {mode['hz']:.2f} ± {mode['hz_std']:.2f} Hz, {percent:+.2f} % from the model's")
    shown = table("of a step there", "settling / ms", "overshoot / %", "largest v per unit")
    for name, one in (("with the taps in force", before), ("with the new ones", after)):
        shown.add_row(name, f"{one.settling_ms:.3f}", f"{100 * one.overshoot:.3f}", f"{one.highest_command:.4f}")
    console().print(shown)
