"""The loop's process: `python -m rtloop.engine.process --fd N`, the plan on stdin, one JSON line per report on stdout.

It has the interpreter to itself: no thread, no collection, no signal handler runs beside the compiled loop. It ends
by the shared block's stop word, at the end of its ticks, or by itself when the supervisor's heartbeat stops; each
time it ramps down and closes the driver first.
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
from typing import Any

from drivers.base import Driver
from drivers.errors import DriverError
from rtloop.engine.assembly import UNLIMITED, Assembly, law_at_rest
from rtloop.engine.clock import clock_context, paced_clock, unpaced_clock
from rtloop.engine.loop import Outcome
from rtloop.engine.memory import ProcessState, SharedBlock, Word
from rtloop.engine.plan import Plan, require_facts
from rtloop.engine.ramp import found_v, ramp_to_safe
from rtloop.engine.realtime import die_with_parent, freeze_garbage_collection, prepare_realtime
from rtloop.engine.rehearsal import rehearse
from rtloop.errors import ConfigError, LoopFault, RefusedError, RtloopError, UnavailableError

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


def report(kind: str, **facts: Any) -> None:
    """One JSON line to the supervisor, if it still lives; unbuffered, so that nothing is left to fail at the exit."""
    with contextlib.suppress(BrokenPipeError):
        os.write(STDOUT, json.dumps({"report": kind, **facts}).encode() + b"\n")


def main() -> int:
    """Run the plan on stdin. The exit code is that of the command line."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    parser = argparse.ArgumentParser()
    parser.add_argument("--fd", type=int, required=True)
    fd = parser.parse_args().fd
    rehearse()  # loads the compiled loop while the supervisor still reads the configuration
    try:
        plan: Plan = pickle.load(sys.stdin.buffer)
    except EOFError:
        return 0  # there was nothing to run
    block = SharedBlock(fd)
    block.claim()
    driver: Driver | None = None
    state = ProcessState.FAILED
    try:
        driver = plan.driver()
        facts = require_facts(driver, plan.pacing.rate_hz, plan.pacing.paced)
        outcome = _run(plan, block, driver, facts)
        report("finished", outcome=outcome.name.lower(), driver_error=_driver_error(driver))
        state = ProcessState.FINISHED
        code = EXIT_CODES[outcome]
    except DriverError as error:
        report("failed", message=str(error), exit_code=UnavailableError.exit_code)
        code = UnavailableError.exit_code
    except ValueError as error:
        report("failed", message=f"driver.{error}", exit_code=ConfigError.exit_code)
        code = ConfigError.exit_code
    except RtloopError as error:
        report("failed", message=str(error), exit_code=error.exit_code)
        code = error.exit_code
    finally:
        try:
            if driver is not None:
                driver.close()
        except DriverError as error:
            report("failed", message=str(error), exit_code=UnavailableError.exit_code)
            code, state = UnavailableError.exit_code, ProcessState.FAILED
        block.words[Word.LOOP_STATE] = state
    return code


def _run(plan: Plan, block: SharedBlock, driver: Driver, facts: Any) -> Outcome:
    context = clock_context(plan.pacing.rate_hz)
    if plan.pacing.paced:
        clock = paced_clock(context, plan.pacing.spin_us)
    else:
        die_with_parent()
        ring = block.ring("ticks")
        clock = unpaced_clock(context, ring.head, block.words, Word.RECORDER_CURSOR, ring.marks.size // 2)
    pointers = driver.open()
    ramp_to_safe(driver, pointers, found_v(driver, None), plan.trip_slew_v_per_s)  # as somebody who died left them
    assembly = Assembly(plan, block, facts, pointers, clock, law_at_rest(plan))
    assembly.run(0)  # compiles, or loads the compiled loop, before anything is timed
    freeze_garbage_collection()
    realtime = prepare_realtime(plan.pacing)
    granted = realtime["scheduler"] == "SCHED_FIFO" and realtime["mlock"]
    if plan.pacing.require_realtime and plan.pacing.paced and not granted:
        raise RefusedError(f"loop.require_realtime: true, but the host refused {'; '.join(realtime['refused'])}")
    block.words[Word.LOOP_STATE] = ProcessState.READY
    report("ready", realtime=realtime)
    while not block.words[Word.GO]:
        if block.words[Word.STOP]:
            return Outcome.STOPPED
        if time.monotonic_ns() - int(block.words[Word.HEARTBEAT_NS]) > plan.pacing.heartbeat_timeout_s * 1e9:
            return Outcome.HEARTBEAT_LOST
        time.sleep(GO_POLL_S)
    if plan.pacing.paced:
        context.start_ns = time.monotonic_ns() + START_DELAY_NS
        block.words[Word.START_UNIX_NS] = time.time_ns() + START_DELAY_NS
    block.words[Word.LOOP_STATE] = ProcessState.RUNNING
    try:
        outcome = assembly.run(UNLIMITED if plan.ticks is None else plan.ticks)
        block.words[Word.FINISHED_TICKS] = assembly.loop.tick
        if outcome is Outcome.DONE:
            block.words[Word.STOP] = 1  # ramp down, after the ticks that are recorded
            assembly.run(UNLIMITED)
        return outcome
    finally:
        ramp_to_safe(driver, pointers, assembly.outputs_v, plan.trip_slew_v_per_s)  # where the loop did not


def _driver_error(driver: Driver) -> str | None:
    error = getattr(driver, "error", None)
    return None if error is None else f"{type(error).__name__}: {error}"


if __name__ == "__main__":
    sys.exit(main())
