"""Results of `rtloop.replay`: of a replay, of another law on the recorded inputs, and of a resimulation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rtloop.recording.load import Recording
from rtloop.recording.replay.verdict import ReplayReport
from rtloop.recording.views.plot import draw_recording
from rtloop.values import count_text, to_jsonable
from rtloop.workbench.bar_picture import draw_bars
from rtloop.workbench.replay_text import METRICS, print_differences, print_replay, print_resimulation
from rtloop.workbench.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

    from rtloop.signals import Trip

PLOTTED_S = 0.05
"""Time before and after the first difference that a picture shows, s."""


@dataclass(frozen=True, repr=False, eq=False)
class ReplayResult(Result):
    """Result of a replay: its `report`, and the `recording` that was replayed, named `path` in the text."""

    path: Path
    recording: Recording
    report: ReplayReport

    @property
    def identical(self) -> bool:
        """Whether every recorded tick, at least one, was executed and compared, in order, once, and none differed.

        Ticks that the recording itself declares as lost do not count; other missing ticks make it False.
        """
        return self.report.identical

    @property
    def first_difference(self) -> dict[str, Any] | None:
        """First place where the replay differs from the recording: tick, signal, recorded, replayed; else None.

        `signal` may also be a field of the law, the rate, or the end of the run. None alone proves nothing: see
        `identical`.
        """
        return self.report.first_difference

    @property
    def ticks(self) -> int:
        """Number of compared ticks."""
        return self.report.ticks

    @property
    def gaps(self) -> list[dict[str, int]]:
        """Gaps of the files, [{first_tick, count}, …]: missing ticks, without the ticks that the recorder omitted on
        purpose because they lie outside the time around events.

        A gap that the recording does not declare as lost is in `not_verified` too.
        """
        return self.report.gaps

    @property
    def not_verified(self) -> list[dict[str, int | str | None]]:
        """Ticks that were not compared: [{first_tick, count, why}, …]; first_tick and count are None where unknown."""
        return self.report.not_verified

    @property
    def not_judged(self) -> list[str]:
        """Contents of the recording that no replay can judge, each described in words."""
        return self.report.not_judged

    @property
    def headline(self) -> str:
        """First difference or, without one, the verdict; then the number of compared ticks and the file, in a line."""
        difference = self.first_difference
        verdict = "identical" if self.identical else "not verified as a whole"
        if difference is not None:
            verdict = f"different at tick {difference['tick']} in {difference['signal']}"
        return f"{verdict}, {count_text(self.ticks, 'tick')} compared of {self.path}"

    def as_dict(self) -> dict[str, Any]:
        """Return the object of `rtloop replay --json`."""
        return to_jsonable(self.report.as_dict())

    def print_text(self, out: Console) -> None:
        """Print gaps, problems, ticks that are not verified, the verdict, and contents that are not judged."""
        print_replay(out, self.path, self.report)

    def plot(self) -> Figure:
        """Return a picture of the recording, from PLOTTED_S before the first difference to PLOTTED_S after it; of the
        whole recording if there is no difference.

        Raises RecordingError if there is no tick to draw, MissingExtra without matplotlib.
        """
        start_s, end_s = 0.0, math.inf
        if self.first_difference is not None:
            place = np.searchsorted(self.recording["tick"], self.first_difference["tick"])
            time_s = float(self.recording.time_s[place])
            start_s, end_s = time_s - PLOTTED_S, time_s + PLOTTED_S
        return draw_recording(self.recording, start_s, end_s)


@dataclass(frozen=True, repr=False, eq=False)
class LawComparison(Result):
    """Outputs of another law on the recorded inputs, compared with the recorded ones."""

    report: dict[str, Any]

    @property
    def ticks(self) -> int:
        """Number of compared ticks."""
        return self.report["ticks"]

    @property
    def signals(self) -> dict[str, dict[str, float]]:
        """Difference of each signal by its name: {max, at_tick, rms}; `max` and `rms` of |difference|, in its unit."""
        return self.report["signals"]

    @property
    def trip(self) -> Trip | None:
        """First trip of the other law, {tick, causes}; None without a trip."""
        return self.report["trip"]

    @property
    def headline(self) -> str:
        """Configuration, recording and number of ticks."""
        return f"the law of {self.report['config']} on {self.report['recording']}, {count_text(self.ticks, 'tick')}"

    def as_dict(self) -> dict[str, Any]:
        """Return the object of `rtloop replay --config CONFIG --json`."""
        return to_jsonable(self.report)

    def print_text(self, out: Console) -> None:
        """Print the largest and the root mean square difference of each signal, the law's trip, and problems."""
        print_differences(out, self.report)

    def plot(self) -> Figure:
        """Return a picture with the largest and the root mean square difference of each signal, in its unit.

        Raises MissingExtra without matplotlib.
        """
        bars = {key: [signal[key] for signal in self.signals.values()] for key in ("max", "rms")}
        return draw_bars("difference from the recorded signals", list(self.signals), bars)


@dataclass(frozen=True, repr=False, eq=False)
class Resimulation(Result):
    """The recorded reference in closed loop with a simulated rig, beside the recorded run."""

    report: dict[str, Any]

    @property
    def ticks(self) -> int:
        """Number of simulated ticks."""
        return self.report["ticks"]

    @property
    def axes(self) -> dict[str, dict[str, Any]]:
        """Tracking figures by the axis's name: {name, recorded, resimulated}, the last two {rms_error_um,
        max_abs_error_um, max_abs_drive_v, steps}. The errors are None if the loop was never closed; `steps` is
        `StepMetrics.as_dict`, None without a step.
        """
        return {axis["name"]: axis for axis in self.report["axes"]}

    @property
    def trips(self) -> dict[str, Trip | None]:
        """{recorded, resimulated}: the first trip of each run, {tick, causes}, None without a trip."""
        return self.report["trips"]

    @property
    def headline(self) -> str:
        """File of the configuration, or "the recorded law and rig", then recording and number of ticks."""
        law = self.report["config"] or "the recorded law and rig"
        return f"{law} with the reference of {self.report['recording']}, {count_text(self.ticks, 'tick')}"

    def as_dict(self) -> dict[str, Any]:
        """Return the object of `rtloop replay --resimulate --json`."""
        return to_jsonable(self.report)

    def print_text(self, out: Console) -> None:
        """Print figures of the recorded and the resimulated run side by side, their first trips, and problems."""
        print_resimulation(out, self.report)

    def plot(self) -> Figure:
        """Return a picture with tracking errors and drives of the recorded and of the resimulated run.

        Raises MissingExtra without matplotlib.
        """
        names = [f"{name}: {label}" for name in self.axes for _, label in METRICS]
        bars = {
            run: [axis[run][key] for axis in self.axes.values() for key, _ in METRICS]
            for run in ("recorded", "resimulated")
        }
        return draw_bars("the recorded run and the resimulated one", names, bars)
