"""Faults of processes: service, loop and recorder are killed or stopped by signals, and the whole host stalls."""

from __future__ import annotations

import os
import signal

from tests.faults.bench import Bench
from tests.faults.evidence import TIMEOUT_S, wait_for
from tests.faults.fault import Fault, Outcome

KILLED_SAFE_MS = 100.0
STOPPED_SAFE_MS, ORPHAN_SAFE_MS = KILLED_SAFE_MS + 50.0, KILLED_SAFE_MS + 1000.0
"""Bounds in ms from the fault to 0 V on a host that does not stall. A dead loop is noticed at the next poll after 5 ms,
a stopped loop after `stall_ms`, a silent service after `heartbeat_timeout_s`; then the driver is opened, and the ramp
from 8 V takes 16 ms. Measured stalls of the host are added."""
HOST_STALL_S, SERVICE_STALL_S = 0.3, 2.5


def signal_loop(number: signal.Signals, safe_ms: float):
    """Return a fault that sends a signal to the loop; the output must be at 0 V within `safe_ms`."""

    def inject(bench: Bench) -> Outcome:
        bench.strike(lambda: os.kill(bench.pid("rt"), number))
        took_ms = bench.await_safe(safe_ms)
        bench.await_restart()
        assert bench.await_state("tripped")["faults"]
        assert bench.output_record().last_v == 0.0
        bench.recover()
        return Outcome(took_ms)

    return inject


def service_killed(bench: Bench) -> Outcome:
    """Kill the service: the loop parks, and `rtloop park` and a new service work afterwards."""
    bench.strike(lambda: os.kill(bench.pid("service"), signal.SIGKILL))
    took_ms = bench.await_safe(ORPHAN_SAFE_MS)
    assert bench.service is not None
    bench.service.wait()
    assert bench.rtloop("park", bench.config).wait(TIMEOUT_S) == 0
    assert bench.output_record().last_v == 0.0
    bench.start_service()
    bench.await_drive()
    return Outcome(took_ms)


def service_stopped(bench: Bench) -> Outcome:
    """Stop the service until the loop has parked, then let it run again: it reports the missed heartbeat."""
    service, blocks = bench.pid("service"), bench.blocks[-1]
    bench.strike(lambda: os.kill(service, signal.SIGSTOP))
    took_ms = bench.await_safe(ORPHAN_SAFE_MS)
    ticks = int(blocks["ticks_head"][0])
    os.kill(service, signal.SIGCONT)
    bench.await_restart()
    assert ticks
    assert "heartbeat" in " ".join(bench.await_state("tripped")["faults"])
    bench.recover()
    return Outcome(took_ms)


def signal_recorder(number: signal.Signals):
    """Return a fault that sends a signal to the recorder; the service must replace it while the loop runs."""

    def inject(bench: Bench) -> Outcome:
        bench.strike(lambda: os.kill(bench.pid("recorder"), number))
        wait_for(lambda: bench.status().get("recorder_replacements"), "a new recorder")
        ticks = bench.ticks
        wait_for(lambda: bench.ticks > ticks + 8000, "two more seconds")
        assert bench.status()["state"] == "running"
        return Outcome()

    return inject


def host_stalled(bench: Bench) -> Outcome:
    """Stop service, loop and board together for HOST_STALL_S, as a stalled host does."""
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
    if state["state"] == "tripped":  # the order in which the processes wake decides; both outcomes are safe
        assert "stale" in state["trip"] or state["faults"], state
        if state["restarts"]:
            bench.await_restart()
        bench.recover()
        return Outcome(note="tripped")
    return Outcome(note="ran on")


FAULTS = (
    Fault("loop SIGKILL", "service parks, starts another, tripped", signal_loop(signal.SIGKILL, KILLED_SAFE_MS)),
    Fault("loop SIGSTOP", "service kills, parks, starts another", signal_loop(signal.SIGSTOP, STOPPED_SAFE_MS)),
    Fault("service SIGKILL", "loop parks after the heartbeat time-out", service_killed),
    Fault("service SIGSTOP", "loop parks; tripped after SIGCONT", service_stopped),
    Fault("recorder SIGKILL", "replaced; the loop goes on", signal_recorder(signal.SIGKILL)),
    Fault("recorder SIGSTOP", "replaced; the loop goes on", signal_recorder(signal.SIGSTOP)),
    Fault("host stalls 300 ms", "runs on, or trips and parks", host_stalled),
)
