"""Preview of a change and undo: figures, ticks and refusals. A preview leaves the running loop as it is."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.cli.ctl import print_preview
from rtloop.configuration.file import load, parse
from rtloop.configuration.prepare import prepare
from rtloop.service.changing.change_history import Change, ChangeHistory
from rtloop.service.changing.preview import lengthen_step, loop_figures, step_duration_ms
from tests.command_line import run
from tests.paper_configuration import PAPER, TEXT, built
from tests.virtual.bench import VirtualBench


def running_axis(bench: VirtualBench) -> dict:
    """Return the configuration of the first axis that is in force."""
    return bench.client.get("/configuration")["values"]["axis"][0]


def test_figures_are_those_of_check():
    """The oracle is the analysis of the paper's loop that `rtloop check` prints."""
    prepared = prepare(parse(TEXT, "paper", PAPER.parent, "paper.toml"))
    figures, running = loop_figures(prepared, 0), prepared.checks[0].running
    assert running is not None
    assert figures["phase_margin_deg"] == running.phase_margin_deg
    assert 10 ** (figures["gain_margin_db"] / 20) == pytest.approx(running.gain_margin)
    assert figures["modulus_margin"] == pytest.approx(1 / running.max_sensitivity)
    low, high = figures["tolerated_shift_percent"]
    assert low < 0 < high
    step = figures["step"]
    assert len(step["t_ms"]) == len(step["y"]) <= 400
    assert max(step["y"]) == pytest.approx((1 + running.overshoot_percent / 100) * step["y"][-1], rel=0.02)
    assert step["t_ms"][-1] >= 1e3 * running.settling_time_s


def test_a_preview_changes_nothing_and_takes_no_lock(virtual: VirtualBench):
    before = running_axis(virtual)
    body = {"axis": "x", "section": "controller", "values": {"gain": 0.008}}
    preview = virtual.client.post("/preview", body)
    assert preview["after"]["crossover_hz"] < 0.7 * preview["before"]["crossover_hz"]
    assert preview["after"]["gain_margin_db"] > preview["before"]["gain_margin_db"] + 3
    assert running_axis(virtual) == before
    virtual.client.delete("/lock")
    virtual.client.post("/preview", body)
    assert virtual.status()["lock"] is None
    # A preview is refused like the change itself.
    unstable = {"axis": "x", "section": "controller", "values": {"gain": 5.0}}
    for path in ("/preview", "/tune"):
        code, response = virtual.answer("POST", path, unstable)
        assert code == 422
        assert "unstable" in response["error"]
    assert virtual.answer("POST", "/preview", body | {"axis": "y"})[0] == 422
    assert virtual.answer("POST", "/preview", body | {"section": "driver"})[0] == 422
    assert running_axis(virtual) == before
    # After a change, a preview compares with the changed law.
    virtual.client.post("/tune", body)
    assert virtual.client.post("/preview", body)["before"]["crossover_hz"] == preview["after"]["crossover_hz"]
    virtual.client.post("/undo", {"axis": "x"})


def test_back_step_by_step(virtual: VirtualBench):
    before = running_axis(virtual)
    code, response = virtual.answer("POST", "/undo", {"axis": "x"})
    assert code == 409
    assert "has no change since" in response["error"]
    ticks = [
        virtual.client.post("/tune", {"axis": "x", "section": "controller", "values": {"gain": 0.012}})["tick"],
        virtual.client.post("/tune", {"axis": "x", "section": "limits", "values": {"command_um": 40.0}})["tick"],
    ]
    virtual.client.post("/setpoint", {"axis": "x", "value": 12.5})
    undone = [virtual.client.post("/undo", {"axis": "x"}) for _ in range(2)]
    assert [change["undone"] for change in undone] == ["limits: command_um", "controller: gain"]
    assert ticks[0] < ticks[1] < undone[0]["tick"] < undone[1]["tick"]
    assert running_axis(virtual)["controller"] == before["controller"]
    assert running_axis(virtual)["limits"] == before["limits"]
    assert virtual.status()["axes"]["x"]["reference_um"] == 12.5
    assert virtual.answer("POST", "/undo", {"axis": "x"})[0] == 409


def test_changes_to_and_fro_are_taken_back_in_their_order():
    axis = prepare(parse(TEXT, "paper", PAPER.parent, "paper.toml")).configuration.axes[0]
    changed_axis = axis.model_copy(update={"name": "other"})
    versions = (axis, changed_axis, axis, changed_axis, axis)
    history, changes = ChangeHistory(), [Change(0, "model", version, "to and fro") for version in versions]
    for change in changes:
        history.add(change)
    history.add(Change(1, "limits", axis, "of another axis"))
    undone = []
    while (change := history.newest(0, 0)[0]) is not None:
        undone.append(change.before.name)
        history.remove(change)
    assert undone == ["x", "other", "x", "other", "x"]
    assert history.newest(1, 1)[0] is not None
    history.remove()
    assert history.newest(1, 1) == (None, None)


def test_an_axis_undoes_its_own_changes_and_those_of_the_controller_that_it_shares():
    """Axis 1 uses the controller of axis 0; the limits of axis 0 stay until axis 0 itself undoes them."""
    axis = prepare(parse(TEXT, "paper", PAPER.parent, "paper.toml")).configuration.axes[0]
    history = ChangeHistory()
    for number, section in ((1, "limits"), (0, "controller"), (1, "model"), (0, "limits"), (2, "controller")):
        history.add(Change(number, section, axis, f"{section} of {number}"))

    def undo(number: int) -> str | None:
        change, blocker = history.newest(number, owner=0)
        if blocker is not None:
            return f"first {blocker.text}"
        if change is not None:
            history.remove(change)
        return change and change.text

    assert [undo(1), undo(1), undo(1)] == ["model of 1", "first limits of 0", "first limits of 0"]
    assert [undo(0), undo(1), undo(1), undo(1)] == ["limits of 0", "controller of 0", "limits of 1", None]
    assert undo(2) == "controller of 2"


def test_a_refused_change_is_none_to_undo(virtual: VirtualBench):
    assert virtual.answer("POST", "/tune", {"axis": "x", "section": "controller", "values": {"gain": 5.0}})[0] == 422
    assert virtual.answer("POST", "/undo", {"axis": "x"})[0] == 409
    assert virtual.answer("POST", "/undo", {"axis": "y"})[0] == 422


@pytest.mark.parametrize(
    ("gain", "problem"),
    [("1e-9", "the loop does not follow its reference"), ("-1e-5", "the loop's gain at 0 Hz has the wrong sign")],
)
def test_a_loop_that_does_not_control_is_a_problem_and_has_no_step_figures(gain: str, problem: str) -> None:
    figures = loop_figures(built(("gain = 0.016", f"gain = {gain}")), 0)
    assert any(line.startswith("axis.x.controller: ") and line.endswith(problem) for line in figures["problems"])
    assert (figures["settling_ms"], figures["overshoot_percent"], figures["step"]) == (None, None, None)
    assert figures["static_error_percent"] > 99.0


def test_a_loop_that_controls_has_no_problem() -> None:
    figures = loop_figures(built(), 0)
    assert figures["problems"] == []
    assert figures["static_error_percent"] == pytest.approx(0.166384, abs=1e-5)


def test_both_steps_of_a_preview_end_at_one_time(virtual: VirtualBench):
    """The shorter step is lengthened: the present one if the change makes the loop slower, else the new one."""
    for gain in (0.004, 0.02):
        body = {"axis": "x", "section": "controller", "values": {"gain": gain}}
        preview = virtual.client.post("/preview", body)
        before, after = preview["before"]["step"], preview["after"]["step"]
        assert before["t_ms"] == pytest.approx(after["t_ms"], abs=2e-6)
        slowest_ms = max(preview[key]["settling_ms"] for key in ("before", "after"))
        assert before["t_ms"][-1] == pytest.approx(3 * slowest_ms, rel=1e-6)


def test_a_longer_step_is_the_same_step():
    prepared = built()
    short = loop_figures(prepared, 0)
    longer = lengthen_step(short, prepared.checks[0], 2.5 * step_duration_ms(short))["step"]
    assert longer["t_ms"][-1] == pytest.approx(2.5 * step_duration_ms(short))
    interpolated = np.interp(short["step"]["t_ms"], longer["t_ms"], longer["y"])
    assert np.allclose(interpolated, short["step"]["y"], atol=0.02)
    assert lengthen_step(short, prepared.checks[0], 0.5) is short


def test_a_terminal_shows_both_loops_in_a_table_and_every_problem(capsys: pytest.CaptureFixture[str]) -> None:
    keys = ("crossover_hz", "phase_margin_deg", "gain_margin_db", "modulus_margin", "static_error_percent",
            "settling_ms", "overshoot_percent")  # fmt: skip
    before = {key: float(number) for number, key in enumerate(keys, start=1)}
    before |= {"tolerated_shift_percent": [-12.5, 50.0], "problems": []}
    after = dict.fromkeys(keys) | {"tolerated_shift_percent": None, "problems": ["axis.x.controller: wrong sign"]}
    print_preview("x", {"before": before, "after": after})
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["axis", "x,", "on", "the", "model", "now", "after", "the", "change"]
    assert [line.split()[-3:-1] for line in lines[6:8]] == [["6", "–"], ["7", "–"]]
    assert "-12.5 … +50.0" in lines[8]
    assert lines[9] == "problem: axis.x.controller: wrong sign"


def test_a_service_has_the_name_that_it_is_given() -> None:
    assert load(PAPER, "bench").name == "bench"
    result = run("serve", PAPER, "--name", "../bench")
    assert result.exit_code == 2
    assert "letters, digits" in result.stderr
