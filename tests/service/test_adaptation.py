"""Retuning on a schedule: when it is due, when it is not, and what the journal says of it."""

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


class Desk:
    """A service with two axes, of which one adapts, and whoever runs commands for it."""

    def __init__(self, code: int = 0, stderr: str = "", answer: dict[str, Any] = TUNED) -> None:
        adapts = AdaptOptions(every_s=60.0, bound_percent=7.0)
        axes = [SimpleNamespace(name="x", adapt=adapts), SimpleNamespace(name="y", adapt=None)]
        self.service: Any = SimpleNamespace(state=State.RUNNING, configuration=SimpleNamespace(axes=axes))
        self.ran: list[list[str]] = []
        self.answer = subprocess.CompletedProcess([], code, json.dumps(answer), stderr)
        self.schedule = RetuneSchedule(self.service, Path("/run/lab.sock"), self._run)

    def _run(self, command: Any) -> subprocess.CompletedProcess[str]:
        self.ran.append(list(command))
        return self.answer

    def looks(self, *times_s: float) -> int:
        """How often it was retuned so far."""
        for time_s in times_s:
            self.schedule.retune_due_axes(time_s)
        return len(self.ran)


def test_it_is_due_after_the_loop_has_run_for_so_long():
    desk = Desk()
    assert desk.looks(1000.0, 1030.0, 1059.9) == 0
    assert desk.looks(1060.0, 1061.0, 1119.0) == 1
    assert desk.looks(1120.0) == 2
    said = " ".join(desk.ran[0])
    assert "ctl --socket /run/lab.sock retune x --yes --json" in said
    assert "--bound-percent 7.0" in said
    assert "--gain-um 0.0" in said


@pytest.mark.parametrize("state", [one for one in State if one is not State.RUNNING])
def test_never_while_it_does_not_run_and_a_trip_begins_the_waiting_anew(state: State):
    desk = Desk()
    assert desk.looks(0.0, 50.0) == 0
    desk.service.state = state
    assert desk.looks(60.0, 600.0) == 0
    desk.service.state = State.RUNNING
    assert desk.looks(601.0, 660.0) == 0
    assert desk.looks(661.0) == 1


def test_the_journal_has_what_was_done_and_what_was_refused(caplog: pytest.LogCaptureFixture):
    refusal = "reference of axis x: kind is sine; allowed: hold"
    with caplog.at_level(logging.INFO):
        Desk().looks(0.0, 60.0)
        Desk(answer=TUNED | GAIN).looks(0.0, 60.0)
        Desk(1, answer=TUNED | {"better": False, "tick": None}).looks(0.0, 60.0)
        Desk(1, f"rtloop: {refusal}\n", {"error": refusal, "exit_code": 1}).looks(0.0, 60.0)
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
    desk = Desk(-9)
    desk.answer.stdout = desk.answer.stdout[:20]
    assert desk.looks(0.0, 60.0, 120.0) == 2
    assert [record.getMessage().startswith("axis x is not retuned: ") for record in caplog.records] == [True, True]


def test_an_answer_of_another_version_does_not_end_the_schedule(caplog: pytest.LogCaptureFixture):
    desk = Desk(answer={"better": True, "tick": 5})
    assert desk.looks(0.0, 60.0, 120.0) == 2
    expected = (
        "axis x: the result of `rtloop ctl retune` cannot be read (KeyError('resonance')), because another version of "
        "rtloop printed it; restart the service"
    )
    assert [record.getMessage() for record in caplog.records] == [expected] * 2
