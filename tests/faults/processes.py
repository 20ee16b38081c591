"""Faults of processes: killed and stopped."""

from __future__ import annotations

import os
import signal

from tests.faults.bench import Bench
from tests.faults.evidence import TIMEOUT_S, wait_for
from tests.faults.fault import Fault, Measured

KILLED_SAFE_MS = 100.0
STOPPED_SAFE_MS, ORPHAN_SAFE_MS = KILLED_SAFE_MS + 50.0, KILLED_SAFE_MS + 1000.0
"""From the fault to 0 V on a host that does not stall: the death of a loop is noticed at the next look, 5 ms later, a
loop that stands still after `stall_ms`, a silent service after `heartbeat_timeout_s`; then the driver is opened, and
the ramp from 8 V takes 16 ms. What the host stalls meanwhile comes on top, as measured."""
HOST_STALL_S, SERVICE_STALL_S = 0.3, 2.5


def rt(number: signal.Signals, safe_ms: float):
    def inject(bench: Bench) -> Measured:
        bench.strike(lambda: os.kill(bench.pid("rt"), number))
        took_ms = bench.await_safe(safe_ms)
        bench.await_restart()
        assert bench.await_state("tripped")["faults"]
        assert bench.seen().last_v == 0.0
        bench.recover()
        return Measured(took_ms)

    return inject


def service_killed(bench: Bench) -> Measured:
    bench.strike(lambda: os.kill(bench.pid("service"), signal.SIGKILL))
    took_ms = bench.await_safe(ORPHAN_SAFE_MS)
    assert bench.service is not None
    bench.service.wait()
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0
    assert bench.seen().last_v == 0.0
    bench.start_service()
    bench.await_drive()
    return Measured(took_ms)


def service_stopped(bench: Bench) -> Measured:
    service, blocks = bench.pid("service"), bench.blocks[-1]
    bench.strike(lambda: os.kill(service, signal.SIGSTOP))
    took_ms = bench.await_safe(ORPHAN_SAFE_MS)
    ticks = int(blocks["ticks_head"][0])
    os.kill(service, signal.SIGCONT)
    bench.await_restart()
    assert ticks
    assert "heartbeat" in " ".join(bench.await_state("tripped")["faults"])
    bench.recover()
    return Measured(took_ms)


def recorder(number: signal.Signals):
    def inject(bench: Bench) -> Measured:
        bench.strike(lambda: os.kill(bench.pid("recorder"), number))
        wait_for(lambda: bench.status().get("recorder_replacements"), "a new recorder")
        ticks = bench.ticks
        wait_for(lambda: bench.ticks > ticks + 8000, "two more seconds")
        assert bench.status()["state"] == "running"
        return Measured()

    return inject


def host_stalled(bench: Bench) -> Measured:
    """Service, loop and board stand still together, as they do when the host does."""
    import time

    assert bench.board is not None
    pids = [bench.pid("service"), bench.pid("rt"), bench.board.pid]
    bench.strike(*(lambda pid=pid: os.kill(pid, signal.SIGSTOP) for pid in pids))
    time.sleep(HOST_STALL_S)
    for pid in reversed(pids):
        os.kill(pid, signal.SIGCONT)
    ticks = bench.ticks
    wait_for(lambda: bench.ticks > ticks + 4000 or bench.status().get("restarts"), "another second")
    state = bench.status()
    if state["state"] == "tripped":  # which of them was awake first decides: either is safe
        assert "stale" in state["trip"] or state["faults"], state
        if state["restarts"]:
            bench.await_restart()
        bench.recover()
        return Measured(note="tripped")
    return Measured(note="went on")


FAULTS = (
    Fault("loop SIGKILL", "service parks, starts another, tripped", rt(signal.SIGKILL, KILLED_SAFE_MS)),
    Fault("loop SIGSTOP", "service kills, parks, starts another", rt(signal.SIGSTOP, STOPPED_SAFE_MS)),
    Fault("service SIGKILL", "loop parks itself after the heartbeat", service_killed),
    Fault("service SIGSTOP", "loop parks itself; tripped after SIGCONT", service_stopped),
    Fault("recorder SIGKILL", "replaced; the loop goes on", recorder(signal.SIGKILL)),
    Fault("recorder SIGSTOP", "replaced; the loop goes on", recorder(signal.SIGSTOP)),
    Fault("host stalls 300 ms", "goes on, or trips and parks", host_stalled),
)
