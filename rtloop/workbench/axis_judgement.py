"""Judgement of one axis of a configuration: analyses of its loop, tolerated shifts, verdict by its specification."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from rtloop.analysis.loop_analysis import LoopAnalysis
from rtloop.analysis.perturbation import PercentRange, loop_builder, plant_changes, stability_range
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.cautions import rig_problem, tracking_problem
from rtloop.configuration.checks import AxisCheck
from rtloop.configuration.prepare import Prepared
from rtloop.configuration.simulated import compare_with_rig
from rtloop.supervision.host_delay import HostDelay, SpentMargin, spent_margin

if TYPE_CHECKING:
    from rtloop.design.verification.verify import Verification


@dataclass(frozen=True)
class AxisJudgement:
    """Limits, analyses and verdict of one axis.

    `shifts` are the ranges (down, up), percent, both ≥ 0, by which the resonance may move while the loop stays stable:
    "continuous" for C(s), "running" for the loop as it runs; an end is None if the search found no limit.
    `is_stable_on_rig` is None where configuration and simulated rig agree and the loop is stable there, and where no
    rig or loop is known; `verification` is None without a specification or loop. `spent` is the delay that this host
    adds, and the loop's delay margin; None without a measurement or a stable loop. `problems` has a sentence for each
    contradiction between axis and hardware, because of which another loop would run, and for a loop that does not
    follow its reference on its model or on the simulated rig.
    """

    axis: AxisOptions
    check: AxisCheck
    shifts: Mapping[str, PercentRange]
    is_stable_on_rig: bool | None
    verification: Verification | None
    spent: SpentMargin | None
    problems: tuple[str, ...] = ()

    @property
    def running(self) -> LoopAnalysis | None:
        """Margins and step figures of the loop as it will run; None without a model or a linear controller."""
        return self.check.running

    @property
    def continuous(self) -> LoopAnalysis | None:
        """Margins and step figures of C(s) on the model, without sampling or delay.

        None without a model, and for a law that is not made from a C(s).
        """
        return self.check.continuous

    @property
    def meets_specification(self) -> bool | None:
        """Whether the loop meets the axis's specification; None without a specification or a known loop.

        The loop must be stable, meet each requirement on the model, in the specification's scenarios and on the
        simulated rig, and bear this host's measured delay; without a rig, no key may contradict the driver. False with
        an empty `missed` is therefore possible.
        """
        return None if self.verification is None else self.verification.meets_specification

    @property
    def missed(self) -> list[str] | None:
        """Labels of the requirements that the running loop misses, [] if none; None without a specification or a known
        loop.

        The requirements are judged on the model or, if the loop on the simulated rig was judged too, on the rig alone.
        """
        if self.verification is None:
            return None
        return [row.label for row in (self.verification.on_rig or self.verification).missed_rows]

    def as_dict(self) -> dict[str, Any]:
        """Return the object of the axis in `axes` of `rtloop check --json`; parts that do not exist are None."""
        check, coupled = self.check, self.check.together
        return {
            "name": check.name,
            "host_delay": self.spent and asdict(self.spent),
            "comparison": check.comparison and check.comparison.as_dict(),
            "continuous": self.continuous and self.continuous.as_dict(),
            "running": self.running and self.running.as_dict(),
            "stable_on_rig": self.is_stable_on_rig,
            "together": coupled
            and {"axes": list(coupled.axes), "margins": coupled.margins and coupled.margins.as_dict()},
            "meets": self.meets_specification,
            "missed": self.missed,
            "problems": list(self.problems),
            "resonance_shift_tolerated_percent": {name: list(value) for name, value in self.shifts.items()},
        }


def judge_axis(prepared: Prepared, axis: AxisOptions, check: AxisCheck, host: HostDelay | None) -> AxisJudgement:
    """Return analyses, tolerated shifts, stability on the rig and verdict of one axis.

    `host` is the measured delay of this host, None without a measurement.

    Raises ConfigError for an invalid specification, and where neither axis nor specification has a model of the plant;
    InputFileError for a specification that cannot be read.
    """
    comparison = compare_with_rig(prepared.configuration, axis, check)
    loop_problems = (tracking_problem(check), rig_problem(axis, check, comparison))
    on_rig = comparison.on_rig
    return AxisJudgement(
        axis=axis,
        check=check,
        shifts=_tolerated_shifts(check),
        is_stable_on_rig=None if on_rig is None or on_rig.on_model is None else on_rig.on_model.is_stable,
        verification=_verify_axis(prepared, axis, check),
        spent=host and spent_margin(check, host),
        problems=(*comparison.contradictions, *filter(None, loop_problems)),
    )


def _verify_axis(prepared: Prepared, axis: AxisOptions, check: AxisCheck) -> Verification | None:
    """Judge an axis by its specification. Returns None without a specification or a known linear loop.

    No loop is known without a linear law, and for a shared controller without the models of all its axes. Raises
    ConfigError for an invalid specification, and where neither axis nor specification has a model of the plant;
    InputFileError for a specification that cannot be read.
    """
    if axis.specification is None or not check.is_known:
        return None
    from rtloop.design.verification.axes import verify_axis  # half a second of import

    return verify_axis(prepared.configuration, check, None)[0]


def _tolerated_shifts(check: AxisCheck) -> dict[str, PercentRange]:
    """Return {continuous, running}: ranges (down, up), percent, both ≥ 0, by which the model's resonance may move while
    the loop stays stable.

    (0, 0) for an unstable loop; an end is None if the search found no limit there. "continuous" belongs to C(s), and is
    missing for other laws; "running" belongs to the loop as it runs. {} without a loop on a model with a resonance.
    """
    if check.plant is None or check.on_model is None:
        return {}
    resonance = plant_changes(check.plant).get("resonance")
    if resonance is None:
        return {}
    running = stability_range(lambda plant: check.loop(plant, check.delay_ticks), check.plant, resonance)
    if check.controller is None:
        return {"running": running}
    return {"continuous": stability_range(loop_builder(check.controller), check.plant, resonance), "running": running}
