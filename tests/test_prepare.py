"""Faults that show only when the parts of a configuration are put together."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.configuration import checks
from rtloop.configuration import prepare as preparing
from rtloop.configuration.cautions import cautions, option_cautions
from rtloop.drivers.errors import MissingLibrary
from rtloop.drivers.sim import SimDriver
from rtloop.supervision.recording_path import new_recording_path
from tests.paper_configuration import CONTROLLER, TEXT, UNSTABLE, built, faults

PAPER = Path(__file__).resolve().parents[1] / "deploy" / "paper.toml"


def test_mistakes_between_the_parts_are_reported_at_once():
    all_faults = faults(
        ("drive_v = 10.0 ", "drive_v = 12.0 "), ("dwell_s = 0.2", "dwell_s = 1e-9"), UNSTABLE, duration_s=1e-9
    )
    assert [fault.split(":")[0] for fault in all_faults] == [
        "axis.x.controller",
        "axis.x.limits.drive_v",
        "axis.x.reference.dwell_s",
        "--duration",
    ]


def test_an_allowed_unstable_loop_is_a_warning():
    prepared = built((UNSTABLE[0], "gain = 0.16\nallow_unstable = true"))
    assert len([warning for warning in prepared.warnings if "the loop is unstable" in warning]) == 1


def test_plain_tustin_is_a_caution_and_not_judged_at_a_start():
    prepared = built(("prewarp_hz = 595.5\n", "\n"))
    assert (prepared.warnings, option_cautions(prepared)) == ((), [])
    warnings = cautions(prepared)
    assert re.search(
        r"axis\.x\.controller: method 'tustin' at 10000 Hz moves the notch from 595\.5 Hz to 588\.7 Hz", warnings[0]
    )


def test_a_start_computes_no_margins(monkeypatch):
    monkeypatch.setattr(checks, "loop_margins", lambda _: pytest.fail("margins are judged by `check`"))
    assert option_cautions(built()) == []


def test_without_a_model_nothing_is_promised():
    model = TEXT[TEXT.index("[axis.model]") : TEXT.index("# delay_ticks")]
    assert built((model, "")).warnings == ("axis.x.model: missing; stability and margins are not checked",)


def test_an_anti_windup_too_slow_for_an_unstable_controller():
    """A pole at 3000 rad/s grows by 1.35 a tick: followed slowly, it would run away while limited."""
    unstable = 'form = "transfer_function"\nnumerator = [1.0]\ndenominator = [1.0, -3000.0]\ntracking_s = {}\n\n'
    model = TEXT[TEXT.index("[axis.model]") : TEXT.index("# delay_ticks")]
    for tracking_s, is_valid in (("0.01", False), ("0.0", True)):
        changes = [(CONTROLLER, f"[axis.controller]\n{unstable.format(tracking_s)}"), (model, "")]
        if is_valid:
            built(*changes)
        else:
            (fault,) = faults(*changes)
            assert re.fullmatch(
                r"axis\.x\.controller\.tracking_s: 0\.01 s makes the controller unstable .*; use a smaller value.*",
                fault,
            )


@pytest.mark.parametrize("duration_s", [0.0, 1e-9, -1.0, float("nan"), float("inf"), 1e30])
def test_durations_without_a_tick(duration_s):
    (fault,) = faults(duration_s=duration_s)
    allowed = "one period, 0.0001 s, to 9.0072e+11 s at 10000 Hz"
    assert fault == f"--duration: {duration_s:g} s; allowed: {allowed}"


def test_real_hardware_is_not_run_unpaced(monkeypatch):
    facts = SimDriver.facts.fget
    monkeypatch.setattr(SimDriver, "facts", property(lambda driver: replace(facts(driver), real=True)))
    assert faults(paced=False) == [
        "driver 'sim' moves real hardware and cannot run in virtual time; leave out --unpaced"
    ]


@pytest.mark.parametrize(
    ("slew", "is_valid"), [(1e-12, False), (1e-9, False), (1.999, False), (2.0, True), (1e6, True)]
)
def test_every_ramp_to_safe_ends_within_seconds(slew, is_valid):
    """The ramp begins at 10 V, the end of the channel, and may take 5 s."""
    change = ("trip_slew_v_per_s = 1000.0", f"trip_slew_v_per_s = {slew}")
    if is_valid:
        built(change)
    else:
        (fault,) = faults(change)
        assert fault.startswith(f"axis.x.limits.trip_slew_v_per_s: {slew:g} V/s; the ramp of 10 V from the end of ")
        assert fault.endswith(" s; allowed: at most 5 s, so at least 2 V/s")


def test_a_library_that_is_missing_is_no_fault_of_the_configuration(monkeypatch):
    """The exit code is 69, for a missing resource; 78 is for a wrong configuration."""

    def missing(kind: str) -> None:
        raise MissingLibrary(f"driver {kind!r}: libcard.so: cannot open shared object file")

    monkeypatch.setattr(preparing, "driver_class", missing)
    with pytest.raises(MissingLibrary, match=r"libcard\.so"):
        built()


def test_a_relative_folder_of_recordings_begins_at_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """All commands name it: check, run (by the recording's path) and the log of the service."""
    monkeypatch.chdir(tmp_path)
    folder = str(tmp_path / "recordings")
    printed = CliRunner().invoke(main, ["check", str(PAPER)])
    assert f"records into {folder}\n" in printed.stdout
    assert json.loads(CliRunner().invoke(main, ["check", str(PAPER), "--json"]).stdout)["recordings"] == folder
    assert str(new_recording_path(built(), None).parent) == folder
    assert new_recording_path(built(), Path("mine")).parent == Path("mine")
