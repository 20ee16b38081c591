"""Controllers of several axes: the shipped one against scipy and the rig, user laws, and refused configurations."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import signal

import rtloop
from rtloop.analysis.coupled_loop import CoupledLoop
from rtloop.cli import main
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.engine.commands import send
from rtloop.engine.loop import Outcome
from rtloop.engine.messages import Kind, message
from rtloop.errors import ConfigError
from rtloop.laws.conformance import Bench
from rtloop.laws.linearise import linearise_at_rest
from rtloop.recording.capture.session import Session
from rtloop.recording.file.topics.events import law_label
from rtloop.recording.replay.laws import TrustedLaws
from rtloop.recording.replay.replay import replay
from rtloop.service.changing import live
from rtloop.signals import Mode
from tests.engine.harness import LoopBench, prepare_text
from tests.kernel.harness import PERIOD_S
from tests.laws.changing import PAIR
from tests.laws.test_shipped import EXAMPLES, example, state_space
from tests.recording.real_loop import Options, RealLoop

EXAMPLE = EXAMPLES["coupled"].read_text()
CONTROLLER = EXAMPLE[EXAMPLE.index("[axis.controller]\n") : EXAMPLE.index("[axis.model]")]
LOOP = CONTROLLER[CONTROLLER.index("[[axis.controller.loops]]\n") :].split("[[axis.controller.loops]]\n")[1]
DECOUPLING = "decoupling = [[0.98232, -0.14735], [0.11788, 0.98232]]"
PID = '[axis.controller]\nkind = "pid"\nki_per_s = 1.0\n'
ONE_AXIS_CONTROLLER = "[axis.controller]\n" + LOOP
PAIR_OF_LAGS = """[axis.controller]
kind = "coupled"
axes = ["x", "y"]
a = [[-50.0, 0.0], [0.0, -50.0]]
b = [[1.0, 0.0], [0.0, 1.0]]
c = [[40.0, 10.0], [0.0, 40.0]]
d = [[0.0, 0.0], [0.0, 0.0]]
"""
THRESHOLDS, WEIGHTS = "thresholds_v = [0.0, 1.46, 4.01]", "weights_um_per_v = [3.0, 0.6, 0.9]"
INVERTIBLE = f'[driver.plant.hysteresis]\ntruth = "custom"\n{THRESHOLDS}\n{WEIGHTS}\n[driver.coupling]'
"""Hysteresis without a dead band, which the inverse compensates completely, so that the loop is linear."""
NOMINAL = '[driver.plant.hysteresis]\ntruth = "nominal"\n[driver.coupling]'


def set_references(text: str, x: str, y: str) -> str:
    """Return a configuration with other references of the two axes."""
    head, first, _ = text.split("[axis.reference]\n")
    return f"{head}[axis.reference]\n{x}\n[[axis]]{first.split('[[axis]]')[1]}[axis.reference]\n{y}\n"


def two_single_loops(text: str) -> str:
    """Return the configuration of two separate loops, whose models have no coupling."""
    single = (
        text.replace(CONTROLLER, ONE_AXIS_CONTROLLER)
        .replace("coupling = { y = 0.15 }\n", "")
        .replace("coupling = { x = -0.12 }\n", "")
    )
    head, second = single.split('name = "y"\n')
    return head + 'name = "y"\n' + second.replace("[axis.model]", ONE_AXIS_CONTROLLER + "[axis.model]")


def make_invertible(text: str) -> str:
    """Return a configuration whose rig has the hysteresis INVERTIBLE and whose feedforward has the same numbers."""
    text = re.sub(r"thresholds_v = \[[^\]]*\]", THRESHOLDS, text)
    text = re.sub(r"weights_um_per_v = \[[^\]]*\]", WEIGHTS, text)
    return text.replace("[driver.coupling]", INVERTIBLE)


def step_to(level_um: float, rest_ticks: int) -> str:
    """Return a reference that steps from 0 to a level, after `rest_ticks` ticks, and stays there."""
    dwell_s = rest_ticks * PERIOD_S
    return f'kind = "steps"\nlevels = [0.0, {level_um}]\ndwell_s = {dwell_s}\nrepeat = false'


def run(text: str, ticks: int, folder: Path = Path()) -> tuple[LoopBench, np.ndarray]:
    """Run a configuration; return its bench and its records (ticks, columns)."""
    bench = LoopBench(prepare_text(text, folder).plan)
    rows = bench.run(ticks)
    assert bench.outcome is Outcome.DONE
    return bench, rows


def test_it_computes_what_its_matrices_say():
    """Its unlimited commands and its linear part agree with scipy's simulation of C(z)."""
    for law in (example(EXAMPLES["coupled"]), state_space()):
        bench, linear = Bench(law), law.linear()
        random, axes = np.random.default_rng(1), law.count
        errors_um = random.normal(size=(300, axes))
        control, commands_um = bench._control[0], []
        for error_um in errors_um:
            control.error_um = error_um
            commands_um.append(bench._commands(control))
            control.applied_um = control.command_um
            bench._call("update", control)
        _, expected, _ = signal.dlsim((*linear.system, PERIOD_S), errors_um)
        np.testing.assert_allclose(commands_um, expected, rtol=1e-9, atol=1e-9)
        z = np.exp(2j * np.pi * np.geomspace(1.0, 4900.0, 50) * PERIOD_S)
        np.testing.assert_allclose(
            linearise_at_rest(law).system.response(z), linear.system.response(z), rtol=1e-5, atol=1e-9
        )


def test_without_decoupling_it_is_its_loops_one_beside_the_other():
    single_loop = prepare_text(two_single_loops(EXAMPLE)).checks[0].discrete
    law = prepare_text(EXAMPLE.replace("decoupling =", "# decoupling =")).checks[0].law
    z = np.exp(2j * np.pi * np.geomspace(1.0, 4900.0, 50) * PERIOD_S)
    response = law.linear().system.response(z)
    for i in range(2):
        np.testing.assert_allclose(response[:, i, i], single_loop.system.response(z), rtol=1e-12)
    assert np.all(response[:, 0, 1] == 0)
    assert np.all(response[:, 1, 0] == 0)


def test_a_limited_command_does_not_wind_it_up():
    """The states follow a limited command at once: C x + D e equals the applied command."""
    for law in (example(EXAMPLES["coupled"]), state_space()):
        bench, (a, b, c, d) = Bench(law), law.linear().system
        bench.coefficients["share"] = 1.0
        random, control, axes = np.random.default_rng(2), bench._control[0], law.count
        for _ in range(50):
            control.error_um = random.normal(size=axes)
            bench._commands(control)
            applied_um = random.normal(size=axes)
            control.applied_um = applied_um
            x = bench.state["x"][0, : a.shape[0]] + bench.coefficients["tracking"][0, : a.shape[0], :axes] @ (
                applied_um - control.command_um
            )
            np.testing.assert_allclose(c @ x + d @ control.error_um, applied_um, atol=1e-7)
            bench._call("update", control)
            np.testing.assert_allclose(bench.state["x"][0, : a.shape[0]], a @ x + b @ control.error_um, atol=1e-9)


def test_what_it_remembers_does_not_matter_to_an_entry():
    """An entry from a state of zeros and an entry in the middle of a run give the same state and commands."""
    for law in (example(EXAMPLES["coupled"]), state_space()):
        bench, axes = Bench(law, compiled=False), law.count
        entry_um = np.array([[3.0, -1.0, 2.0], [0.5, 4.0, -2.0], [7.0, 8.0, -9.0]])[:, :axes]
        first = bench.enter(*entry_um)
        state = bench.state["x"].copy()
        list(bench.run(20))
        control = bench._control[0]
        control.position_um, control.error_um, control.command_um = entry_um
        control.applied_um = control.command_um
        bench._call("enter", control)
        assert np.array_equal(bench.state["x"], state)
        assert bench._commands(control) == first


def test_entered_beside_feeds_it_rests_with_its_own_part_of_the_commands():
    """Two lags without integrator, entered at commands of 10 and −6 µm with feeds of 4 and 3 µm, keep the commands."""
    lags = f"{PAIR_OF_LAGS}allow_unstable = true\n\n"
    text = EXAMPLE.replace(CONTROLLER, lags).replace("rate_hz = 10000", 'rate_hz = 10000\nmode = "feedforward"')
    text = text.replace("[axis.feedforward]", "[axis.limits]\nbump_s = 1e9\n\n[axis.feedforward]")
    bench, before = run(set_references(text, 'kind = "hold"\nvalue = 10.0', 'kind = "hold"\nvalue = -6.0'), 300)
    bench.assembly.generators["feed_um"] = 4.0, 3.0
    bench.send(Kind.SET_MODE, Mode.CLOSED_LOOP)
    after = bench.run(300)
    assert np.all(bench.column(after, "mode") == Mode.CLOSED_LOOP)
    for axis in "xy":
        moved_um = bench.column(after, f"{axis}_command_um") - bench.column(before, f"{axis}_command_um")[-1]
        assert np.abs(moved_um).max() < 0.3


def test_cross_talk_is_what_the_decoupling_takes_away():
    """A step of 20 µm in x moves y far less with the decoupling than with two single loops, on the plant of the model.

    The rest is the dead band of the first threshold, 0.095 V · 2.55 µm/V, which this inverse leaves in y.
    """
    text = set_references(EXAMPLE.replace("[driver.coupling]", NOMINAL), step_to(20.0, 500), 'kind = "hold"')
    cross_talk = {}
    for name, configuration in (("decoupled", text), ("single", two_single_loops(text))):
        bench, rows = run(configuration, 2500)
        assert abs(bench.column(rows, "x_true_position_um")[-1] - 20.0) < 0.1
        cross_talk[name] = np.max(np.abs(bench.column(rows, "y_true_position_um"))) / 20.0
    assert cross_talk["decoupled"] < 1.1 * 0.095 * 2.55 / 20.0, cross_talk
    assert cross_talk["single"] > 5 * cross_talk["decoupled"], cross_talk


def test_the_models_of_a_shared_controller_have_the_delays_of_their_loops() -> None:
    """The model of y states its delay; the model of x states none and gets the driver's."""
    before, _, model_of_y = EXAMPLE.rpartition("[axis.model]")
    text = f"{before}[axis.model]\ndelay_ticks = 2{model_of_y}".replace("seed = 1", "seed = 1\nlatency_ticks = 1")
    for check in prepare_text(text).checks:
        assert check.law is not None
        assert [model.delay_ticks for model in check.law.model] == [1, 2]


def test_the_loop_is_as_it_was_predicted(tmp_path):
    """The sensitivity that `check` computes agrees with the rig's, measured by sines in one reference at a time."""
    joint = prepare_text(EXAMPLE).checks[0].together
    assert joint is not None
    predicted = joint.margins
    hz = np.array([20.0, 95.0, 200.0, 400.0, 560.0, 575.0, 580.0, 600.0, 1000.0])
    times_s, settling_ticks = np.arange(8000) * PERIOD_S, 2000
    sines = np.cos(2 * np.pi * np.outer(hz, times_s) + np.pi * np.arange(hz.size)[:, None] ** 2 / hz.size)
    np.save(tmp_path / "sines.npy", 0.3 * sines.sum(axis=0))
    table, sensitivity = 'kind = "table"\nfile = "sines.npy"', np.zeros((hz.size, 2, 2), complex)
    turns = np.exp(-2j * np.pi * np.outer(hz, times_s))[:, settling_ticks:]
    for j, references in enumerate(((table, 'kind = "hold"'), ('kind = "hold"', table))):
        bench, rows = run(set_references(make_invertible(EXAMPLE), *references), times_s.size, tmp_path)
        reference = turns @ bench.column(rows, f"{'xy'[j]}_reference_um")[settling_ticks:]
        for i, axis in enumerate("xy"):
            sensitivity[:, i, j] = turns @ bench.column(rows, f"{axis}_error_um")[settling_ticks:] / reference
    expected = CoupledLoop(joint.linear, joint.plant).sensitivity(hz)
    np.testing.assert_allclose(sensitivity, expected, atol=0.01)
    assert predicted.max_sensitivity == pytest.approx(np.linalg.norm(sensitivity, 2, axis=(1, 2)).max(), rel=0.01)
    disk = 1 / np.linalg.norm(sensitivity - np.eye(2) / 2, 2, axis=(1, 2)).max()
    assert predicted.disk_margin == pytest.approx(disk, rel=0.01)


@pytest.mark.usefixtures("few_simulated_steps")
def test_it_is_verified_as_it_runs():
    """A step of the rig has the figures of `design verify`, which reports none for C(s), as the law has no C(s)."""
    result = CliRunner().invoke(main, ["design", "verify", str(EXAMPLES["coupled"]), "--json"])
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert [axis["name"] for axis in report["axes"]] == ["x", "y"]
    assert report["axes"][0]["together"] == prepare_text(EXAMPLE).checks[0].together.margins.as_dict()
    rows = {row["name"]: row for row in report["axes"][0]["rows"]}
    assert all(row["continuous"] is None for row in rows.values())
    bench, ticks = run(set_references(make_invertible(EXAMPLE), step_to(10.0, 500), 'kind = "hold"'), 1100)
    position_um = bench.column(ticks, "x_true_position_um")[500:]
    assert rows["peak_command"]["running"] == pytest.approx(bench.column(ticks, "x_command_um").max() / 10.0, rel=0.01)
    outside = np.flatnonzero(np.abs(position_um / position_um[-1] - 1) > 0.05)
    assert rows["settling_ms"]["running"] == pytest.approx((outside[-1] + 1) * 0.1, abs=0.15)


@pytest.mark.usefixtures("few_simulated_steps")
@pytest.mark.parametrize(
    ("command", "heading", "count"),
    [(("check",), "x and y together", 1), (("design", "verify"), "All axes of this controller together", 2)],
)
def test_the_margins_of_all_axes_together_are_printed(command: tuple[str, ...], heading: str, count: int):
    """`check` has one table of all axes, `design verify` repeats it in the section of each axis."""
    result = CliRunner().invoke(main, [*command, str(EXAMPLES["coupled"])])
    assert result.exit_code == 0, result.output
    margins = prepare_text(EXAMPLE).checks[0].together.margins
    words = " ".join(result.stdout.split())
    assert words.count(heading) == count
    assert words.count(f"largest σ(S) {margins.max_sensitivity:.3f} at {margins.max_sensitivity_hz:.1f} Hz") == count
    gain = (1 + margins.disk_margin / 2) / (1 - margins.disk_margin / 2)
    phase_deg = np.degrees(2 * np.arctan(margins.disk_margin / 2))
    assert f"disk margin, sensors {margins.disk_margin:.3f} at {margins.disk_margin_hz:.1f} Hz" in words
    assert f"gains × {1 / gain:.2f} … {gain:.2f}, phases ± {phase_deg:.1f}°" in words


@pytest.mark.usefixtures("few_simulated_steps")
def test_a_law_of_one_axis_is_verified_too():
    result = CliRunner().invoke(main, ["design", "verify", str(EXAMPLES["pid"])])
    assert result.exit_code == 0
    assert "as it runs C(z)" in result.stdout
    assert "continuous" not in result.stdout


MINE = PAIR.replace("class Pair", "class Mine")
MY_TABLE = '[axis.controller]\nfile = "mine.py"\naxes = ["x", "y"]\n\n'


def test_a_laboratory_writes_its_own(tmp_path):
    """The check of a user law has its linear part and finds it stable; in a run it reaches its references."""
    (tmp_path / "mine.py").write_text(MINE)
    text = set_references(
        EXAMPLE.replace(CONTROLLER, MY_TABLE), 'kind = "hold"\nvalue = 5.0', 'kind = "hold"\nvalue = -3.0'
    )
    prepared = prepare_text(text, tmp_path)
    assert prepared.checks[1].running.stable
    c = prepared.checks[0].together.linear.system.response(np.exp(2j * np.pi * 10.0 * PERIOD_S))[0]
    integral = 100.0 * PERIOD_S / (np.exp(2j * np.pi * 10.0 * PERIOD_S) - 1)
    np.testing.assert_allclose(c, integral * np.array([[1.0, -0.1], [-0.1, 1.0]]), rtol=1e-9)
    bench = LoopBench(prepared.plan)
    rows = bench.run(4000)
    assert abs(bench.column(rows, "x_position_um")[-500:].mean() - 5.0) < 0.05
    assert abs(bench.column(rows, "y_position_um")[-500:].mean() + 3.0) < 0.05


class RunningDesk:
    """Desk that runs the loop for 500 ticks at each submitted command."""

    def __init__(self, loop: RealLoop, session: Session) -> None:
        self.loop, self.session = loop, session

    def submit(self, kind: Kind, *, axis: int = -1, values: Sequence[float] = (), change: str | None = None) -> int:
        send(self.loop.block, message(kind, axis=axis, values=values))
        tick = self.loop.tick
        self.run(500)
        return tick

    def run(self, ticks: int) -> None:
        """Run `ticks` ticks and record them."""
        self.loop.run(ticks)
        self.session.drain()
        self.session.write_due()


def test_it_is_tuned_and_swapped_while_it_runs(tmp_path, monkeypatch):
    """A change may name either axis, keeps the tared offset of both and causes no jump; a replay is identical."""
    monkeypatch.setattr(live, "prepare_limited", lambda configuration: prepare(configuration, paced=False))
    (tmp_path / "mine.py").write_text(MINE)
    text = EXAMPLE.replace("rate_hz = 10000", 'rate_hz = 10000\nlaws = ["mine.py"]')
    loop = RealLoop(set_references(text, 'kind = "hold"\nvalue = 8.0', 'kind = "hold"\nvalue = -6.0'), tmp_path)
    session = Session(loop.block, tmp_path / "live.mcap", loop.header, Options(min_free_bytes=0))
    desk = RunningDesk(loop, session)
    desk.run(3000)
    law = live.LiveLaw(loop.prepared, loop.block, desk, {0: 0.002, 1: 0.001})  # type: ignore[arg-type]
    law.tune("y", "controller", {"tracking_s": 0.002})
    law.tune("y", "limits", {"command_um": 40.0})
    law.tune("x", "limits", {"command_um": 39.0})
    coupled = law.prepared.configuration.axes[0].controller.model_dump(exclude_unset=True)
    law.load_controller("y", {**coupled, "decoupling": [[1.0, 0.0], [0.0, 1.0]]})
    law.load_controller("x", {"file": "mine.py", "axes": ["x", "y"], "shared": 0.05})
    law.tune("y", "controller", {"ki_per_s": 120.0})
    law.load_controller("x", coupled)
    for controller, sentence in (
        ({"form": "zpk", "gain": 0.1, "poles": [[-1.0, 0.0]]}, "axes share controllers in another way"),
        (coupled | {"axes": ["x", "z"]}, "x, z"),
    ):
        with pytest.raises((live.Refusal, ConfigError), match=sentence):
            law.load_controller("x", controller)
    assert [axis.limits.command_um for axis in law.prepared.configuration.axes] == [39.0, 40.0]
    assert law.prepared.configuration.axes[1].controller is None
    loop.end()
    session.drain()
    session.finish("finished")
    recording = rtloop.load(tmp_path / "live.mcap")
    assert [event["axis"] for event in recording.events if event["kind"] == "load_law"] == ["x", "y", *["x"] * 5]
    assert not [event for event in recording.events if event["kind"] in ("tripped", "refused")]
    for axis, reference_um, offset_v in (("x", 8.0, 0.002), ("y", -6.0, 0.001)):
        position_v = recording[f"{axis}_position_um"][-1] / loop.prepared.configuration.channels[axis].um_per_v
        assert recording[f"{axis}_adc_v"][-1] - position_v == pytest.approx(offset_v, abs=1e-9)
        assert np.max(np.abs(np.diff(recording[f"{axis}_drive_v"][2000:]))) < 0.05
        assert abs(recording[f"{axis}_position_um"][-400:].mean() - reference_um) < 0.1
    report = replay(recording, trust=TrustedLaws(recorded=True))
    assert report.identical
    assert report.ticks == 3000 + 7 * 500


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("told.command_um[i] = told.error_um[5]", "raised an exception in output of the controller"),
        ("told.command_um[1 - i] = 1e300 * 1e300", "returned inf from output of the controller"),
        ("told.command_um[i] = 1.0 / told.error_um[i] if False else 1.0 / 0.0", "raised an exception in output"),
    ],
)
def test_a_mistake_trips_both_axes(tmp_path, line, sentence):
    (tmp_path / "mine.py").write_text(
        MINE.replace("            told.command_um[i] = s.integral_um[i] - c.shared * s.integral_um[1 - i]\n",
                     f"            {line}\n")
    )  # fmt: skip
    plan = prepare_text(EXAMPLE.replace(CONTROLLER, MY_TABLE + "allow_unstable = true\n"), tmp_path).plan
    bench = LoopBench(plan)
    rows = bench.run(300)
    (trip,) = bench.trips([law_label(law.kind, law.file) for law in plan.laws])
    assert sentence in trip["what"]["reason"]
    assert "law 'mine'" in trip["what"]["reason"]
    for axis in plan.axes:
        assert np.all(bench.column(rows, f"{axis}_drive_v") == 0.0)


def test_a_command_of_one_axis_that_is_no_number_lets_the_other_axis_ramp_in_the_same_tick(tmp_path):
    output = "            told.command_um[i] = s.integral_um[i] - c.shared * s.integral_um[1 - i]\n"
    mistake = "            if i == 1 and s.integral_um[0] > 3.0:\n                told.command_um[i] = 1e300 * 1e300\n"
    (tmp_path / "mine.py").write_text(MINE.replace(output, output + mistake))
    text = set_references(
        EXAMPLE.replace(CONTROLLER, MY_TABLE), 'kind = "hold"\nvalue = 9.0', 'kind = "hold"\nvalue = -3.0'
    )
    plan = prepare_text(text, tmp_path).plan
    bench = LoopBench(plan)
    rows = bench.run(4000)
    (trip,) = bench.trips([law_label(law.kind, law.file) for law in plan.laws])
    drive_v, tick = bench.column(rows, "x_drive_v"), trip["tick"]
    slew_v = float(plan.coefficients["trip_slew_v_per_tick"][0])
    assert drive_v[tick - 1] > 0.5
    np.testing.assert_allclose(drive_v[tick : tick + 3], drive_v[tick - 1] - slew_v * np.arange(1, 4), atol=1e-12)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (CONTROLLER, '[axis.controller]\nkind = "coupled"\naxes = ["x"]\nd = [[1]]\n', "1 axes; allowed for law"),
        ('axes = ["x", "y"]', 'axes = ["x"]', "2 loops for 1 axes; allowed: one loop for each axis"),
        ('axes = ["x", "y"]', 'axes = ["y", "x"]', "controller.axes: y, x; allowed: x, y, in the order of the file"),
        ('axes = ["x", "y"]', 'axes = ["x", "z"]', "controller.axes: x, z; allowed: x, y, in the order of the file"),
        (CONTROLLER, PID + 'axes = ["x", "y"]\n', "axes: 2 axes; allowed for law 'pid': 1"),
        ("coupling = { y = 0.15 }", "coupling = { z = 0.15 }", "unknown; allowed: the controller's other axes .y."),
        (DECOUPLING, "decoupling = [[1, 1], [1, 1]]", "depend on each"),
        (DECOUPLING, "decoupling = [[1, 1]]", "2 rows of 2 numbers"),
        (DECOUPLING, "decoupling = [[-1, 0], [0, -1]]", "unstable on the"),
        ('rate_hz = 10000', 'rate_hz = 10000\nlaws = ["nothing"]', "'nothing' is not a known law"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(before, after, message):
    with pytest.raises(ConfigError, match=message):
        prepare_text(EXAMPLE.replace(before, after, 1))


def test_an_axis_of_its_controller_has_none_of_its_own():
    text = EXAMPLE.replace('name = "y"\n', 'name = "y"\n' + PID)
    with pytest.raises(ConfigError, match="but axis y has a controller of its own"):
        prepare_text(text)


def test_the_example_loads_as_it_is():
    assert load(EXAMPLES["coupled"]).owners == (0, 0)
