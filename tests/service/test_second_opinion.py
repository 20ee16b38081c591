"""python-control verifies the loop of a service, as an independent oracle, before the service is first armed."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import pytest

from rtloop.configuration.file import load, parse
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.errors import UnavailableError
from rtloop.service import second_opinion
from rtloop.service.desk import Refusal
from rtloop.service.second_opinion import SecondOpinion
from rtloop.service.service import Service, State

PAPER = Path(__file__).parents[2] / "deploy" / "paper.toml"


@pytest.fixture
def prepared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Prepared:
    """Return the paper's prepared loop; the cache of agreements is empty."""
    monkeypatch.setattr(second_opinion, "CACHE_FOLDER", tmp_path)
    return prepare(load(PAPER))


def increase_output_gain(prepared: Prepared) -> Prepared:
    """Return the same plan with a controller whose output gain is 1 % too high."""
    controller = prepared.checks[0].law
    assert controller is not None
    dtype = controller.records().coefficients
    coefficients = copy.deepcopy(prepared.plan.coefficients)
    record = coefficients["controller"][0][: dtype.itemsize].view(dtype)
    record["c"] *= 1.01
    return replace(prepared, plan=replace(prepared.plan, coefficients=coefficients))


def test_a_controller_that_runs_with_a_wrong_gain_cannot_be_armed(prepared: Prepared) -> None:
    opinion = SecondOpinion()
    opinion.compute(increase_output_gain(prepared))
    with pytest.raises(
        Refusal, match=r"arm: refused, because rtloop and python-control .* axis\.x: closed-loop poles: "
    ):
        opinion.require("arm")


def test_an_agreement_is_stored_and_a_disagreement_is_not(prepared: Prepared, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = [["axis.x: wrong"], [], ["never asked"]]
    monkeypatch.setattr(second_opinion, "_compare", lambda _: answers.pop(0))
    opinions = [SecondOpinion() for _ in range(3)]
    for opinion in opinions:
        opinion.compute(prepared)
    assert [opinion.faults for opinion in opinions] == [["axis.x: wrong"], [], []]
    another = SecondOpinion()
    another.compute(increase_output_gain(prepared))
    assert another.faults == ["never asked"]


@pytest.mark.parametrize(
    ("old", "new", "is_same"),
    [
        ("command_um = 42.0", "command_um = 41.0", True),
        ("position_um = 60.0", "position_um = 59.0", True),
        ("dwell_s = ", "dwell_s = 1", True),
        ("gain = 0.016", "gain = 0.0161", False),
        ("rate_hz = 10000", "rate_hz = 10001", False),
        ("# [axis.prefilter]", "[axis.prefilter]\ntaps = [0.5, 0.5]", False),
        ("[axis.model]", "[axis.model]\ndelay_ticks = 1", False),
    ],
)
def test_an_agreement_holds_for_another_reference_and_limits_alone(old: str, new: str, is_same: bool) -> None:
    text = PAPER.read_text()
    assert text.count(old) >= 1
    digests = [
        second_opinion._digest(prepare(parse(content, "paper", PAPER.parent, "paper.toml")))
        for content in (text, text.replace(old, new, 1))
    ]
    assert (digests[0] == digests[1]) == is_same


def test_arming_waits_for_the_opinion(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(second_opinion, "TIMEOUT_S", 0.01)
    refusal = r"arm: the check of the loop by python-control has not ended after 0\.01 s; try again"
    with pytest.raises(UnavailableError, match=refusal):
        SecondOpinion().require("arm")


def test_an_opinion_that_cannot_be_had_does_not_keep_the_loop_from_being_armed(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: Prepared) -> list[str]:
        raise UnavailableError("killed")

    monkeypatch.setattr(second_opinion, "_compare", refuse)
    opinion = SecondOpinion()
    opinion.compute(prepared)
    opinion.require("arm")


def test_a_disagreement_brings_the_outputs_to_safe_and_is_a_fault_of_the_service(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    service, modes = Service(PAPER), []
    monkeypatch.setattr(service, "set_mode", modes.append)
    monkeypatch.setattr(second_opinion, "_compare", lambda _: ["axis.x: wrong"])
    service._judge_loop(prepared)
    assert modes == ["off"]
    assert service.faults == ["axis.x: wrong"]
    assert service.state is State.TRIPPED
