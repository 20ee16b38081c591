"""Result of `rtloop.run`: outcome, trips, lateness, steps and the recording."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtloop.configuration.prepare import Prepared
from rtloop.errors import LoopFault
from rtloop.recording.load import Recording, load
from rtloop.recording.views.plot import draw_recording
from rtloop.recording.views.steps import StepMetrics
from rtloop.recording.views.summary import Summary, TripSummary
from rtloop.supervision.supervisor import RunResult as SupervisedRun
from rtloop.values import count_text, to_jsonable
from rtloop.workbench.result import Result
from rtloop.workbench.run_text import print_run
from rtloop.workbench.step_figures import steps_of_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console


@dataclass(frozen=True, repr=False, eq=False)
class RunResult(Result):
    """Result of a run: outcome, trips, ticks, lateness and steps; `recording` has the signals.

    `summary` has the figures of `rtloop info`; None without a recording. `supervised` is the end of the loop and of its
    recorder; None if a signal came before the loop began. `startup_s` is the time from the call to the first tick; None
    without a tick.
    """

    prepared: Prepared
    supervised: SupervisedRun | None
    summary: Summary | None
    warnings: list[str]
    startup_s: float | None

    @property
    def outcome(self) -> str:
        """Outcome: done, stopped, driver_failed, heartbeat_lost, law_failed, failed or killed.

        A run that tripped and went on with parked outputs is done or stopped: see `trips`.
        """
        return "stopped" if self.supervised is None else self.supervised.outcome

    @property
    def exit_code(self) -> int:
        """Exit code of the command for this run: 0 if the outcome is done or stopped, without a trip and with a
        complete recording; else the code of the failure.

        The code after a trip and for an incomplete recording is LoopFault's, 1.
        """
        code = 0 if self.supervised is None else self.supervised.exit_code
        return code or (LoopFault.exit_code if self.trips else 0)

    @property
    def error(self) -> str | None:
        """Cause of a failed run or recording in words; None for a good one, also after a trip alone: see `trips`."""
        return None if self.supervised is None else self.supervised.error

    @property
    def notes(self) -> list[str]:
        """Notes of the recorder, such as a file that was removed for space."""
        return [] if self.supervised is None else self.supervised.notes

    @property
    def recordings(self) -> list[Path]:
        """Files of the recording, in the order of the run; [] if nothing was recorded."""
        return [] if self.supervised is None else self.supervised.recordings

    @cached_property
    def recording(self) -> Recording | None:
        """The recording, opened as by `rtloop.load`, with its errors; None if nothing was recorded."""
        return load(self.recordings) if self.recordings else None

    @property
    def trips(self) -> list[TripSummary]:
        """Trips of the loop, with tick, causes and reason, in their order; [] without a trip or a recording."""
        return [] if self.summary is None else self.summary.trips

    @property
    def ticks(self) -> int:
        """Number of recorded ticks; 0 without a recording."""
        return 0 if self.summary is None else self.summary.ticks_logged

    @property
    def lateness_us(self) -> dict[str, float] | None:
        """Quantiles of the ticks' lateness in µs: p50, p99, p999, max; None in virtual time and without a recording."""
        return None if self.summary is None else self.summary.lateness_us

    @property
    def exec_us(self) -> dict[str, float] | None:
        """Quantiles of the ticks' execution time in µs: p50, p99, p999, max.

        None in virtual time and without a recording.
        """
        return None if self.summary is None else self.summary.exec_us

    @cached_property
    def steps(self) -> dict[str, StepMetrics]:
        """Medians and worst cases of overshoot, settling time and static error of the steps of each axis, by its name.

        {} after a trip, without a recording, and for a recording of more than MAX_STEP_ANALYSIS_TICKS; axes without
        steps are missing.
        """
        return {} if self.recording is None or self.summary is None else steps_of_run(self.summary, self.recording)

    @property
    def headline(self) -> str:
        """Outcome, ticks, trips and file of the run."""
        trips = f", {count_text(len(self.trips), 'trip')}" if self.trips else ""
        file = f" in {self.recordings[0]}" if self.recordings else ", nothing is recorded"
        return f"{self.outcome}, {count_text(self.ticks, 'tick')}{trips}{file}"

    def as_dict(self) -> dict[str, Any]:
        """Return the object of `rtloop run --json`: that of `rtloop info --json`, and the result of the run.

        After a signal before the loop began, it has outcome, recording (None) and recordings ([]) alone.
        """
        if self.supervised is None:
            return {"outcome": self.outcome, "recording": None, "recordings": []}
        report = {"trips": [], **(self.summary.as_dict() if self.summary else {"recording": None})} | {
            "recordings": [str(path) for path in self.recordings],
            "notes": list(self.notes),
            "outcome": self.outcome,
            "error": self.error,
            "recorder": self.supervised.recorder,
            "warnings": self.warnings,
            "startup_s": self.startup_s,
        }
        return to_jsonable(report)

    def print_text(self, out: Console) -> None:
        """Print the summary of the recording, and the steps beside the specification's limits."""
        print_run(out, self.prepared.configuration, self.summary, self.steps)

    def plot(self, start_s: float = 0.0, end_s: float = math.inf) -> Figure:
        """Return a picture of the recording between two times, both included, in s since the start.

        Raises LoopFault if nothing was recorded, RecordingError if no tick lies between the times, MissingExtra without
        matplotlib.
        """
        if self.recording is None:
            raise LoopFault(
                "plot: the run has no recording; the result's `outcome`, `error` and `notes` state the reason"
            )
        return draw_recording(self.recording, start_s, end_s)
