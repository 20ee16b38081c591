"""Process of the loop: `python -m rtloop.engine.process --fd N`, the plan on stdin, one JSON line per report on stdout.

No thread, garbage collection or signal handler runs beside the compiled loop. The process ends after the stop word of
the shared block, after its last tick, or when the supervisor's heartbeat is lost; it always ramps down and closes the
driver first.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import pickle
import signal
import sys
import time
from typing import TYPE_CHECKING

from rtloop.drivers.base import Driver, Facts, Pointers
from rtloop.drivers.errors import DriverError
from rtloop.engine.assembly import UNLIMITED, Assembly, law_at_rest, rehearse
from rtloop.engine.clock import clock_context, paced_clock
from rtloop.engine.heartbeat import open_heart_state
from rtloop.engine.late_clock import virtual_clock
from rtloop.engine.loop import WRITE_FAILED, Outcome
from rtloop.engine.memory import ProcessState, SharedBlock, Word
from rtloop.engine.plan import Plan, require_facts
from rtloop.engine.ramp import ramp_to_safe, starting_outputs_v
from rtloop.engine.realtime import die_with_parent, freeze_garbage_collection, prepare_realtime
from rtloop.errors import ConfigError, HostRefusal, LoopFault, RtloopError, UnavailableError, one_line_error

if TYPE_CHECKING:
    import numpy as np

EXIT_CODES = {
    Outcome.DONE: 0,
    Outcome.STOPPED: 0,
    Outcome.DRIVER_FAILED: UnavailableError.exit_code,
    Outcome.HEARTBEAT_LOST: LoopFault.exit_code,
    Outcome.LAW_FAILED: LoopFault.exit_code,
}
STDOUT = 1
START_DELAY_NS = 20_000_000
GO_POLL_S = 0.001


def report(kind: str, **facts: object) -> None:
    """Write one line of JSON, {"report": `kind`, and the `facts`}, to stdout.

    Has no effect if the supervisor has ended. The line is not buffered, so that no write can fail at the exit.
    """
    with contextlib.suppress(BrokenPipeError):
        os.write(STDOUT, json.dumps({"report": kind, **facts}).encode() + b"\n")


def main() -> int:
    """Run the plan that comes on stdin; return the exit code of the command line. Ignores SIGINT and SIGTERM.

    Without a plan it returns 0. DriverError and RtloopError are reported on stdout; errors of other classes pass
    through. In any case the driver is closed before the state in the shared block becomes FINISHED or FAILED.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    parser = argparse.ArgumentParser()
    parser.add_argument("--fd", type=int, required=True)
    fd = parser.parse_args().fd
    rehearse()  # loads the compiled loop while the supervisor still reads the configuration
    try:
        plan: Plan = pickle.load(sys.stdin.buffer)
    except EOFError:
        return 0  # the supervisor ended without a plan
    block = SharedBlock(fd)
    block.claim()
    driver: Driver | None = None
    state = ProcessState.FAILED
    try:
        driver, facts = _make_driver(plan)
        outcome = _run_plan(plan, block, driver, facts)
        report("finished", outcome=outcome.name.lower(), driver_error=block.fault)
        state = ProcessState.FINISHED
        code = EXIT_CODES[outcome]
    except (DriverError, RtloopError) as error:
        code = _report_failure(error)
    finally:
        try:
            if driver is not None:
                driver.close()
        except DriverError as error:
            code, state = _report_failure(error), ProcessState.FAILED
        block.store(Word.LOOP_STATE, state)
    return code


def _report_failure(error: DriverError | RtloopError) -> int:
    """Report "failed" on stdout, with message and exit code of an error that ended the run; return the exit code."""
    code = UnavailableError.exit_code if isinstance(error, DriverError) else error.exit_code
    report("failed", message=str(error), exit_code=code)
    return code


def _make_driver(plan: Plan) -> tuple[Driver, Facts]:
    """Return the plan's driver, not opened, and its facts.

    Raises ConfigError for options that are not allowed, a rate above the driver's limit, and virtual time on real
    hardware; DriverError if a library is missing.
    """
    try:
        driver = plan.driver()
    except ValueError as error:
        raise ConfigError(plan.name, [f"driver.{error}"]) from error
    try:
        return driver, require_facts(driver, plan.pacing.rate_hz, plan.pacing.paced)
    except ValueError as error:
        raise ConfigError(plan.name, [str(error)]) from error


def _open_driver(driver: Driver) -> Pointers:
    """Open the driver and return its pointers. Raises DriverError, also in place of any other exception of `open`."""
    try:
        return driver.open()
    except DriverError:
        raise
    except Exception as error:
        raise DriverError(f"driver {driver.kind!r} could not be opened: {one_line_error(error)}") from error


def _run_plan(plan: Plan, block: SharedBlock, driver: Driver, facts: Facts) -> Outcome:
    """Open the driver, ramp to safe, wait for GO, run all ticks, ramp down; return why the run ended.

    A stop, or the supervisor's death, before GO ends the run without a tick: the outputs are safe by then, so that a
    supervisor that only waits has no limit. Raises HostRefusal if real time is required and
    refused, DriverError if the driver cannot be opened or refuses the ramp, ValueError for a law that cannot be
    compiled, for a channel that the driver lacks and for a clock that `virtual_clock` refuses.
    """
    context = clock_context(plan.pacing.rate_hz)
    if not plan.pacing.paced:
        die_with_parent()
    pointers = _open_driver(driver)
    # an earlier process that died may have left outputs anywhere
    ramp_to_safe(driver, pointers, starting_outputs_v(driver, None), plan.trip_slew_v_per_s)
    slack = block.ring("ticks").marks.size // 2
    virtual = None if plan.pacing.paced else virtual_clock(plan, facts, block, pointers, slack)
    clock = paced_clock(context, plan.pacing.spin_us) if virtual is None else virtual.clock
    assembly = Assembly(plan, block, facts, pointers, clock, law_at_rest(plan))
    if plan.pacing.paced:
        assembly.loop.heart_fd = open_heart_state(block)
    assembly.run(0)  # compiles, or loads the compiled loop, before anything is timed
    freeze_garbage_collection()
    realtime = prepare_realtime(plan.pacing)
    granted = realtime["scheduler"] == "SCHED_FIFO" and realtime["mlock"]
    if plan.pacing.require_realtime and plan.pacing.paced and not granted:
        raise HostRefusal(
            f"loop.require_realtime: true, but the host refused {'; '.join(realtime['refused'])}; "
            "allow SCHED_FIFO and mlock on the host (deploy/host-tuning.md), or set loop.require_realtime = false"
        )
    block.store(Word.LOOP_STATE, ProcessState.READY)
    report("ready", realtime=realtime)
    while not block.load(Word.GO):
        if block.load(Word.STOP):
            return Outcome.STOPPED
        if os.getppid() != block.load(Word.SUPERVISOR_PID):
            return Outcome.HEARTBEAT_LOST
        time.sleep(GO_POLL_S)
    if plan.pacing.paced:
        context.start_ns = time.monotonic_ns() + START_DELAY_NS
        block.store(Word.START_UNIX_NS, time.time_ns() + START_DELAY_NS)
    block.store(Word.LOOP_STATE, ProcessState.RUNNING)
    try:
        outcome = assembly.run(UNLIMITED if plan.ticks is None else plan.ticks)
        block.store(Word.FINISHED_TICKS, assembly.loop.tick)
        if outcome is Outcome.DONE:
            block.store(Word.STOP, 1)  # ramp down, after the ticks that are recorded
            assembly.run(UNLIMITED)
        return outcome
    finally:
        if assembly.loop.failed:
            block.fault = _fault_text(driver, assembly.loop)
        ramp_to_safe(driver, pointers, assembly.outputs_v, plan.trip_slew_v_per_s)  # no effect if the loop has done it


def _fault_text(driver: Driver, loop: np.record) -> str:
    """Return a sentence with driver, failed operation, tick and cause.

    The cause is the driver's `error`, or the status that it returned if it has no `error`.
    """
    operation = "write" if loop.failed == WRITE_FAILED else "read"
    error = getattr(driver, "error", None)
    reason = f"the driver returned status {loop.failed_status}" if error is None else one_line_error(error)
    return f"driver {driver.kind!r}: {operation} failed at tick {loop.failed_tick}: {reason}"


if __name__ == "__main__":
    sys.exit(main())
