"""`rtloop.run`, `check` and `replay` from Python: the figures, the commands' texts, errors, threads."""

from __future__ import annotations

import asyncio
import json
import math
import re
import signal
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rtloop
from rtloop.configuration.file import load as load_configuration
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.errors import ConfigError, MissingExtra, RtloopError
from rtloop.recording.load import Recording
from rtloop.recording.views.steps import StepMetrics
from rtloop.recording.views.summary import summarise
from rtloop.supervision.supervisor import RunResult as SupervisedRun
from rtloop.workbench.run_result import RunResult
from rtloop.workbench.step_figures import specification_rows
from tests.recording.real_loop import changed_configuration, record
from tests.recording.tamper import rewrite
from tests.workbench.conftest import DURATION_S, PAPER

TICKS = round(10_000 * DURATION_S)


def lines(text: str) -> list[str]:
    """Return the lines of a text without white space at their ends."""
    return [line.rstrip() for line in text.rstrip().splitlines()]


def test_a_run_returns_its_figures(paper_run: RunResult):
    assert (paper_run.outcome, paper_run.exit_code, paper_run.error) == ("done", 0, None)
    assert (paper_run.ticks, paper_run.trips, paper_run.lateness_us) == (TICKS, [], None)
    assert isinstance(paper_run.recording, Recording)
    assert paper_run.recording["tick"].tolist() == list(range(TICKS))
    assert repr(paper_run) == f"<RunResult: done, 7,000 ticks in {paper_run.recordings[0]}>"
    assert 0 < paper_run.startup_s < 60


def test_the_steps_of_a_run_have_the_figures_of_their_definition(paper_run: RunResult):
    """The test evaluates each step of the reference by a loop over its ticks, but for the last, which is cut off."""
    reference_um, position_um = (paper_run.recording[f"x_{name}_um"] for name in ("reference", "position"))
    *starts, end_of_whole_steps = [k for k in range(1, TICKS) if reference_um[k] != reference_um[k - 1]]
    assert TICKS - end_of_whole_steps < end_of_whole_steps - starts[-1]
    overshoots, settlings, errors = [], [], []
    for start, end in zip(starts, [*starts[1:], end_of_whole_steps], strict=True):
        height_um, x_um = reference_um[start] - reference_um[start - 1], position_um[start:end]
        final_um = sum(x_um[-(len(x_um) // 5) :]) / (len(x_um) // 5)
        outside = [k for k, x in enumerate(x_um) if abs(x - final_um) > 0.05 * abs(height_um)]
        settlings.append(0.1 * (outside[-1] + 1))
        overshoots.append(max(100 * (x - final_um) / height_um for x in x_um))
        errors.append(100 * abs((final_um - reference_um[start]) / height_um))
    steps = paper_run.steps["x"]
    assert steps.steps == len(starts) > 1
    assert steps.settling_time_ms_worst == pytest.approx(max(settlings))
    assert steps.overshoot_percent_worst == pytest.approx(max(overshoots))
    assert steps.static_error_percent == pytest.approx(np.median(errors))


def test_a_run_prints_and_returns_what_the_commands_do(paper_run: RunResult, command):
    file = paper_run.recordings[0]
    report, summary = paper_run.as_dict(), json.loads(command("info", file, "--json").stdout)
    assert {key: report[key] for key in summary} == summary
    assert set(report) - set(summary) == {
        "recordings", "notes", "outcome", "error", "recorder", "warnings", "startup_s",
    }  # fmt: skip
    *summary_text, _, worst, median = lines(command("info", file).stdout)
    text = lines(str(paper_run))
    assert text[: len(summary_text)] == summary_text
    steps = text[len(summary_text) + 1 : len(summary_text) + 3]
    assert [re.split(r"\s{2,}", line) for line in steps] == [re.split(r"\s{2,}", line) for line in (worst, median)]
    assert worst.startswith("x: worst of ")
    (row,) = (line for line in text if "paper-spec.toml asks" in line)
    assert re.split(r"\s{2,}", row.strip()) == ["paper-spec.toml asks", "≤ 0, MISSED", "≤ 3, MISSED", "≤ 0.1, MISSED"]
    assert any(line.startswith("MISSED: the worst recorded step") for line in text)


@pytest.mark.parametrize(
    ("worst_figures", "cells"),
    [
        ((1.0, 6.0, 0.2), ["≤ 1", "≤ 6", "≤ 0.2"]),
        ((1.0, 6.1, 0.265), ["≤ 1", "≤ 6, MISSED", "≤ 0.2, MISSED"]),
        ((math.nan, math.inf, 0.1), ["≤ 1, MISSED", "≤ 6, MISSED", "≤ 0.2"]),
    ],
)
def test_limits_that_the_worst_step_does_not_meet_are_marked(worst_figures, cells, tmp_path: Path):
    limits = "[specification]\novershoot_percent = 1.0\nsettling_ms = 6.0\nstatic_error_percent = 0.2\n"
    (tmp_path / "spec.toml").write_text(limits, encoding="utf-8")
    configuration = replace(load_configuration(PAPER), folder=tmp_path)
    axis = configuration.axes[0].model_copy(update={"specification": "spec.toml"})
    pairs = [value for value in worst_figures for _ in range(2)]
    (row,) = specification_rows(configuration, axis, StepMetrics(4, 0, *pairs))
    assert (row.label, row.cells) == ("spec.toml asks", cells)


def test_a_part_of_a_recording_has_the_ticks_and_events_of_its_time(paper_run: RunResult):
    recording = paper_run.recording
    part = recording[0.2:0.4]
    assert part.time_s[[0, -1]].tolist() == [0.2, 0.4]
    assert part["x_drive_v"].tobytes() == recording["x_drive_v"][2000:4001].tobytes()
    assert (len(part), [*part], part.keys()) == (2001, [*recording.columns], recording.columns)
    assert (recording.is_part, part.is_part, "x_drive_v" in part) == (False, True, True)
    assert (len(recording[:0.1]), len(recording[0.6:]), len(recording[:])) == (1001, 1000, TICKS)
    assert len(part[0.1:0.3]) == 1001
    assert len(part[0.5:0.6]) == 0
    assert [event["kind"] for event in recording[0.6:].events] == ["stop", "finished"]
    assert part.events == []
    assert next(part.blocks(["tick"]))[0, 0] == 2000
    assert dict(part)["tick"][-1] == 4000
    assert len(part.to_pandas(["x_position_um"], start_s=0.3)) == 1001
    assert repr(part).endswith(", 0.2 s to 0.4 s>")


def test_a_replay_is_identical_and_prints_what_the_command_does(paper_run: RunResult, command):
    file = paper_run.recordings[0]
    result = rtloop.replay(paper_run.recording)
    assert (result.identical, result.ticks, result.first_difference, result.gaps) == (True, TICKS, None, [])
    assert result.as_dict() == json.loads(command("replay", file, "--jobs", "1", "--json").stdout)
    assert lines(str(result)) == lines(command("replay", file, "--jobs", "1").stdout)


def test_a_changed_output_is_the_first_difference(paper_run: RunResult, tmp_path: Path, command):
    def change(rows: np.ndarray) -> None:
        rows[rows[:, 0] == 4321, paper_run.recording.columns.index("x_drive_v")] += 1e-9

    file = rewrite(paper_run.recordings[0], tmp_path / "run.mcap", rows=change)
    result = rtloop.replay(file)
    assert (result.identical, result.first_difference["tick"]) == (False, 4321)
    difference = result.first_difference
    assert difference["signal"] == "x_drive_v"
    assert difference["recorded"] - difference["replayed"] == pytest.approx(1e-9, rel=1e-3)
    assert repr(result).startswith("<ReplayResult: different at tick 4321 in x_drive_v, ")
    assert lines(str(result)) == lines(command("replay", file, "--jobs", "1", code=1).stdout)
    limits_s = result.plot().axes[0].get_xlim()
    assert limits_s == pytest.approx((0.3821, 0.4821), abs=1e-3)


def test_another_law_is_compared_on_the_recorded_inputs(paper_run: RunResult, command):
    file = paper_run.recordings[0]
    result = rtloop.replay(file, config=PAPER)
    assert (result.ticks, result.trip) == (TICKS, None)
    assert {signal["max"] for signal in result.signals.values()} == {0.0}
    assert result.as_dict() == json.loads(command("replay", file, "--config", PAPER, "--json").stdout)
    resimulation = rtloop.replay(file, resimulate=True)
    error_um = paper_run.recording["x_position_um"] - paper_run.recording["x_reference_um"]
    recorded = resimulation.axes["x"]["recorded"]
    assert recorded["rms_error_um"] == pytest.approx(math.sqrt(np.mean(error_um**2)), rel=1e-9)
    assert resimulation.axes["x"]["resimulated"] == recorded
    assert "resimulated" in str(resimulation)


def test_a_check_judges_each_axis_as_the_command_does(command):
    result = rtloop.check(load_configuration(PAPER))
    axis = result.axes["x"]
    assert axis.meets_specification is False
    assert axis.shifts["running"].up < 2.5
    assert result.as_dict() == json.loads(command("check", PAPER, "--json").stdout)
    assert "resonance may move by" in str(result)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rtloop.run(PAPER, duration_s=-1), "run: duration_s: value is -1; allowed: a finite number of seconds"),
        (lambda: rtloop.run(PAPER, duration_s=math.nan), r"run: duration_s: value is nan"),
        (lambda: rtloop.run(PAPER, duration_s="2"), r"run: duration_s: value is '2'"),
        (lambda: rtloop.run(7), r"run: configuration: value is 7; allowed: the name of a file"),
        (lambda: rtloop.run(PAPER, folder=""), r"run: folder: value is ''"),
        (lambda: rtloop.check("absent.toml"), r"absent\.toml: No such file"),
        (lambda: rtloop.check("a\0b"), r"check: configuration: value is"),
        (lambda: rtloop.replay([]), r"replay: recording: value is \[\]"),
        (lambda: rtloop.replay(None), r"replay: recording: value is None"),
        (lambda: rtloop.replay(PAPER), r"not a recording"),
        (lambda: rtloop.replay("a.mcap", jobs=0), r"replay: jobs: value is 0; allowed: a whole number, from 1 on"),
        (lambda: rtloop.identify("a.mcap", "hysterics"), r"identify: kind: value is 'hysterics'; allowed: 'hyst"),
        (lambda: rtloop.identify("a.mcap", order=4), r"identify: option of kind 'hysteresis': value is 'order'"),
        (lambda: rtloop.identify("a.mcap", operators=65), r"identify: operators: value is 65; allowed: .* 1 to 64"),
        (lambda: rtloop.identify("a.mcap", weights="none"), r"identify: weights: value is 'none'; allowed"),
        (lambda: rtloop.identify("a.mcap", thresholds=["a"]), r"identify: thresholds: value is"),
        (lambda: rtloop.identify("a.mcap", thresholds="123"), r"identify: thresholds: value is '123'; allowed: a list"),
        (lambda: rtloop.identify([], "dynamics"), r"identify: recordings: value is \[\]"),
        (lambda: rtloop.identify("a.mcap", "dynamics", delay=17), r"identify: delay: value is 17; allowed"),
        (lambda: rtloop.identify("a.mcap", "dynamics", outside=3), r"identify: outside: value is 3"),
        (lambda: rtloop.design(PAPER), r"this file is a configuration"),
    ],
)
def test_a_mistake_is_an_error_with_value_and_remedy(call, message: str):
    with pytest.raises(RtloopError, match=message):
        call()


def test_a_part_of_a_recording_is_refused_where_the_whole_is_needed(paper_run: RunResult):
    part = paper_run.recording[0.1:0.2]
    for call in (rtloop.replay, rtloop.identify):
        with pytest.raises(RtloopError, match="allowed: a whole recording"):
            call(part)
    for key in (slice("a", None), slice(math.nan, 1.0), slice(0.0, 1.0, 2)):
        with pytest.raises(RtloopError, match="slice: "):
            paper_run.recording[key]


def test_a_tripped_run_is_a_result_and_no_exception(tmp_path: Path):
    """The result is of a loop that was recorded in this process; before its trip, it has made a whole step."""
    text = changed_configuration(
        ("position_um = 60.0", "position_um = 5.0"), ("levels = [20.0, 0.0, -20.0, 0.0]", "levels = [2.0, 0.0, 20.0]")
    )
    path, *_ = record(tmp_path / "run.mcap", text, 6_000)
    supervised = SupervisedRun([path], "done", {"complete": True}, [], None, 0)
    prepared = prepare(parse(text, "run", PAPER.parent, "run"))
    result = RunResult(prepared, supervised, summarise([path]), ["a"], None)
    assert (result.outcome, result.exit_code, result.trips[0].causes) == ("done", 1, ["position"])
    first = int(np.argmax(np.abs(result.recording["x_position_um"]) > 5.0))
    assert result.trips[0].tick == first
    assert (result.steps, result.as_dict()["warnings"]) == ({}, ["a"])
    assert f"tick {first}" in str(result)


def test_a_run_in_another_thread_touches_no_signal(tmp_path: Path):
    """A server or a notebook may run a loop in a thread: its event loop continues, and its handlers stay."""
    handlers = {name: signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM)}
    observed: list[dict] = []

    async def run_in_thread() -> RunResult:
        task = asyncio.create_task(asyncio.to_thread(rtloop.run, PAPER, duration_s=0.1, unpaced=True, folder=tmp_path))
        while not task.done():
            observed.append({name: signal.getsignal(name) for name in handlers})
            await asyncio.sleep(0.005)
        return task.result()

    result = asyncio.run(run_in_thread())
    assert (result.outcome, result.ticks) == ("done", 1000)
    assert len(observed) > 5
    interrupts = {entry[signal.SIGTERM] for entry in observed}
    assert interrupts == {handlers[signal.SIGTERM]}
    errors: list[RtloopError] = []

    def endless() -> None:
        try:
            rtloop.run(PAPER)
        except RtloopError as error:
            errors.append(error)

    thread = threading.Thread(target=endless)
    thread.start()
    thread.join()
    assert "duration_s: value is None; allowed outside the main thread" in str(errors[0])


def test_ctrl_c_in_the_main_thread_returns_a_stopped_run(tmp_path: Path):
    """The signal comes once the loop has its first ticks; the earlier handler is restored afterwards."""
    before = signal.getsignal(signal.SIGINT)

    def interrupt() -> None:
        while not any(file.stat().st_size > 100_000 for file in tmp_path.glob("*.part")):  # larger than the header
            threading.Event().wait(0.01)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    thread = threading.Thread(target=interrupt, daemon=True)
    thread.start()
    result = rtloop.run(PAPER, duration_s=60.0, folder=tmp_path)
    thread.join()
    assert (result.outcome, result.exit_code) == ("stopped", 0)
    assert 0 < result.ticks < 600_000
    assert result.lateness_us["p50"] <= result.lateness_us["max"]
    assert signal.getsignal(signal.SIGINT) is before


def test_pictures_need_matplotlib(paper_run: RunResult, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("matplotlib")
    figure = paper_run.plot(0.2, 0.3)
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert {round(line.get_xdata()[-1], 9) for line in figure.axes[0].lines[:2]} == {0.3}
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtra, match="pip install 'rtloop\\[plot\\]'"):
        paper_run.plot()


def test_the_room_of_design_is_the_function_too():
    import rtloop.design.synthesis.section

    assert rtloop.design.synthesis.section.controller_section
    with pytest.raises(ConfigError, match="this file is a configuration"):
        rtloop.design(PAPER)
