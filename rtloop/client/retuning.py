"""Taps of an axis designed anew for its measured resonance and gain, and swapped in while the loop runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop.analysis.perturbation import change_gain, resonance_hz, shift_resonance
from rtloop.client.control import Client
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration, parse
from rtloop.design.robust.programme import Taps
from rtloop.design.robust.section import taps_values
from rtloop.design.robust.shape import ALLOWED_EXCESS, PROOF_POINTS, StepMeasures, Subject, design_taps, measure_step
from rtloop.design.robust.subject import load_subject
from rtloop.design.toml_text import write_section
from rtloop.errors import ConfigError, LoopFault

STAGES = 4
"""Steps in which new taps replace the old ones, so that a scan that plays meanwhile does not jump."""
GAIN_PART = 4.0
"""The gain is measured over the largest step divided by this; over less, residual hysteresis weighs more."""
GAIN_CERTAIN_PERCENT = 1.0
"""Largest standard deviation with which a measured gain replaces the model's; more would cost overshoot."""
EXCITATION_S, MEASUREMENT_TIMEOUT_S = 1.0, 120.0
"""Duration of the excitation at full amplitude; longest wait for a response."""


class RetuneRequest(NamedTuple):
    """Limits of one retuning of `axis`; defaults as in `rtloop ctl retune`."""

    axis: str
    amplitude_um: float = 0.5
    """Largest added motion of the position while the resonance is measured."""
    gain_um: float | None = None
    """Distance of the references between which the gain is measured; None: a quarter of the largest step; 0: none."""
    bound_percent: float = 15.0
    """Largest distance of resonance and gain from the model's; a larger one is refused."""
    within_percent: float = 1.0
    """The taps suit resonances within this distance of the measured one."""
    spec: Path | None = None
    """Specification file; None: the axis's."""


class MeasuredStage(NamedTuple):
    """Resonance and gain of the running loop, and their distances from the model's in percent."""

    resonance: dict[str, object]
    """Measured mode: hz, hz_std, damping, damping_std, from_hz, to_hz, misfit."""
    percent: float
    """Distance of the resonance's frequency; above 0 if it is higher than the model's."""
    gain: dict[str, float] | None
    """Measured gain in µm of position per µm of command: value, std, from_um, to_um; None if it was not measured."""
    gain_percent: float | None
    """Distance of the gain, above 0 if it is larger than the model's; None if the model's gain is used instead."""


class Proposal(NamedTuple):
    """New taps for an axis, the loop's present taps, `replaced`, and figures of a step of the measured stage with the
    present (`before`) and with the new ones (`after`).
    """

    axis: str
    stage: MeasuredStage
    before: StepMeasures
    after: StepMeasures
    at_gain_bounds: StepMeasures | None
    """Larger value of each figure in two steps with the new taps, the gain off by ± its standard deviation; None: the
    model's gain.
    """
    is_better: bool
    settling_ms: float
    """Settling time that the design predicts."""
    replaced: Taps
    taps: Taps

    def for_json(self) -> dict[str, object]:
        """Return the proposal as plain values, as `rtloop ctl retune --json` prints it and `swap_in` takes it.

        Keys: resonance, percent_from_model, gain, gain_percent_from_model (fields of `stage`, the last two may be
        None), before, after (dicts of step figures), better, settling_ms, replaces (the present taps of the loop) and
        prefilter (the new taps), both {taps, command_taps}.
        """
        return {
            "resonance": self.stage.resonance,
            "percent_from_model": self.stage.percent,
            "gain": self.stage.gain,
            "gain_percent_from_model": self.stage.gain_percent,
            "before": self.before._asdict(),
            "after": self.after._asdict(),
            "better": self.is_better,
            "settling_ms": self.settling_ms,
            "replaces": taps_values(self.replaced),
            "prefilter": taps_values(self.taps),
        }


def propose_taps(client: Client, request: RetuneRequest) -> Proposal:
    """Measure resonance and gain of an axis and design taps for them; the loop keeps its taps.

    The loop moves for the measurement. A gain that was not measured, or only with a standard deviation above
    GAIN_CERTAIN_PERCENT, is replaced by the model's. Raises ConfigError for an axis or model that does not allow it,
    LoopFault if no resonance is found or a measured value that is used is further than `bound_percent` from the
    model's, NoDesign if no taps meet the specification, InputFileError for a specification that cannot be read,
    RtloopError if the service refuses.
    """
    axis, subject, _ = load_subject(_running_configuration(client), request.axis, request.spec)
    stage = _measure_stage(client, request, subject)
    plant = change_gain(shift_resonance(subject.plant, stage.percent), stage.gain_percent or 0.0)
    measured = replace(subject.restrict_resonance(request.within_percent), plant=plant)
    design, in_force = design_taps(measured, may_be_late=True), _taps_in_force(axis)
    nominal = measured.family().nominal
    before, after = measure_step(measured, in_force, nominal), measure_step(measured, design.taps, nominal)
    return Proposal(
        axis=request.axis,
        stage=stage,
        before=before,
        after=after,
        at_gain_bounds=_step_at_gain_bounds(stage, measured, design.taps),
        is_better=_is_better(measured, before, after),
        settling_ms=design.settling_ms,
        replaced=in_force,
        taps=design.taps,
    )


def swap_in(client: Client, axis: str, proposal: Mapping[str, Any]) -> int:
    """Load the taps of `proposal` in STAGES stages, interpolated between old and new; return the last one's tick.

    Raises ConfigError if `axis` is unknown or `proposal` is no output of `rtloop ctl retune --json`
    (`Proposal.for_json`), LoopFault if the loop's taps are no longer the ones that the proposal replaces, RtloopError
    if the service refuses a stage: the loop then keeps the taps of the stage before.
    """
    axes = {options.name: options for options in _running_configuration(client).axes}
    if (options := axes.get(axis)) is None:
        raise ConfigError("retune", [f"axis: {axis!r} is unknown; allowed: {', '.join(axes)}"])
    try:
        replaced, taps = (_read_taps(proposal[key]) for key in ("replaces", "prefilter"))
    except (ValueError, KeyError, TypeError, RecursionError):
        fault = "proposal: not a proposal; allowed: the output of `rtloop ctl retune AXIS --json`"
        raise ConfigError("retune", [fault]) from None
    if taps_values(replaced) != taps_values(_taps_in_force(options)):
        raise LoopFault(f"retune: the taps of axis {axis} were changed since the proposal was made; retune again")
    tick = 0
    for part in np.arange(1, STAGES + 1) / STAGES:
        values = taps_values(_interpolate_taps(replaced, taps, part))
        change = {"axis": axis, "section": "prefilter", "values": values}
        tick = int(client.post("/tune", change)["tick"])
    return tick


def _measure_stage(client: Client, request: RetuneRequest, subject: Subject) -> MeasuredStage:
    """Measure resonance and gain, and return them with their distances from the model's.

    The loop moves. `gain_percent` is None for a gain that was not measured, or only with a standard deviation above
    GAIN_CERTAIN_PERCENT. Raises ConfigError for a model without resonance, LoopFault if no resonance was found or a
    distance exceeds the request's bound.
    """
    model_hz = resonance_hz(subject.plant)
    if model_hz is None:
        raise ConfigError(
            "retune", [f"axis.{request.axis}.model: no lightly damped mode; retuning needs a model with a resonance"]
        )
    body = {
        "axis": request.axis,
        "amplitude_um": request.amplitude_um,
        "duration_s": EXCITATION_S,
        "resonance_only": True,
        "gain_um": subject.bounds.step_um / GAIN_PART if request.gain_um is None else request.gain_um,
    }
    content = client.post("/response", body, MEASUREMENT_TIMEOUT_S)
    mode, gain = content["resonance"], content["gain"]
    if mode is None:
        raise LoopFault(
            f"retune: no lightly damped mode stands out near the model's {model_hz[0]:.4g} Hz; the taps stay as they "
            "are; use a larger amplitude, or identify the model again"
        )
    percent = 100 * (mode["hz"] / model_hz[0] - 1)
    _require_near(f"resonance is at {mode['hz']:.2f} Hz", percent, request.bound_percent)
    if gain is None or 100 * gain["std"] > GAIN_CERTAIN_PERCENT * gain["value"]:
        return MeasuredStage(mode, percent, gain, None)
    gain_percent = 100 * (gain["value"] / subject.plant.dc_gain - 1)
    _require_near(f"gain is {gain['value']:.4f}", gain_percent, request.bound_percent)
    return MeasuredStage(mode, percent, gain, gain_percent)


def _require_near(quantity_text: str, percent: float, bound_percent: float) -> None:
    """Raise LoopFault if a measured value differs from the model's by `percent`, of either sign, and |percent| is above
    `bound_percent`.

    `quantity_text` states quantity and value in the message, such as "gain is 1.0200".
    """
    if abs(percent) > bound_percent:
        raise LoopFault(
            f"retune: the measured {quantity_text}, {percent:+.2f} % from the model's; allowed: within "
            f"±{bound_percent:g} % (bound_percent); the taps stay as they are; identify the model again"
        )


def _is_better(subject: Subject, before: StepMeasures, after: StepMeasures) -> bool:
    """Return whether the new taps are better: they settle sooner by more than 1/PROOF_POINTS of a tick, or the old ones
    exceed the specification's overshoot or limits of the command, and the new ones do so less or not at all.

    `before` and `after` are the steps with the old and with the new taps.
    """
    point_ms = 1e3 * subject.controller.period_s / PROOF_POINTS
    return (
        round((before.settling_ms - after.settling_ms) / point_ms) > 1
        or before.overshoot > max(subject.overshoot, after.overshoot)
        or before.excess > max(ALLOWED_EXCESS, after.excess)
    )


def _running_configuration(client: Client) -> Configuration:
    """Return the configuration of the service's running loop, with the changes since its start.

    Raises RtloopError without a loop or service, ConfigError if the configuration is not valid in this process, such as
    for another version of rtloop.
    """
    response = client.get("/configuration")
    text = write_section("", response["values"])
    return parse(text, "running", Path(response["folder"]), "the running configuration")


def _read_taps(values: dict[str, list[float]]) -> Taps:
    """Return Taps with the rows `taps` and `command_taps` of `values`, a result of `taps_values`, and overshoot 0.

    Raises KeyError, TypeError or ValueError for other values.
    """
    reference, command = (np.array(values[key], float) for key in ("taps", "command_taps"))
    if reference.ndim != 1 or command.shape != reference.shape:
        raise ValueError("taps: the rows differ in length; allowed: two rows of the same length")
    return Taps(reference, command, 0.0)


def _taps_in_force(axis: AxisOptions) -> Taps:
    """Return the taps of a configured axis, with overshoot 0: both rows (n,), padded with zeros to one length.

    Without configured taps the rows are [1] for the reference and [0] for the command.
    """
    rows = axis.prefilter.taps or (1.0,), axis.prefilter.command_taps or (0.0,)
    reference, command = _pad_rows(*(np.asarray(row, float) for row in rows))
    return Taps(reference, command, 0.0)


def _interpolate_taps(old: Taps, new: Taps, part: float) -> Taps:
    """Return the taps (1 − part)·old + part·new, with the weight `part` from 0 to 1 and the overshoot of `new`.

    All rows are padded with zeros at the end to one length.
    """
    rows = (
        (1 - part) * old_row + part * new_row
        for old_row, new_row in (_pad_rows(old.reference, new.reference), _pad_rows(old.command, new.command))
    )
    reference, command = _pad_rows(*rows)
    return Taps(reference, command, new.overshoot)


def _pad_rows(*rows: np.ndarray) -> list[np.ndarray]:
    """Return copies of the rows (n,), in their order, padded with zeros at the end to the length of the longest."""
    length = max(row.size for row in rows)
    return [np.pad(row, (0, length - row.size)) for row in rows]


def _step_at_gain_bounds(stage: MeasuredStage, subject: Subject, taps: Taps) -> StepMeasures | None:
    """Return the larger value of each figure of two steps with `taps`: one with the measured gain plus its standard
    deviation, one with the gain minus it.

    None if the model's gain is used. Raises NoDesign if a loop with such a gain is unstable.
    """
    if stage.gain is None or stage.gain_percent is None:
        return None
    off_percent, nominal = 100 * stage.gain["std"] / stage.gain["value"], subject.family().nominal
    steps = [measure_step(subject, taps, nominal._replace(gain=gain)) for gain in (-off_percent, off_percent)]
    return StepMeasures(*(max(values) for values in zip(*steps, strict=True)))
