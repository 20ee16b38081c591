"""Warnings of `check`, each provoked by a change of a configuration that has none; and `--strict`."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from rich.console import Console

from rtloop.cli import main
from rtloop.configuration.cautions import cautions, option_cautions
from rtloop.configuration.file import load, parse
from rtloop.configuration.prepare import prepare
from rtloop.drivers.base import Channel
from rtloop.errors import ConfigError
from rtloop.service.service import Service
from rtloop.signals import trip_causes
from rtloop.workbench.axis_judgement import AxisJudgement
from rtloop.workbench.check_text import print_axis
from tests.command_line import answer, run
from tests.engine.harness import LoopBench, prepare_text
from tests.paper_configuration import PAPER, RATE, TEXT
from tests.stage_text import one_axis, wired
from tests.unequal_stage import HIGHEST_V, LOWEST_V, STAGE, Plays, curve

RAW = (RATE, f'{RATE}mode = "raw"\n')
LIMITS, INTERLOCKS = "command_um = 42.0", "[axis.interlocks]"
SCHEDULE = '\n[[schedule]]\nat_tick = 500\nreference = { kind = "hold", value = -43.0 }\n'

PROVOKED = [
    ((("gain = 0.016", "gain = 0.030"),), "controller: gain margin 1.37, below margins.gain = 1.5"),
    (((INTERLOCKS, f"[axis.margins]\nphase_deg = 80.0\n{INTERLOCKS}"),), "controller: phase margin 73.1°, below"),
    (((INTERLOCKS, f"[axis.margins]\nsensitivity = 1.2\n{INTERLOCKS}"),), "controller: max |S| 1.65, above"),
    (
        (("gain = 0.016", "gain = -1e-5"),),
        "controller: a step of 1 µm ends at -0.6 µm: the loop's gain at 0 Hz has the wrong",
    ),
    ((("gain = 0.016", "gain = 1e-9"),), "µm: the loop does not follow its reference"),
    (((LIMITS, "command_um = 19.0"),), "reference: reaches 20 µm, beyond limits.command_um = 19"),
    (((LIMITS, "command_um = 44.0"),), "limits.command_um: 44 µm never acts; the drive's limits allow only 43.02 µm"),
    (((LIMITS, f"{LIMITS}\ndrive_min_v = -2.0"), RAW), "reference: -20 V … 20 V, beyond the drive's limits"),
    (
        (("position_um = 60.0", "position_um = 120.0"),),
        "interlocks.position_um: 120 µm never trips; the sensor's range",
    ),
    (
        (("sensor_min_v = -9.99", "sensor_min_v = -1.9"), ("sensor_max_v = 9.99", "sensor_max_v = 1.9")),
        "reference: reaches 20 µm, beyond the end of the sensor's range, 19 µm; the loop would trip",
    ),
    ((("position_um = 60.0", "position_um = 15.0"),), "reference: reaches 20 µm, beyond interlocks.position_um = 15"),
    (
        ((LIMITS, f"{LIMITS}\ndrive_min_v = -2.0"),),
        "reference: -20 … 20 µm; the drive's limits, -2 V … 10 V, allow only -",
    ),
    (
        (("drive_v = 10.0", "drive_v = 8.0"), ("levels = [20.0, 0.0, -20.0, 0.0]", "levels = [0.0, 42.0]")),
        "reference: 0 … 42 µm; the drive's limits, -8 V … 8 V, allow only -32.33 … 32.33 µm",
    ),
    (((RATE, "rate_hz = 1000000\n"),), "loop.rate_hz: 1e+06 Hz; the highest rate that a measured machine kept"),
    (((RATE, f"{RATE}cpu = 9999\n"),), "loop.cpu: 9999; this machine has processors 0 to "),
    (
        (("um_per_v = 10.0", "um_per_v = -10.0"),),
        "but the simulated sensor has 10 µm/V; with the opposite sign the feedback is",
    ),
    (
        (("um_per_v = 10.0", "um_per_v = 20.0"),),
        "driver.channels.x.um_per_v: 20 µm/V, but the simulated sensor has 10 µm/V; measured positions are 2 times",
    ),
]


def changed(*changes: tuple[str, str]) -> str:
    text = TEXT
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


def warnings_of(text: str) -> list[str]:
    return cautions(prepare(parse(text, "paper", PAPER.parent, "paper.toml")))


def test_the_papers_configuration_gives_no_cause() -> None:
    assert warnings_of(TEXT) == []


@pytest.mark.parametrize(("changes", "message"), PROVOKED, ids=[message[:30] for _, message in PROVOKED])
def test_each_caution_is_one_line(changes: tuple[tuple[str, str], ...], message: str) -> None:
    lines = warnings_of(changed(*changes))
    assert any(line.startswith(("axis.x.", "driver.channels.x.", "loop.")) and message in line for line in lines), lines


def test_weights_whose_whole_stroke_is_noise_are_named() -> None:
    head = f'[loop]\nrate_hz = 10000\nmode = "off"\n[driver]\nkind = "sim"\n{wired("adc0", "dac0")}'
    (line,) = [line for line in warnings_of(head + one_axis(um_per_v=0.0009)) if "weights" in line]
    assert line.startswith(
        "axis.x.feedforward.weights_um_per_v: with these weights the drive's limits reach 0.009 µm, less than the "
    )
    assert line.endswith("noise of 0.01 µm; identify the weights of the hysteresis on this stage")


def test_a_reference_of_the_schedule_counts() -> None:
    (line,) = warnings_of(TEXT + SCHEDULE)
    assert line == "axis.x.reference from tick 500 on: reaches 43 µm, beyond limits.command_um = 42"


SERVICE = "\n[service]\n"
RECOVER = "[service.recover]\n"


@pytest.mark.parametrize(
    ("text", "warnings"),
    [
        (f"{SERVICE}tare_s = 1.0\n", []),
        (f"{SERVICE}arm = true\ntare_s = 1.0\n", ["service.depolarise, service.tare_s: no effect with service.arm"]),
        (f"{SERVICE}tare_s = 1.0\n{SCHEDULE.replace('-43', '-4')}", ["schedule: not allowed with service.tare_s or"]),
        (
            f"{RECOVER}{SCHEDULE.replace('-43', '-4')}",
            ["schedule: not allowed with service.recover, because a loop that"],
        ),
    ],
)
def test_check_warns_of_what_serve_refuses_or_leaves_out(tmp_path: Path, text: str, warnings: list[str]) -> None:
    config = tmp_path / "stage.toml"
    config.write_text(TEXT + text)
    service_lines = [line for line in cautions(prepare(load(config))) if "service" in line]
    assert [line[: len(start)] for line, start in zip(service_lines, warnings, strict=True)] == warnings
    if "schedule" in text:
        with pytest.raises(ConfigError, match=warnings[0]):
            Service(config)


def test_strict_makes_faults_of_them(tmp_path: Path) -> None:
    config = tmp_path / "stage.toml"
    config.write_text(changed((LIMITS, "command_um = 19.0")).replace('specification = "paper-spec.toml"', ""))
    loose = CliRunner().invoke(main, ["check", str(config), "--json"])
    assert loose.exit_code == 0
    assert any("command_um = 19" in line for line in json.loads(loose.stdout)["warnings"])
    strict = CliRunner().invoke(main, ["check", str(config), "--strict"])
    assert strict.exit_code == 78
    assert "command_um = 19" in strict.stderr


@pytest.mark.parametrize(("shift", "is_stable"), [(0.01, True), (0.03, False), (0.05, False)])
def test_a_rig_on_which_the_loop_is_unstable_is_named_by_check_and_run(
    shift: float, is_stable: bool, tmp_path: Path
) -> None:
    """At 10 kHz the paper's loop is stable with a resonance up to 1.82 % above the model's."""
    config, sensor = tmp_path / "stage.toml", "[driver.plant.sensor]"
    text = changed((sensor, f"[driver.plant.dynamics]\nresonance_shift = {shift}\n{sensor}"))
    config.write_text(text.replace('specification = "paper-spec.toml"', ""))
    message = "warning: axis.x: on the simulated rig, the loop is unstable (largest |pole| 1.0"
    checked = run("check", config)
    assert checked.exit_code == (0 if is_stable else 1)
    assert (message not in checked.stderr) == is_stable
    assert ("stable on the simulated rig" not in checked.stdout) == is_stable
    (axis,) = answer("check", config, code=0 if is_stable else 1)["axes"]
    assert axis["stable_on_rig"] == (None if is_stable else False)
    assert (run("check", config, "--strict").exit_code == 0) == is_stable
    if not is_stable:
        assert run("check", config, "--strict").exit_code == 78
        stepped = run("run", config, "--duration", 0.01, "--unpaced", "--out", tmp_path)
        assert message in stepped.stderr


def test_a_level_below_the_remanence_is_named() -> None:
    """The position that the plays keep at 0 V after 35 µm, by a search sample by sample."""
    plays = Plays()
    plays.drive_to(35.0)
    remanence_um = plays.move(0.0)

    def warnings(*levels_um: float) -> list[str]:
        reference = f'[axis.reference]\nkind = "steps"\nlevels = {list(levels_um)}\ndwell_s = 0.1\n'
        text = STAGE.replace(f"drive_min_v = {LOWEST_V}", "drive_min_v = 0.0").replace(
            "command_um = 60.0", "command_um = 39.0"
        )
        lines = cautions(prepare(parse(text + reference, "stage", Path(), "stage")))
        return [line for line in lines if line.startswith("axis.x.reference")]

    highest_um = curve([HIGHEST_V])[0]
    allowed = f"0 V … 10 V, allow only {remanence_um:.4g} … {highest_um:.4g} µm"
    because = " after a motion to 35 µm, because of the hysteresis"
    assert remanence_um > 2.0
    for levels in ((35.0, 0.0), (0.0, 35.0)):
        assert warnings(*levels) == [f"axis.x.reference: 0 … 35 µm; the drive's limits, {allowed}{because}"]
    assert warnings(35.0, -5.0) == [f"axis.x.reference: -5 … 35 µm; the drive's limits, {allowed}"]
    assert warnings(35.0, remanence_um - 0.1) != []
    assert warnings(35.0, remanence_um + 0.1) == []
    assert warnings(0.0) == []
    assert warnings(38.0) == []


def test_an_amplifier_of_one_side_is_shown_as_one(tmp_path: Path) -> None:
    config = tmp_path / "stage.toml"
    text = changed((LIMITS, f"{LIMITS}\ndrive_min_v = 0.0")).replace('specification = "paper-spec.toml"', "")
    config.write_text(text)
    result = CliRunner().invoke(main, ["check", str(config)])
    assert "drive 0 … 10 V, command 0 … 42 µm" in result.stdout
    assert "paper: 1 axis at 10000 Hz" not in result.stdout
    assert "stage: 1 axis at 10000 Hz" in result.stdout


def test_a_model_without_a_resonance_is_checked(tmp_path):
    """A first-order lag under an integrator: no resonance whose shift could be tolerated."""
    lag = '[axis.model]\nform = "zpk"\ngain = 1000.0\npoles = [[-1000.0, 0.0]]\n'
    config = tmp_path / "lag.toml"
    config.write_text(f'[loop]\nrate_hz = 10000\n[driver]\nkind = "sim"\n{wired("adc0", "dac0")}{one_axis(200.0)}{lag}')
    result = CliRunner().invoke(main, ["check", str(config)])
    assert result.exit_code == 0, result.output
    assert "max |S|" in result.output
    assert "resonance" not in result.output
    (axis,) = json.loads(CliRunner().invoke(main, ["check", str(config), "--json"]).stdout)["axes"]
    assert axis["resonance_shift_tolerated_percent"] == {}


def test_weights_far_beyond_the_sensor_are_not_judged_on_hardware(tmp_path: Path) -> None:
    """±10 V at 10 µm/V: the sensor ends at 100 µm; 10 V of the drive are 290 and 310 µm."""
    (tmp_path / "spec.toml").write_text("[specification]\novershoot_percent = 50.0\n")
    lag = '[axis.model]\nform = "zpk"\ngain = 1000.0\npoles = [[-1000.0, 0.0]]\n'
    bus = 'kind = "can"\nchannel = "vcan0"\nhold_ticks = 100\nwatchdog_ms = 5000.0\n'
    for um_per_v, sentence in (
        (29.0, "the loop meets its specification"),
        (31.0, "spec.toml: not judged: axis.x.feed"),
    ):
        axis = one_axis(10.0, um_per_v=um_per_v).replace('name = "x"\n', 'name = "x"\nspecification = "spec.toml"\n')
        config = tmp_path / "card.toml"
        config.write_text(f"[loop]\nrate_hz = 200\n[driver]\n{bus}{wired('adc0', 'dac0')}{axis}{lag}")
        result = CliRunner().invoke(main, ["check", str(config)])
        assert result.exit_code == (1 if um_per_v > 30.0 else 0), result.output
        assert sentence in result.stdout.replace("\n", " ")
        assert ("allowed: up to 299.7 µm" in result.stderr) == (um_per_v > 30.0)


@pytest.mark.parametrize(
    ("low_v", "high_v", "message"),
    [
        (-10.0, 10.0, " or outside -9.99 … 9.99 V at the sensor"),
        (0.0, 10.0, " or above 9.99 V at the sensor, whose input reads 0 … 10 V"),
        (-10.0, 5.0, " or below -9.99 V at the sensor, whose input reads -10 … 5 V"),
        (0.0, 5.0, ", but at no voltage of the sensor, whose input reads 0 … 5 V"),
    ],
)
def test_limits_that_the_input_cannot_read_are_not_shown(low_v: float, high_v: float, message: str) -> None:
    prepared = prepare(parse(TEXT, "paper", PAPER.parent, "paper.toml"))
    (axis,), (check,) = prepared.configuration.axes, prepared.checks
    out = Console(file=io.StringIO(), width=300)
    judgement = AxisJudgement(axis, replace(check, law=None, on_model=None), {}, None, None, None)
    print_axis(out, judgement, Channel("adc0", low_v, high_v))
    assert f"the loop trips beyond ±60 µm{message}\n" in out.file.getvalue()


@pytest.mark.parametrize(("duration_s", "is_named"), [(0.4, True), (0.5, True), (0.6, False), (None, False)])
def test_a_run_that_ends_before_its_first_step_says_so(duration_s: float | None, is_named: bool) -> None:
    steps = '[axis.reference]\nkind = "steps"\nlevels = [10.0, 0.0]\ndwell_s = 0.5\n'
    text = TEXT.partition("[axis.reference]")[0] + steps
    prepared = prepare(parse(text, "stage", Path(), "stage"), duration_s=duration_s, paced=False)
    lines = [line for line in option_cautions(prepared) if "first step" in line]
    expected = (
        f"axis.reference.dwell_s: the first step comes after 0.5 s, and this run ends after {duration_s} s: it has no "
        "step. Use --duration with at least 1"
    )
    assert lines == [expected] * is_named


STEPS = 'kind = "steps"\nlevels = [20.0, -20.0]\ndwell_s = 0.05\n'
TEN_STEPS = f"{STEPS}repeat = false\n".replace("[20.0, -20.0]", str([20.0, -20.0] * 5))
SINE = 'kind = "sine"\namplitude = 15.0\nfrequency_hz = 20.0\n'
REST = 'kind = "hold"\nvalue = 0.0\n[[schedule]]\nat_tick = 500\n'
LATER_SINE = 'reference = { kind = "sine", amplitude = 15.0, frequency_hz = 20.0 }\n'
LATER_HOLD = 'reference = { kind = "hold", value = 10.0 }\n'
OSCILLATION, TRACKING = ("swing_ticks", "oscillation"), ("tracking_error_um", "tracking")


@pytest.mark.parametrize(
    ("reference", "keys", "trip"),
    [
        (STEPS, {"swing_ticks": 600}, OSCILLATION),
        (STEPS, {"swing_ticks": 400}, None),
        (STEPS.replace("20.0", "1.0"), {"swing_ticks": 600}, None),
        (TEN_STEPS, {"swing_ticks": 600}, OSCILLATION),
        (TEN_STEPS.replace(", 20.0, -20.0]", "]"), {"swing_ticks": 600}, None),
        (SINE, {"swing_ticks": 260}, OSCILLATION),
        (SINE.replace("sine", "triangle"), {"swing_ticks": 260}, OSCILLATION),
        (SINE, {"swing_ticks": 240}, None),
        (SINE, {"tracking_error_um": 2.0, "tracking_ticks": 60}, TRACKING),
        (SINE, {"tracking_error_um": 2.0, "tracking_ticks": 260}, None),
        (STEPS, {"tracking_error_um": 2.0, "tracking_ticks": 40}, TRACKING),
        (STEPS, {"tracking_error_um": 2.0, "tracking_ticks": 400}, TRACKING),
        (STEPS, {"tracking_error_um": 2.0, "tracking_ticks": 499}, None),
        ('kind = "hold"\nvalue = 10.0\n', {"tracking_error_um": 2.0, "tracking_ticks": 300}, TRACKING),
        ('kind = "hold"\nvalue = 10.0\n', {"tracking_error_um": 2.0, "tracking_ticks": 400}, None),
        (f"{REST}{LATER_SINE}", {"swing_ticks": 260}, OSCILLATION),
        (f"{REST}{LATER_HOLD}", {"tracking_error_um": 2.0, "tracking_ticks": 300}, None),
    ],
)
def test_a_trip_that_is_certain_is_named_before_the_run(
    reference: str, keys: dict[str, float], trip: tuple[str, str] | None
) -> None:
    """The run trips where, and only where, there is a warning."""
    interlocks = {"oscillation_um": 4.0, "oscillation_swings": 8, "tracking_error_um": 60.0, "tracking_ticks": 500}
    lines = "".join(f"{key} = {value}\n" for key, value in {**interlocks, **keys}.items())
    text = TEXT.partition("[axis.interlocks]")[0] + f"{INTERLOCKS}\n{lines}[axis.reference]\n{reference}"
    prepared = prepare_text(text, PAPER.parent)
    warnings, bench = [line for line in option_cautions(prepared) if "would trip" in line], LoopBench(prepared.plan)
    flags = np.bitwise_or.reduce(bench.column(bench.run(6000), "flags").astype(int))
    assert [*trip_causes(flags)] == ([] if trip is None else [trip[1]])
    assert [f"interlocks.{trip[0]} = " in line for line in warnings] == [True] * (trip is not None)
