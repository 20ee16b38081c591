"""`rtloop ctl retune`: new taps for the resonance and gain measured in a running loop, swapped in at a tick."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from rtloop.cli.ctl import AXIS, make_client
from rtloop.cli.exit_codes import report_errors, require_readable
from rtloop.cli.options import JSON, OUTPUT
from rtloop.cli.output import echo_json
from rtloop.cli.output.tables import console, table
from rtloop.errors import ConfigError, LoopFault

if TYPE_CHECKING:
    from rtloop.configuration.axis import AxisOptions
    from rtloop.configuration.file import Configuration
    from rtloop.design.robust.programme import Taps
    from rtloop.design.robust.shape import StepMeasures, Subject
    from rtloop.linear.transfer import Transfer
    from rtloop.service.client import Client


SWAP_STAGES = 4
"""Steps from the old taps to the new ones, small enough that a scan in progress is not disturbed."""
GAIN_STEP_DIVISOR = 4.0
"""The gain is measured over the largest step divided by this: over less, hysteresis would bias it more."""
MAX_GAIN_STD_PERCENT = 1.0
"""A gain with a larger standard deviation is not used: it would cost half as much overshoot."""
EXCITATION_S, RESPONSE_TIMEOUT_S = 1.0, 120.0
"""Duration of the excitation at the largest amplitude, and the longest wait for an answer."""


class StageMeasurement(NamedTuple):
    """Measured resonance and gain of a stage, and their distances from the model's in percent.

    `gain` is None where it was not measured, `gain_percent` where the model's gain is used.
    """

    mode: dict[str, Any]
    percent: float
    gain: dict[str, Any] | None
    gain_percent: float | None


@click.command()
@AXIS
@click.option(
    "--amplitude-um",
    default=0.5,
    show_default=True,
    type=click.FloatRange(0, min_open=True),
    help="The position is moved by no more than this while the resonance is measured.",
)
@click.option(
    "--gain-um",
    type=click.FloatRange(0),
    help="Distance of references, from the held one towards the middle of the range, for the measurement of the gain; "
    "0: the gain is not measured, and the model's is taken [a quarter of the specification's largest step].",
)
@click.option(
    "--bound-percent",
    default=15.0,
    show_default=True,
    type=click.FloatRange(0, 50, min_open=True),
    help="Largest distance of a measured resonance or gain from the model's; beyond, the taps stay.",
)
@click.option(
    "--within-percent",
    default=1.0,
    show_default=True,
    type=click.FloatRange(0, 50),
    help="Range about the measured resonance for which the taps are made.",
)
@click.option("--spec", type=OUTPUT, help="The specification [the axis's].")
@click.option("--yes", is_flag=True, help="Swap without asking.")
@click.option(
    "--swap", "proposal", type=click.File(), help="Swap in the taps of this output of --json, without measuring."
)
@JSON
@click.pass_context
@report_errors
def retune(context: click.Context, axis: str, proposal: Any, **options: Any) -> int:
    """Make new taps of AXIS for its present resonance and gain.

    Both are measured in closed loop about the held reference; the taps are computed outside the loop and swapped in
    at a tick, after a comparison of a step before and after. Taps that are no better than the present ones are not
    swapped in, --yes or not; with --json and without --yes none are, and the output is a proposal for --swap. Exit 1
    where the old taps stay.
    """
    if proposal is not None:
        return swap_proposal(make_client(context), axis, proposal.read(), options["as_json"])
    if options["spec"] is not None:
        require_readable(options["spec"])
    return retune_axis(make_client(context), axis, **options)


def retune_axis(
    client: Client,
    axis: str,
    *,
    amplitude_um: float,
    gain_um: float | None,
    bound_percent: float,
    within_percent: float,
    spec: Path | None,
    yes: bool,
    as_json: bool,
) -> int:
    """Measure the stage, design taps, print them, swap them in. Returns exit code 1 where the old taps stay.

    `amplitude_um` bounds the motion while the resonance is measured; references up to `gain_um` away are held while the
    gain is (None: a quarter of the largest step; 0: the model's gain is used). Resonance and gain further than
    `bound_percent` from the model's are refused; the taps are made for resonances within `within_percent` of the
    measured one, by the specification `spec` (None: the axis's). `yes` swaps without asking.
    Raises RtloopError, LoopFault where the measurement is unusable.
    """
    from rtloop.analysis.perturbation import change_gain, shift_resonance
    from rtloop.design.robust.section import taps_values
    from rtloop.design.robust.shape import design_taps, measure_step
    from rtloop.design.robust.subject import load_subject

    options, subject, _ = load_subject(_running_configuration(client), axis, spec)
    if gain_um is None:
        gain_um = subject.bounds.step_um / GAIN_STEP_DIVISOR
    motion = {"axis": axis, "amplitude_um": amplitude_um, "gain_um": gain_um}
    stage = _measure_stage(client, motion, bound_percent, subject.plant)
    shifted_plant = change_gain(shift_resonance(subject.plant, stage.percent), stage.gain_percent or 0.0)
    shifted_subject = replace(subject.restrict_resonance(within_percent), plant=shifted_plant)
    tap_design, current_taps = design_taps(shifted_subject, may_be_late=True), _current_taps(options)
    nominal = shifted_subject.family().nominal
    before, after = (measure_step(shifted_subject, taps, nominal) for taps in (current_taps, tap_design.taps))
    is_better = _is_better(shifted_subject, before, after)
    if not as_json:
        _print_comparison(stage, before, after, _measures_with_gain_error(stage, shifted_subject, tap_design.taps))
    tick = None
    if is_better and (yes or (not as_json and click.confirm("swap the taps in?", err=True))):
        tick = _swap_in(client, axis, current_taps, tap_design.taps)
    if as_json:
        resonance = {"resonance": stage.mode, "percent_from_model": stage.percent}
        gain = {"gain": stage.gain, "gain_percent_from_model": stage.gain_percent}
        steps = {"before": before._asdict(), "after": after._asdict(), "better": is_better}
        taps = {"replaces": taps_values(current_taps), "prefilter": taps_values(tap_design.taps)}
        echo_json({**resonance, **gain, **steps, "settling_ms": tap_design.settling_ms, "tick": tick, **taps})
    elif tick is not None:
        click.echo(f"swapped at tick {tick}")
    elif not is_better:
        click.echo("the new taps are no better than those in force, which stay")
    return LoopFault.exit_code if tick is None else 0


def _measure_stage(client: Client, motion: dict[str, Any], bound_percent: float, plant: Transfer) -> StageMeasurement:
    """Measure resonance and gain, by a request for `motion`. Raises ConfigError where the model has no resonance.

    Raises LoopFault where no resonance is measured, or where it or the gain is further than `bound_percent` away.
    """
    from rtloop.analysis.perturbation import resonance_hz

    model_hz = resonance_hz(plant)
    if model_hz is None:
        raise ConfigError("retune", [f"axis.{motion['axis']}.model: no light mode; there is no resonance to measure"])
    body = {**motion, "duration_s": EXCITATION_S, "resonance_only": True}
    content = client.post("/response", body, RESPONSE_TIMEOUT_S)
    mode, gain = content["resonance"], content["gain"]
    if mode is None:
        raise LoopFault("retune: no light mode stands out about the model's; the taps stay as they are")
    percent = 100 * (mode["hz"] / model_hz[0] - 1)
    _require_near(f"resonance is at {mode['hz']:.2f} Hz", percent, bound_percent)
    if gain is None or 100 * gain["std"] > MAX_GAIN_STD_PERCENT * gain["value"]:
        return StageMeasurement(mode, percent, gain, None)
    gain_percent = 100 * (gain["value"] / plant.dc_gain - 1)
    _require_near(f"gain is {gain['value']:.4f}", gain_percent, bound_percent)
    return StageMeasurement(mode, percent, gain, gain_percent)


def _require_near(quantity_text: str, percent: float, bound_percent: float) -> None:
    """Raise LoopFault for a measured quantity that is further than `bound_percent` from the model's."""
    if abs(percent) > bound_percent:
        limit = f"within ±{bound_percent:g} % is allowed, and the taps stay as they are"
        raise LoopFault(f"retune: the {quantity_text}, {percent:+.2f} % from the model's; {limit}")


def _is_better(subject: Subject, before: StepMeasures, after: StepMeasures) -> bool:
    """Whether new taps settle sooner by more than a point between ticks, or meet a limit that the old ones exceed.

    The limits are the specification's overshoot and the limits of v.
    """
    from rtloop.design.robust.shape import ALLOWED_EXCESS, PROOF_POINTS

    point_ms = 1e3 * subject.controller.period_s / PROOF_POINTS
    return (
        round((before.settling_ms - after.settling_ms) / point_ms) > 1
        or before.overshoot > max(subject.overshoot, after.overshoot)
        or before.excess > max(ALLOWED_EXCESS, after.excess)
    )


def swap_proposal(client: Client, name: str, proposal: str, as_json: bool) -> int:
    """Swap in the taps of `proposal`, the output of an earlier `retune --json`, on the axis `name`. Returns 0.

    Raises ConfigError for another text, LoopFault where the taps have changed since the proposal.
    """
    from rtloop.design.robust.section import taps_values

    axis = next((entry for entry in _running_configuration(client).axes if entry.name == name), None)
    if axis is None:
        raise ConfigError("retune", [f"axis: {name!r} is not there"])
    try:
        parts = json.loads(proposal)
        old_taps, new_taps = (_parse_taps(parts[key]) for key in ("replaces", "prefilter"))
    except (ValueError, KeyError, TypeError, RecursionError):
        fault = "proposal: is no output of `rtloop ctl retune AXIS --json`, which is needed"
        raise ConfigError("retune", [fault]) from None
    if taps_values(old_taps) != taps_values(_current_taps(axis)):
        raise LoopFault(f"retune: the taps of axis {name} were changed since the proposal was made; retune again")
    tick = _swap_in(client, name, old_taps, new_taps)
    echo_json({"tick": tick}) if as_json else click.echo(f"swapped at tick {tick}")
    return 0


def _running_configuration(client: Client) -> Configuration:
    """Get the configuration that the service runs."""
    from rtloop.configuration.file import parse
    from rtloop.design.toml_text import write_section

    response = client.get("/configuration")
    text, folder = write_section("", response["values"]), Path(response["folder"])
    return parse(text, "running", folder, "the running configuration")


def _parse_taps(values: dict[str, list[float]]) -> Taps:
    """Parse the output of `taps_values`. Raises KeyError, TypeError, ValueError for other values."""
    import numpy as np

    from rtloop.design.robust.programme import Taps

    reference, command = (np.array(values[key], float) for key in ("taps", "command_taps"))
    if reference.ndim != 1 or command.shape != reference.shape:
        raise ValueError("two rows of as many taps are needed")
    return Taps(reference, command, 0.0)


def _swap_in(client: Client, axis: str, old: Taps, new: Taps) -> int:
    """Change from the old taps to the new ones in SWAP_STAGES equal steps. Returns the tick of the last one."""
    import numpy as np

    from rtloop.design.robust.programme import Taps
    from rtloop.design.robust.section import taps_values

    length, tick = max(old.reference.size, new.reference.size), 0
    for share in np.arange(1, SWAP_STAGES + 1) / SWAP_STAGES:
        reference, command = (
            (1 - share) * np.pad(old_row, (0, length - old_row.size))
            + share * np.pad(new_row, (0, length - new_row.size))
            for old_row, new_row in ((old.reference, new.reference), (old.command, new.command))
        )
        values = taps_values(Taps(reference, command, new.overshoot))
        change = {"axis": axis, "section": "prefilter", "values": values}
        tick = int(client.post("/tune", change, RESPONSE_TIMEOUT_S)["tick"])
    return tick


def _current_taps(axis: AxisOptions) -> Taps:
    """Make taps, two rows of one length, of an axis's prefilter."""
    import numpy as np

    from rtloop.design.robust.programme import Taps

    rows = axis.prefilter.taps or (1.0,), axis.prefilter.command_taps or (0.0,)
    length = max(map(len, rows))
    reference, command = (np.pad(np.asarray(row, float), (0, length - len(row))) for row in rows)
    return Taps(reference, command, 0.0)


def _measures_with_gain_error(stage: StageMeasurement, subject: Subject, taps: Taps) -> StepMeasures | None:
    """Step with the gain off by one standard deviation, each figure to its worse side; None for the model's gain."""
    from rtloop.design.robust.shape import StepMeasures, measure_step

    if stage.gain is None or stage.gain_percent is None:
        return None
    std_percent, nominal = 100 * stage.gain["std"] / stage.gain["value"], subject.family().nominal
    ends = [measure_step(subject, taps, nominal._replace(gain=percent)) for percent in (-std_percent, std_percent)]
    return StepMeasures(*(max(values) for values in zip(*ends, strict=True)))


def _print_comparison(
    stage: StageMeasurement, before: StepMeasures, after: StepMeasures, after_gain_error: StepMeasures | None
) -> None:
    """Print measured resonance and gain, and figures of a step with the old taps and the new ones."""
    mode, gain, percent = stage.mode, stage.gain, stage.gain_percent
    click.echo(f"resonance {mode['hz']:.2f} ± {mode['hz_std']:.2f} Hz, {stage.percent:+.2f} % from the model's")
    if gain is None:
        click.echo("gain not measured; the model's is taken")
    else:
        usage = "too uncertain; the model's is taken" if percent is None else f"{percent:+.2f} % from the model's"
        span = f"between {gain['from_um']:.4g} and {gain['to_um']:.4g} µm"
        click.echo(f"gain {gain['value']:.4f} ± {gain['std']:.4f} {span}, {usage}")
    step_table = table("of a step there", "settling / ms", "overshoot / %", "largest v per unit")
    rows = {
        "with the taps in force": before,
        "with the new ones": after,
        "the same, gain off by its ±": after_gain_error,
    }
    for name, step in rows.items():
        if step is not None:
            figures = (f"{step.settling_ms:.3f}", f"{100 * step.overshoot:.3f}", f"{step.highest_command:.4f}")
            step_table.add_row(name, *figures)
    console().print(step_table)
