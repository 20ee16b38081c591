"""Depolarisation and tare on a rig with hysteresis; drives and recordings are the evidence."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import rtloop
from rtloop.configuration.service import DepolariseOptions
from rtloop.errors import RtloopError
from rtloop.service.preparation import decaying_sine
from rtloop.signals import ADC, POSITION, axis_column
from tests.faults.account import runs_in
from tests.faults.bench import Bench
from tests.faults.configuration import on_a_rig
from tests.virtual.bench import VirtualBench
from tests.virtual.service import VirtualService

THRESHOLDS_V = [0.095, 0.38, 0.84, 1.46, 2.21, 3.07, 4.01, 4.98, 5.96, 6.89, 7.76, 8.52, 9.14, 9.61, 9.9]
WEIGHTS_UM_PER_V = [2.55, 0.57, 1.3, -1.57, 1.25, -0.054, -0.032, 0.66, 0.16, -0.77, 2.02, -1.63, -0.15, 2.99, -1.09]


def displacement_um(volts: np.ndarray, plays: np.ndarray) -> float:
    """Return the displacement (µm) by eq. (4) of the paper after the drives `volts`; updates the states `plays`."""
    for value in volts:
        plays[:] = np.maximum(value - np.array(THRESHOLDS_V), np.minimum(value + np.array(THRESHOLDS_V), plays))
    return float(np.dot(WEIGHTS_UM_PER_V, plays))


def test_the_sweep_wipes_out_what_the_actuator_remembers():
    for history in ([10.0, 0.0], [-10.0, 0.0], [7.0, -3.0, 0.0]):
        plays = np.zeros(len(THRESHOLDS_V))
        before = displacement_um(np.array(history), plays)
        sweep = decaying_sine(DepolariseOptions(amplitude_v=10.0, frequency_hz=10.0, cycles=40), 10_000.0)
        after = displacement_um(np.append(sweep, 0.0), plays)
        assert abs(before) > 1.0
        assert abs(after) < 0.25
        assert np.max(np.abs(sweep)) <= 10.0


def test_the_sweep_begins_and_ends_at_rest():
    sweep = decaying_sine(DepolariseOptions(amplitude_v=5.0, frequency_hz=20.0, cycles=10), 1000.0)
    assert sweep.size == 500
    assert sweep[0] == 0.0
    assert abs(sweep[-1]) < 1e-12


@pytest.mark.system
def test_the_tare_survives_the_loop(tmp_path):
    """The sensor is 3 µm off. The offsets are read from the recordings of the tared loop and of the next loop."""
    changes = (
        ("noise_um = 0.010\n", "noise_um = 0.0\noffset_um = 3.0\n"),
        ("[recording]", "[service]\ntare_s = 0.2\n[recording]"),
    )
    with Bench(tmp_path, *changes) as bench:
        bench.await_drive()
        os.kill(bench.pid("rt"), signal.SIGKILL)
        bench.await_restart()
        bench.recover()
        assert bench.stop() == 0, bench.log()
    first, second = (rtloop.load(files) for files in runs_in(tmp_path / "recordings"))
    offsets_v = [run["x_adc_v"] - run["x_position_um"] / 10.0 for run in (first, second)]
    assert abs(offsets_v[0][0]) < 1e-12
    assert abs(offsets_v[0][-1] - 0.3) < 0.001
    assert np.ptp(offsets_v[1]) < 1e-12
    assert abs(offsets_v[1][0] - offsets_v[0][-1]) < 1e-12


def test_each_axis_is_tared_by_its_own_reading(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    bench = VirtualService(tmp_path, monkeypatch, "[service]\ntare_s = 0.05\n")
    bench.begin_loop()
    bench.driver.offsets_v = np.array([0.1, -0.2])
    bench.turns.start(bench.service._prepare_and_start).join()
    assert bench.service._offsets_v == {0: pytest.approx(0.1, abs=1e-9), 1: pytest.approx(-0.2, abs=1e-9)}
    assert bench.service.supervisor is not None
    newest = bench.service.supervisor.newest(1)[-1]
    for number, offset_v in enumerate((0.1, -0.2)):
        reading_v, position_um = (newest[axis_column(number, column)] for column in (ADC, POSITION))
        assert position_um == pytest.approx(10.0 * (reading_v - offset_v), abs=1e-9)
    bench.turns.end()


@pytest.fixture
def make_bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., VirtualBench]]:
    """Yield the constructor of a service in virtual time from changes of the paper's configuration."""
    benches: list[VirtualBench] = []

    def construct(*changes: tuple[str, str]) -> VirtualBench:
        benches.append(VirtualBench(tmp_path, monkeypatch, on_a_rig(tmp_path, *changes)))
        return benches[-1]

    yield construct
    for bench in benches:
        bench.end()


def test_while_the_actuator_is_depolarised_setpoints_move_nothing_and_no_start_undoes_a_stop(make_bench, caplog):
    """A setpoint of 4 µm would be 4 V in mode raw; the depolarising sine has 2 V."""
    caplog.set_level("INFO")
    bench = make_bench(("[recording]", "[service]\ndepolarise = { amplitude_v = 2.0, cycles = 200 }\n[recording]"))
    bench.wait_for(lambda: abs(bench.column("x_drive_v")).max() > 0.5, "the sine")
    for resource, body in (("/setpoint", {"value": 4.0}), ("/waveform", {"samples": [4.0, 4.0]})):
        with pytest.raises(RtloopError, match="the actuator is being depolarised; send the request again"):
            bench.client.post(resource, {"axis": "x"} | body)
    with pytest.raises(RtloopError, match="mode closed_loop: the actuator is being depolarised or tared; send"):
        bench.client.post("/start")
    bench.client.post("/stop")
    message = "the configured mode does not apply: mode off was requested during the start"
    bench.wait_for(lambda: message in caplog.text, "the end of the preparation")
    bench.turns.sleep(0.25)
    assert (bench.status()["mode"], bench.column("x_drive_v")[-1]) == ("off", 0.0)
    assert abs(bench.column("x_drive_v")).max() < 2.1
    bench.client.post("/start")
    bench.await_drive()
    assert bench.column("x_drive_v")[-1] > 1.0
    bench.client.post("/setpoint", {"axis": "x", "value": 4.0})  # The preparation that has ended refuses no reference.


def test_a_service_in_mode_raw_plays_its_reference_after_the_tare(make_bench):
    """The reference is a sine from 1 V to 5 V; the service begins at 0 V and then follows the sine."""
    bench = make_bench(
        ("[loop]\n", '[loop]\nmode = "raw"\n'),
        ("amplitude = 8.0\noffset = 20.0\n", "amplitude = 2.0\noffset = 3.0\n"),
        ("[recording]", "[service]\ntare_s = 0.1\n[recording]"),
    )
    bench.wait_for(lambda: bench.column("x_drive_v").max() > 4.9, "the sine's top")
    begin = bench.ticks
    bench.turns.sleep(0.2)
    followed_v = bench.column("x_drive_v")[begin:]  # a period
    assert (np.min(followed_v), np.max(followed_v)) == (pytest.approx(1.0, abs=0.01), pytest.approx(5.0, abs=0.01))
