"""Identification of the dynamics D(s) of an axis from recorded steps, other excitations or a closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtloop.design.identification.axis_recording import AxisRecording, read_axis_recording
from rtloop.design.identification.dynamics.dynamics_fit import LARGEST_RELATIVE_STD, DynamicsFit
from rtloop.design.identification.dynamics.excitation import LoopExcitation
from rtloop.design.identification.dynamics.identify_delay import delay_input
from rtloop.design.identification.dynamics.identify_dynamics import Criterion
from rtloop.design.identification.dynamics.identify_in_loop import identify_recorded_dynamics
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.design.identification.dynamics.recorded_loop import RecordedLoop, State, find_closed_loop
from rtloop.design.identification.dynamics.visible_band import visible_hz
from rtloop.design.identification.frequency_response import FrequencyResponse, compare_responses, recording_response
from rtloop.design.identification.model_sections import (
    dynamics_provenance,
    feedforward_section,
    model_section,
    proportional_actuator,
    scale_hysteresis,
)
from rtloop.errors import ConfigError
from rtloop.hysteresis.play_model import PlayModel
from rtloop.linear.transfer import Transfer
from rtloop.values import count_text, dataclass_fields, to_jsonable
from rtloop.workbench.dynamics_excitation import Input, dynamics_excitation, load_actuator
from rtloop.workbench.dynamics_text import print_dynamics
from rtloop.workbench.hysteresis import read_distinct_runs
from rtloop.workbench.identified_model import IdentifiedModel, Warn, WarningCollector

if TYPE_CHECKING:
    import control
    from matplotlib.figure import Figure
    from rich.console import Console

    from rtloop.design.identification.frequency_response import Agreement


@dataclass(repr=False, eq=False)
class DynamicsResult(IdentifiedModel):
    """Identified dynamics: `fit` has D(s) and the evidence, `runs` and `loops` the recordings and their closed loops.

    `loops` has None for a recording in open loop. `excitation` is the input and output of the first recording, without
    free motion, `actuator` the model of the hysteresis before the dynamics; None for another input than "hysteresis".
    `response` is a measured frequency response, `comparison` the model's deviation from it; None without a recording to
    compare.
    """

    fit: DynamicsFit
    runs: list[AxisRecording]
    loops: list[RecordedLoop | None]
    input: Input
    excitation: Excitation
    actuator: PlayModel | None
    response: FrequencyResponse | None
    comparison: Agreement | None
    warnings: list[str]

    @property
    def model(self) -> Transfer:
        """D(s) as zeros, poles and gain, with D(0) = 1, without its delay."""
        return self.fit.transfer

    @property
    def order(self) -> int:
        """Number of poles."""
        return self.fit.model.order

    @property
    def delay_ticks(self) -> int:
        """Delay in samples, beyond the single sample of a held output."""
        return self.fit.delay_ticks

    @property
    def visible_hz(self) -> float:
        """Frequency (Hz) up to which the recording shows the dynamics: beyond it, the driven motion is below the errors
        of the model, and no mode is certain.
        """
        certain_hz = (
            mode.frequency_hz
            for mode in self.fit.modes
            if mode.frequency_std_hz <= LARGEST_RELATIVE_STD * mode.frequency_hz
        )
        return max(visible_hz(self.fit.model, delay_input(self.excitation, self.delay_ticks)), *certain_hz, 0.0)

    @property
    def section(self) -> str:
        """The dynamics as [axis.model]; before it, with an `actuator`, its plays as [axis.feedforward], with weights
        times the static gain.

        For the input "drive" [axis.feedforward] is the static gain alone, left out if the gain is not above 0.

        Raises UnsuitableData for hysteresis without an inverse.
        """
        return _section_text(self.fit, self.runs[0], self.input, self.actuator)

    @property
    def headline(self) -> str:
        """Order, frequency (Hz) and damping of each mode, delay in samples and fit in percent, in one line."""
        modes = ", ".join(f"{mode.frequency_hz:.1f} Hz (ζ {mode.damping:.4f})" for mode in self.fit.modes)
        delay = count_text(self.delay_ticks, "sample")
        return f"order {self.order}: {modes}; delay {delay}, fit {self.fit.fit_percent:.2f} %"

    def to_control(self) -> control.StateSpace | control.FrequencyResponseData:
        """Return D(s), without its delay, as a continuous StateSpace of python-control, a required package."""
        from rtloop.design.interchange import to_control

        return to_control(self.model)

    def as_dict(self) -> dict[str, Any]:
        """Return the object of `rtloop identify dynamics --json`."""
        fit, loop = self.fit, self.loops[0]
        tests = {"white": fit.tests.is_white, "independent": fit.tests.is_independent}
        return to_jsonable(
            {"recordings": [run.name for run in self.runs], "digests": [run.digest for run in self.runs]}
            | {"input": self.input, "sampled_together": self.runs[0].is_sampled_together}
            | {"loop": loop and {"from_tick": loop.start, "to_tick": loop.end, "outside": loop.names}}
            | {"begins_in_motion": loop is None and isinstance(self.excitation, LoopExcitation)}
            | {key: value for key, value in dataclass_fields(fit).items() if key not in ("model", "free_motion_um")}
            | {"order": self.order, "visible_hz": self.visible_hz, "nyquist_hz": 0.5 / self.excitation.period_s}
            | {"tests": dataclass_fields(fit.tests) | tests}
            | {"frequency_response": self.comparison, "output": self.output, "plot": self.picture}
        )

    def print_text(self, out: Console) -> None:
        """Print orders that were tried, modes with their uncertainty, tests of the residuals, a measured response."""
        print_dynamics(out, self.as_dict())

    def plot(self) -> Figure:
        """Return a picture of response and model over time and over frequency.

        Raises MissingExtra without matplotlib.
        """
        from rtloop.design.identification.plots import draw_dynamics

        return draw_dynamics(
            self.fit,
            delay_input(self.excitation, self.delay_ticks),
            self.response,
            "V" if self.input == "drive" else "µm",
        )


def fit_dynamics(
    paths: Sequence[Path],
    *,
    axis: str | None = None,
    hysteresis: Path | None = None,
    input: Input = "hysteresis",
    order: int | None = None,
    largest_order: int = 14,
    delay: int | None = None,
    criterion: Criterion | None = None,
    loop: State = "auto",
    outside: Sequence[str] = (),
    detrend: bool = False,
    compare: Path | None = None,
    warn: Warn = lambda _: None,
) -> DynamicsResult:
    """Identify D(s) from the first recording, and validate it with the others.

    `input` of D is the drive through the model of the hysteresis, the command, or the drive. `hysteresis` is a file
    with the actuator's model (None: the recorded configuration). `order`, `delay` (as `delay_ticks`) None: searched,
    the order up to `largest_order` by `criterion` (None: "held-out"). `loop` says whether the loop was closed
    ("auto": by the recorded mode), `outside` which signals moved the closed loop. `detrend` subtracts the
    straight line of each signal. `compare` is a recording for a
    measured frequency response. `warn` receives lists of warnings before the fit. Raises RtloopError for recordings
    that cannot be used, ConfigError where no model can be fitted.
    """
    collect = WarningCollector(warn)
    runs = read_distinct_runs(paths, axis, collect)
    loops = [find_closed_loop(Path(run.name), axis, loop, outside) for run in runs]
    actuator = load_actuator(runs[0], hysteresis, axis) if input == "hysteresis" else None
    excitations = [
        dynamics_excitation(run, input, actuator, closed_loop, detrends=detrend)
        for run, closed_loop in zip(runs, loops, strict=True)
    ]
    try:
        fit = identify_recorded_dynamics(excitations[0], order, largest_order, criterion, excitations[1:], delay)
    except ValueError as fault:
        raise ConfigError("identify dynamics", [str(fault)]) from None
    if fit.free_motion_um is not None:
        excitations[0] = replace(excitations[0], position_um=excitations[0].position_um - fit.free_motion_um)
    response, comparison = None, None
    if compare is not None:
        closed_loop = find_closed_loop(compare, axis, loop, outside)
        compared = read_axis_recording(compare, axis)
        excitation = dynamics_excitation(compared, input, actuator, closed_loop, detrends=detrend)
        response = recording_response(delay_input(excitation, fit.delay_ticks))
        comparison = compare_responses(fit.model, response)
    return DynamicsResult(fit, runs, loops, input, excitations[0], actuator, response, comparison, collect.warnings)


def _section_text(fit: DynamicsFit, run: AxisRecording, input_kind: Input, actuator: PlayModel | None) -> str:
    """Return [axis.model] as TOML; before it, where the input is not the command, [axis.feedforward].

    [axis.feedforward] is `actuator` with weights times the static gain; for the input "drive", the static gain without
    hysteresis, left out if it is not above 0. Raises UnsuitableData for scaled hysteresis without an inverse.
    """
    content = model_section(fit, dynamics_provenance(fit, run, input_kind))
    comments = [f"Hysteresis model, multiplied by the static gain {fit.static_gain:.6g} of the dynamics below"]
    scaled = None if actuator is None else scale_hysteresis(actuator, fit.static_gain)
    if input_kind == "drive":
        scaled = proportional_actuator(fit.static_gain)
        comments = [f"Model without hysteresis: only the static gain {fit.static_gain:.6g} µm/V of the dynamics below"]
    return content if scaled is None else feedforward_section(scaled, comments) + "\n" + content
