"""`rtloop.check`: the loops of a configuration judged on paper: limits, margins, steps and tolerated changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rtloop.analysis.closed_loop import Loop, continuous_loop
from rtloop.configuration.cautions import cautions
from rtloop.configuration.checks import AxisCheck
from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.drivers.base import channel_index
from rtloop.drivers.errors import DriverError
from rtloop.errors import ConfigError, UnavailableError
from rtloop.supervision.host_delay import load_host_delay
from rtloop.supervision.recording_path import recordings_folder
from rtloop.values import count_text, to_jsonable
from rtloop.workbench.arguments import FileName, load_configuration
from rtloop.workbench.axis_judgement import AxisJudgement, judge_axis
from rtloop.workbench.check_text import print_axis, print_plan
from rtloop.workbench.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console


@dataclass(frozen=True, repr=False, eq=False)
class CheckResult(Result):
    """Result of a check: the plan of the run, `warnings`, and the judgement of each axis in `axes`, by its name."""

    prepared: Prepared
    warnings: list[str]
    axes: Mapping[str, AxisJudgement]

    @property
    def headline(self) -> str:
        """Name, verdict of each axis, and the number of warnings."""
        verdicts = ", ".join(f"axis {name} {_verdict(judgement)}" for name, judgement in self.axes.items())
        return f"{self.prepared.plan.name}: {verdicts}; {count_text(len(self.warnings), 'warning')}"

    def as_dict(self) -> dict[str, Any]:
        """Return the object of `rtloop check --json`.

        Keys: name, rate_hz, mode, driver, recordings (the folder), columns, warnings and axes (a list with
        `AxisJudgement.as_dict` of each).
        """
        plan = self.prepared.plan
        return to_jsonable(
            {
                "name": plan.name,
                "rate_hz": plan.pacing.rate_hz,
                "mode": plan.mode.name.lower(),
                "driver": plan.driver_kind,
                "recordings": str(recordings_folder(self.prepared.configuration)),
                "columns": list(plan.columns),
                "warnings": self.warnings,
                "axes": [judgement.as_dict() for judgement in self.axes.values()],
            }
        )

    def print_text(self, out: Console) -> None:
        """Print the plan, then limits, law, analyses and verdict of each axis; the warnings are not printed."""
        print_plan(out, self.prepared)
        inputs, channels = self.prepared.facts.inputs, self.prepared.configuration.channels
        for name, judgement in self.axes.items():
            print_axis(out, judgement, inputs[channel_index(inputs, channels[name].input)])

    def plot(self) -> Figure:
        """Return a picture with a column for each axis whose loop is known: |L|, |S|, and the step.

        Raises ConfigError if no loop is known, MissingExtra without matplotlib.
        """
        from rtloop.workbench.loop_picture import draw_loops

        loops = {name: _loops(judgement.check) for name, judgement in self.axes.items()}
        known = {name: loops_by_label for name, loops_by_label in loops.items() if loops_by_label}
        if not known:
            fault = "no loop is known; a loop needs [axis.controller] with a linear law, and [axis.model]"
            raise ConfigError(self.prepared.configuration.source, [fault])
        return draw_loops(known)


def check(configuration: FileName | Configuration, *, strict: bool = False) -> CheckResult:
    """Judge the loops of a configuration: limits, C(z) against C(s), margins on the model, verdict by specification.

    Touches no hardware. `strict` treats as faults also the warnings, and each pole, margin or step for which
    python-control computes another value. Raises InputFileError for a file that cannot be read, ConfigError with all
    faults, UnavailableError for a driver whose library is missing.

    >>> result = rtloop.check("deploy/paper.toml")
    >>> round(result.axes["x"].running.phase_margin_deg, 1), result.axes["x"].meets_specification
    (73.1, False)
    """
    loaded = load_configuration(configuration, "check")
    try:
        prepared = prepare(loaded)
    except DriverError as error:
        raise UnavailableError(str(error)) from error
    warnings = [*prepared.warnings, *cautions(prepared)]
    if strict and (faults := [*warnings, *_second_opinion_faults(prepared)]):
        raise ConfigError(loaded.source, faults)
    host = load_host_delay(prepared.configuration)
    axes = {
        axis.name: judge_axis(prepared, axis, axis_check, host)
        for axis, axis_check in zip(prepared.configuration.axes, prepared.checks, strict=True)
    }
    return CheckResult(prepared, warnings, axes)


def _second_opinion_faults(prepared: Prepared) -> list[str]:
    """Return a sentence for each pole, margin or step of a loop for which python-control computes another value.

    [] if all agree within the tolerances of `second_opinion`. python-control is a required package.
    """
    from rtloop.configuration.second_opinion import faults_on_models  # more than a second of import

    return faults_on_models(prepared)


def _loops(check: AxisCheck) -> dict[str, Loop]:
    """Return the loops of an axis on its model by label: "continuous C(s)", if there is a C(s), then "as it runs".

    {} if the loop on the model is not known.
    """
    if check.on_model is None:
        return {}
    loops = {"as it runs": check.on_model}
    if check.controller is not None and check.plant is not None:
        loops = {"continuous C(s)": continuous_loop(check.controller, check.plant)} | loops
    return loops


def _verdict(judgement: AxisJudgement) -> str:
    """Return the verdict on an axis in a few words: "without a known loop", "UNSTABLE", or that of its specification.

    The loop is UNSTABLE if it is so on the model or on the simulated rig. Without a specification it is "stable".
    """
    if judgement.running is None:
        return "without a known loop"
    if not judgement.running.stable or judgement.is_stable_on_rig is False:
        return "UNSTABLE"
    verdicts = {None: "stable", True: "meets its specification", False: "misses its specification"}
    return verdicts[judgement.meets_specification]
