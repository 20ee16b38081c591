"""Retuning: new taps for a measured resonance and gain are shown, and sent only by consent and if they are better.

The oracle is a simulation by scipy. The service is a stand-in; the measurement itself is tested in test_response.py.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal

from rtloop.cli.retune import retune_axis, swap_proposal
from rtloop.client.retuning import RetuneRequest
from rtloop.design.robust.shape import Subject
from rtloop.errors import ConfigError, LoopFault, NoDesign
from tests.stage_text import resonance, wired

HZ, DAMPING, PERIOD_S = 600.0, 0.02, 1e-4
LOW_GAIN = 0.95, 0.001
OMEGA = 2 * np.pi * HZ
TEXT = f"""
[loop]
rate_hz = 10000
[driver]
kind = "sim"
{wired("adc0", "dac0")}
[[axis]]
name = "x"
specification = "spec.toml"
[axis.feedforward]
thresholds_v = [0.0]
weights_um_per_v = [4.3]
[axis.controller]
form = "transfer_function"
numerator = [60.0]
denominator = [1.0, 0.0]
method = "tustin"
[axis.model]
{resonance(OMEGA, DAMPING)}"""
SPECIFICATION = """
[specification]
overshoot_percent = 1.0
[specification.command]
reference_um = 10.0
command_um = 43.0
[shape]
taps = 30
points_per_tick = 2
"""


class Service:
    """Stand-in service that runs TEXT with `taps`, and measures `hz` and, if given, `gain` (value, std)."""

    def __init__(
        self,
        folder: Path,
        hz: float | None,
        gain: tuple[float, float] | None = None,
        taps: dict[str, list[float]] | None = None,
    ) -> None:
        (folder / "spec.toml").write_text(SPECIFICATION)
        self._folder, self._hz, self._gain, self._taps = folder, hz, gain, taps
        self.tuned, self.gain_um = dict[str, Any](), 0.0

    def get(self, resource: str) -> Any:
        assert resource == "/configuration"
        values = tomllib.loads(TEXT)
        if self._taps is not None:
            values["axis"][0]["prefilter"] = self._taps
        return {"folder": str(self._folder), "values": values}

    def post(self, resource: str, body: dict[str, Any], _: float = 0.0) -> Any:
        if resource == "/response":
            assert body["resonance_only"]
            self.gain_um = body["gain_um"]
            mode = None if self._hz is None else {"hz": self._hz, "hz_std": 0.1}
            if self._gain is None:
                return {"resonance": mode, "gain": None}
            value, std = self._gain
            gain = {"value": value, "std": std, "from_um": 0.0, "to_um": self.gain_um}
            return {"resonance": mode, "gain": gain}
        assert (resource, body["axis"], body["section"]) == ("/tune", "x", "prefilter")
        self.tuned = body["values"]
        return {"tick": 1234}


REQUEST = RetuneRequest("x", within_percent=0.0)


def overshoot(hz: float, taps: dict[str, list[float]], gain: float = 1.0) -> float:
    """Return the overshoot (1 is 100 %) of a unit step with another resonance and gain, simulated with scipy."""
    omega = 2 * np.pi * hz
    plant = signal.tf2ss([gain * omega**2], [1.0, 2 * DAMPING * omega, omega**2])
    a, b, c, _, _ = signal.cont2discrete(plant, PERIOD_S, "zoh")
    step = np.ones(400)
    reference_um, command_um = (signal.lfilter(taps[name], 1.0, step) for name in ("taps", "command_taps"))
    x, integral, previous_error, position = np.zeros((2, 1)), 0.0, 0.0, np.zeros(step.size)
    for k in range(step.size):
        position[k] = (c @ x).item()
        error = reference_um[k] - position[k]
        integral, previous_error = integral + 30.0 * PERIOD_S * (error + previous_error), error
        x = a @ x + b * (integral + command_um[k])
    return float(position.max() - 1)


def test_the_taps_that_are_sent_fit_the_measured_resonance(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    service = Service(tmp_path, 1.06 * HZ)
    assert retune_axis(service, REQUEST, yes=True, as_json=False) == 0  # type: ignore[arg-type]
    output = capsys.readouterr().out
    assert "+6.00 % from the model's" in output
    assert "swapped at tick 1234" in output
    assert overshoot(1.06 * HZ, service.tuned) < 0.011
    assert overshoot(HZ, service.tuned) > 0.02


@pytest.fixture(scope="module")
def retuned(tmp_path_factory: pytest.TempPathFactory) -> Service:
    """Return a service whose gain is 5 % below its model's, after a retuning."""
    service = Service(tmp_path_factory.mktemp("gain"), HZ, LOW_GAIN)
    assert retune_axis(service, REQUEST, yes=True, as_json=True) == 0  # type: ignore[arg-type]
    return service


def test_the_taps_that_are_sent_fit_the_measured_gain(retuned: Service):
    assert retuned.gain_um == pytest.approx(2.5, rel=0.01)  # a quarter of the specification's largest step
    assert overshoot(HZ, retuned.tuned, LOW_GAIN[0]) < 0.011
    assert overshoot(HZ, retuned.tuned) > 0.02


def test_taps_that_are_no_better_are_not_sent_whatever_the_consent(
    retuned: Service, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    service = Service(tmp_path, HZ, LOW_GAIN, retuned.tuned)
    assert retune_axis(service, REQUEST, yes=True, as_json=False) == 1  # type: ignore[arg-type]
    text = capsys.readouterr().out
    assert "static gain of the plant 0.9500 ± 0.0010 (standard deviation) between 0 and 2.5" in text
    assert "-5.00 % from the model's" in text
    assert "the new taps are no better; the loop keeps the present taps" in text
    assert not service.tuned


@pytest.mark.parametrize(("std", "gain"), [(0.009, 0.95), (0.02, 1.0)])
def test_a_gain_that_is_too_uncertain_is_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, std: float, gain: float
):
    design_gains = list[float]()

    def refuse_design(subject: Subject, **_: Any) -> None:
        design_gains.append(subject.plant.dc_gain)
        raise NoDesign("none")

    monkeypatch.setattr("rtloop.client.retuning.design_taps", refuse_design)
    with pytest.raises(NoDesign):
        retune_axis(Service(tmp_path, HZ, (0.95, std)), REQUEST, yes=True, as_json=False)  # type: ignore[arg-type]
    assert design_gains == [pytest.approx(gain)]


def test_a_gain_too_far_from_the_model_s_changes_nothing(tmp_path: Path):
    service = Service(tmp_path, HZ, (0.8, 0.001))
    with pytest.raises(LoopFault, match=r"gain is 0.8000, -20.00 % .*allowed: within ±15 %"):
        retune_axis(service, REQUEST, yes=True, as_json=False)  # type: ignore[arg-type]
    assert not service.tuned


def test_without_consent_nothing_is_sent(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    service = Service(tmp_path, 0.95 * HZ)
    assert retune_axis(service, REQUEST, yes=False, as_json=True) == 1  # type: ignore[arg-type]
    report = json.loads(capsys.readouterr().out)
    assert report["percent_from_model"] == pytest.approx(-5.0)
    assert report["tick"] is None
    assert report["after"]["overshoot"] <= 0.011
    assert report["after"]["settling_ms"] < 3.2 < report["before"]["settling_ms"]
    assert not service.tuned


@pytest.mark.parametrize(
    ("hz", "message"),
    [(None, "no lightly damped mode stands out"), (1.2 * HZ, r"720.00 Hz, \+20.00 % .*allowed: within ±15 %")],
)
def test_a_resonance_that_is_not_there_or_too_far_changes_nothing(tmp_path: Path, hz: float | None, message: str):
    service = Service(tmp_path, hz)
    with pytest.raises(LoopFault, match=message):
        retune_axis(service, REQUEST, yes=True, as_json=False)  # type: ignore[arg-type]
    assert not service.tuned


def test_a_proposal_is_swapped_in_by_consent_while_its_old_taps_are_in_force(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    service = Service(tmp_path, 1.06 * HZ)
    retune_axis(service, REQUEST, yes=False, as_json=True)  # type: ignore[arg-type]
    proposal = json.loads(capsys.readouterr().out)
    assert swap_proposal(service, "x", json.dumps(proposal), as_json=True) == 0  # type: ignore[arg-type]
    assert json.loads(capsys.readouterr().out) == {"tick": 1234}
    np.testing.assert_allclose(service.tuned["command_taps"], proposal["prefilter"]["command_taps"], rtol=1e-12)
    assert overshoot(1.06 * HZ, service.tuned) < 0.011

    stale = proposal | {"replaces": proposal["prefilter"]}
    for axis, text, error, message in (
        ("x", json.dumps(stale), LoopFault, "changed since the proposal"),
        ("z", json.dumps(proposal), ConfigError, "axis: 'z' is unknown; allowed: "),
        ("x", "{}", ConfigError, "proposal: not a proposal; allowed: the output of"),
        (
            "x",
            json.dumps(proposal | {"prefilter": {"taps": [1.0], "command_taps": [[0.0]]}}),
            ConfigError,
            "proposal: not a proposal",
        ),
    ):
        service.tuned = {}
        with pytest.raises(error, match=message):
            swap_proposal(service, axis, text, as_json=True)  # type: ignore[arg-type]
        assert not service.tuned
