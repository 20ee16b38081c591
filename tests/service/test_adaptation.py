"""Scheduled retuning: when an axis is due, when it is not, and the journal's message about each result."""

from __future__ import annotations

import json
import logging
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rtloop.configuration.axis import AdaptOptions
from rtloop.service.measuring.adaptation import RetuneSchedule
from rtloop.service.service import State

TUNED = {
    "resonance": {"hz": 643.125}, "percent_from_model": 8.0, "gain": None, "better": True, "tick": 523005
}  # fmt: skip
GAIN = {"gain": {"value": 1.0204, "std": 0.0014}, "gain_percent_from_model": 2.04}


class ScheduleBench:
    """Retune schedule of a stand-in service: axis x adapts, axis y does not, axis z adapts every `z_s`, if at all. Each
    command prints `report` as JSON.
    """

    def __init__(self, code: int = 0, stderr: str = "", report: dict[str, Any] = TUNED, z_s: float = 0.0) -> None:
        adapts = AdaptOptions(every_s=60.0, bound_percent=7.0)
        axes = [SimpleNamespace(name="x", adapt=adapts), SimpleNamespace(name="y", adapt=None)]
        axes += [SimpleNamespace(name="z", adapt=AdaptOptions(every_s=z_s))] if z_s else []
        self.service: Any = SimpleNamespace(state=State.RUNNING, configuration=SimpleNamespace(axes=axes))
        self.commands: list[list[str]] = []
        self.result = subprocess.CompletedProcess([], code, json.dumps(report), stderr)
        self.schedule = RetuneSchedule(self.service, Path("/run/lab.sock"), self._run)

    def _run(self, command: Any) -> subprocess.CompletedProcess[str]:
        self.commands.append(list(command))
        return self.result

    def count_commands(self, *times_s: float) -> int:
        """Check the schedule at each of `times_s`, and return the number of commands run so far."""
        for time_s in times_s:
            self.schedule.retune_due_axes(time_s)
        return len(self.commands)


def test_it_is_due_after_the_loop_has_run_for_so_long():
    bench = ScheduleBench()
    assert bench.count_commands(1000.0, 1030.0, 1059.9) == 0
    assert bench.count_commands(1060.0, 1061.0, 1119.0) == 1
    assert bench.count_commands(1120.0) == 2
    command = " ".join(bench.commands[0])
    assert "ctl --socket /run/lab.sock retune x --yes --json" in command
    assert "--bound-percent 7.0" in command
    assert "--gain-um 0.0" in command


def test_each_axis_is_due_after_its_own_time():
    bench = ScheduleBench(z_s=90.0)
    assert [bench.count_commands(time_s) for time_s in (0.0, 60.0, 90.0, 120.0, 179.0, 180.0)] == [0, 1, 2, 3, 3, 5]
    axes = [command[command.index("retune") + 1] for command in bench.commands]
    assert axes == ["x", "z", "x", "x", "z"]


@pytest.mark.parametrize("state", [state for state in State if state is not State.RUNNING])
def test_never_while_it_does_not_run_and_a_trip_begins_the_waiting_anew(state: State):
    bench = ScheduleBench()
    assert bench.count_commands(0.0, 50.0) == 0
    bench.service.state = state
    assert bench.count_commands(60.0, 600.0) == 0
    bench.service.state = State.RUNNING
    assert bench.count_commands(601.0, 660.0) == 0
    assert bench.count_commands(661.0) == 1


def test_the_journal_has_what_was_done_and_what_was_refused(caplog: pytest.LogCaptureFixture):
    refusal = "reference of axis x: kind is sine; allowed: hold"
    with caplog.at_level(logging.INFO):
        ScheduleBench().count_commands(0.0, 60.0)
        ScheduleBench(report=TUNED | GAIN).count_commands(0.0, 60.0)
        ScheduleBench(1, report=TUNED | {"better": False, "tick": None}).count_commands(0.0, 60.0)
        ScheduleBench(1, f"rtloop: {refusal}\n", {"error": refusal, "exit_code": 1}).count_commands(0.0, 60.0)
    resonance = "resonance 643.12 Hz, +8.00 % from the model's"
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [
        ("INFO", f"axis x retuned: {resonance}; at tick 523005"),
        (
            "INFO",
            f"axis x retuned: {resonance}; gain 1.0204 ± 0.0014 (standard deviation), +2.04 % from the model's; "
            "at tick 523005",
        ),
        ("INFO", f"axis x keeps its taps: {resonance}; new taps would be no better"),
        ("WARNING", f"axis x is not retuned: {refusal}"),
    ]


def test_a_command_that_was_killed_while_it_printed_does_not_end_the_schedule(caplog: pytest.LogCaptureFixture):
    bench = ScheduleBench(-9)
    bench.result.stdout = bench.result.stdout[:20]
    assert bench.count_commands(0.0, 60.0, 120.0) == 2
    assert [record.getMessage().startswith("axis x is not retuned: ") for record in caplog.records] == [True, True]


def test_an_answer_of_another_version_does_not_end_the_schedule(caplog: pytest.LogCaptureFixture):
    bench = ScheduleBench(report={"better": True, "tick": 5})
    assert bench.count_commands(0.0, 60.0, 120.0) == 2
    expected = (
        "axis x: the result of `rtloop ctl retune` cannot be read (KeyError('resonance')), because another version of "
        "rtloop printed it; restart the service"
    )
    assert [record.getMessage() for record in caplog.records] == [expected] * 2
