"""Faults that could move an output: repeated or killed parking, a log without a reader, tuning of a driving loop."""

from __future__ import annotations

import ctypes
import os
import random
import signal
import time
import warnings
from collections.abc import Callable

import numpy as np

from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.drivers.base import Driver
from rtloop.drivers.errors import DriverError
from rtloop.engine.memory import SharedBlock
from rtloop.engine.ramp import ramp
from rtloop.hil.board import LSB_V
from rtloop.supervision.parking import park
from tests.faults.bench import Bench
from tests.faults.evidence import TIMEOUT_S, wait_for
from tests.faults.fault import Fault, NotPossible, Outcome
from tests.faults.processes import KILLED_SAFE_MS
from tests.faults.requests import is_refused
from tests.full_pipe import fill

DEATHS, SEED = 200, 14
WRITE_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p)
WITHOUT_RESTART = (("[recording]", "[service]\nrestarts = 0\n[recording]"),)
PATIENT = (("[recording]", "[service]\nstall_ms = 60000.0\n[recording]"),)
FORGED_V, STRANGER = 9.9, 65534
TAPS = (128, 3, 64, 1, 17, 5)


def parked_three_times(bench: Bench) -> Outcome:
    """Kill service and loop together, then park three times while the configuration file holds half of its text."""
    service, loop, text = bench.pid("service"), bench.pid("rt"), bench.config.read_text()
    bench.config.write_text(text[: len(text) // 2] + "[[axis")
    bench.strike(lambda: os.kill(service, signal.SIGKILL), lambda: os.kill(loop, signal.SIGKILL))
    assert bench.service is not None
    bench.service.wait()
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0
    took_ms = bench.await_safe()  # no bound: an interpreter must start
    moved_ns = bench.output_record().moved_ns
    for _ in range(2):
        assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0
    assert bench.output_record().moved_ns == moved_ns, "the output moved again"
    bench.config.write_text(text)
    bench.start_service()
    bench.await_drive()
    return Outcome(took_ms)


def forged_block(bench: Bench) -> Outcome:
    """Kill service and loop, and give the shared block to another user: `park` must refuse it."""
    if os.geteuid() != 0:
        raise NotPossible("only root can give a file to another user")
    service, loop = bench.pid("service"), bench.pid("rt")
    bench.strike(lambda: os.kill(service, signal.SIGKILL), lambda: os.kill(loop, signal.SIGKILL))
    assert bench.service is not None
    bench.service.wait()
    (path,) = (bench.folder / "run").glob("*.block")
    before_v = bench.output_record().last_v
    with path.open("r+b") as file:
        SharedBlock(file.fileno())["last_drive_v"][0] = FORGED_V
    os.chown(path, STRANGER, STRANGER)
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) != 0, "the block of another user was believed"
    assert bench.output_record().last_v == before_v, "an output moved"
    path.unlink()
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0
    took_ms = bench.await_safe()  # no bound: an interpreter must start
    bench.start_service()
    bench.await_drive()
    return Outcome(took_ms, note=f"park refused the block, at {before_v:.2f} V")


def parked_without_restart(bench: Bench) -> Outcome:
    """Kill the loop of a service without restarts: the service parks and ends, and a later `park` moves nothing."""
    bench.strike(lambda: os.kill(bench.pid("rt"), signal.SIGKILL))
    took_ms = bench.await_safe(KILLED_SAFE_MS)
    assert bench.service is not None
    bench.service.wait(TIMEOUT_S)
    moved_ns = bench.output_record().moved_ns
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0
    assert bench.output_record().moved_ns == moved_ns, "the output moved again"
    return Outcome(took_ms, exit_code=1)


def service_ended_while_parking(bench: Bench) -> Outcome:
    """Kill the loop, and send SIGTERM to the service while it parks."""
    bench.strike(
        lambda: os.kill(bench.pid("rt"), signal.SIGKILL), lambda: os.kill(bench.pid("service"), signal.SIGTERM)
    )
    took_ms = bench.await_safe(KILLED_SAFE_MS)
    assert bench.service is not None
    bench.service.wait(TIMEOUT_S)
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0
    return Outcome(took_ms, exit_code=1)


def full_pipe(bench: Bench) -> Outcome:
    """Fill the pipe of the log, whose reader has stopped, then kill the loop: the service must still park in time."""
    bench.stop()
    reading, writing = os.pipe()
    bench.stderr = writing
    bench.start_service()
    bench.await_drive()
    filled_bytes = fill(writing)
    bench.strike(lambda: os.kill(bench.pid("rt"), signal.SIGKILL))
    took_ms = bench.await_safe(KILLED_SAFE_MS)
    bench.await_restart()
    assert bench.await_state("tripped")["faults"]
    bench.recover()
    assert len(os.read(reading, filled_bytes)) > 0
    os.close(reading)
    os.close(writing)
    bench.stderr = None
    return Outcome(took_ms, note=f"{filled_bytes} bytes in the pipe")


def filter_lengths_change(bench: Bench) -> Outcome:
    """Tune the pre-filter to each length of TAPS while the loop drives."""
    bench.strike()
    for taps in TAPS:
        ticks = bench.ticks
        bench.client.post("/tune", {"axis": "x", "section": "prefilter", "values": {"taps": [1 / taps] * taps}})
        wait_for(lambda ticks=ticks: bench.ticks > ticks + 500, "some more ticks")
    report = bench.status()
    assert (report["state"], report["restarts"]) == ("running", 0), report
    return Outcome(note=f"{len(TAPS)} lengths")


def setpoint_refused(bench: Bench) -> Outcome:
    """Post a setpoint to a stopped loop: the refused setpoint is not applied once the loop runs again."""
    loop, before_um = bench.pid("rt"), bench.status()["axes"]["x"]["reference_um"]
    bench.strike(lambda: os.kill(loop, signal.SIGSTOP))
    assert is_refused(bench, "/setpoint", {"axis": "x", "value": -before_um})
    os.kill(loop, signal.SIGCONT)
    ticks = bench.ticks
    wait_for(lambda: bench.ticks > ticks + 1000, "some more ticks")
    reference_um = bench.status()["axes"]["x"]["reference_um"]
    assert reference_um * before_um > 0, f"reference {before_um} µm, now {reference_um} µm"
    return Outcome()


def parking_killed(bench: Bench) -> Outcome:
    """Repeat DEATHS times: a process drives the output and dies, one is killed while it parks, a third one parks."""
    service, loop = bench.pid("service"), bench.pid("rt")
    plan = prepare(load(bench.config)).plan
    slew_v_per_s, last_drive_v, chance = plan.trip_slew_v_per_s, bench.blocks[-1]["last_drive_v"], random.Random(SEED)
    bench.strike(lambda: os.kill(service, signal.SIGKILL), lambda: os.kill(loop, signal.SIGKILL))
    assert bench.service is not None
    bench.service.wait()
    wait_for(lambda: bench.blocks[-1].driver_pid() is None, "the loop's end")
    park(plan.driver(), slew_v_per_s, last_drive_v)
    halfway = 0
    for _ in range(DEATHS):
        drive_v = chance.uniform(-9.0, 9.0)
        os.waitpid(fork(lambda drive_v=drive_v: drive_and_die(plan.driver(), drive_v, slew_v_per_s)), 0)
        wait_for(lambda drive_v=drive_v: abs(bench.output_record().last_v - drive_v) < LSB_V, "a drive")
        pid = fork(lambda: park(plan.driver(), slew_v_per_s, last_drive_v))
        time.sleep(chance.uniform(0.0, 2.0 * abs(drive_v) / slew_v_per_s))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        halfway += 0.0 < abs(park(plan.driver(), slew_v_per_s, last_drive_v)[0]) < abs(drive_v) - LSB_V
        wait_for(lambda: bench.output_record().last_v == 0.0, "a safe output")
    assert halfway > DEATHS // 10, f"{halfway} of {DEATHS} died halfway"
    bench.start_service()
    bench.await_drive()
    return Outcome(note=f"{DEATHS} deaths, seed {SEED}, {halfway} of them halfway down")


def drive_and_die(driver: Driver, drive_v: float, slew_v_per_s: float) -> None:
    """Ramp the output to `drive_v` at the slew limit, and end the process there."""
    pointers = driver.open()
    write = WRITE_FUNCTION(pointers.write)
    for row in ramp(np.zeros(1), np.array([drive_v]), slew_v_per_s / driver.rate_hz):
        write(pointers.context, row.ctypes.data)
        time.sleep(1.0 / driver.rate_hz)
    os._exit(0)


def fork(work: Callable[[], object]) -> int:
    """Fork a child that does `work` and ends; return its process id."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        pid = os.fork()
    if pid == 0:
        try:
            work()
        except DriverError:
            pass
        finally:
            os._exit(0)
    return pid


FAULTS = (
    Fault("parked three times", "the first parking ramps, the others move nothing", parked_three_times),
    Fault("block of another user", "refused, no output moves; parked without the block", forged_block),
    Fault("loop SIGKILL, no restart", "service parks and ends; parking again moves nothing",
          parked_without_restart, changes=WITHOUT_RESTART),
    Fault("loop SIGKILL, then SIGTERM", "parked; parking again moves nothing", service_ended_while_parking),
    Fault("log that nobody reads", "parked in time; only lines of the log are lost", full_pipe),
    Fault("pre-filters of other lengths", "the loop goes on", filter_lengths_change),
    Fault("setpoint while it stands still", "refused, and not applied later", setpoint_refused, changes=PATIENT),
    Fault("parking SIGKILL, again and again", "each parking continues from the present output", parking_killed),
)  # fmt: skip
