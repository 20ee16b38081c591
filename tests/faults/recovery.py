"""Recovery by policy: each cause of a trip under each policy, and requests and faults between a trip and the return.

A row that recovers compares the steps in the recordings; a row that must not recover watches the output.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress

import rtloop
from rtloop.errors import RtloopError
from rtloop.hil import board
from tests.faults import plain_card
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.faults.fault import Fault, Outcome
from tests.faults.hardware import SHIFTED
from tests.faults.laws import WITH_ENDLESS_LAW, endless_law_file
from tests.laws.failing import ENDLESS_UM

QUICK = "wait_s = 0.2\nconfirmations = 3\nconfirmation_s = 0.1\n"
ALL_CAUSES = 'causes = ["stale", "driver", "late", "heartbeat"]\n'
CONFIRMED_S = 0.2 + 3 * 0.1
STANDS_STILL_S = 3.0
"""Time in s for which a row that must not recover is watched: more than five times that of a recovery."""
SHORT_AGE = ("sample_age_us = 400000.0", "sample_age_us = 100000.0")
LATE = ("sample_age_us = 400000.0", "sample_age_us = 400000.0\nlate_us = 10000.0\nlate_ticks = 1")
LATE_S = 0.025
SLOW_RETURN = ("[axis.limits]\n", "[axis.limits]\nbump_s = 0.1\n")
"""A return takes ten times `bump_s`: one second, in which a request arrives in time even on a busy host."""


def policy(text: str = "", before: str = "") -> tuple[str, str]:
    """Return a change of the configuration: tables [service.recover] with lines `text`, [service] with `before`."""
    return "[recording]", f"[service]\n{before}[service.recover]\n{QUICK}{text}[recording]"


def recovery_steps(bench: Bench) -> list[str]:
    """Return the steps of all recoveries in the recordings, in order; the service must have ended."""
    paths = sorted((bench.folder / "recordings").glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)
    events = [event for path in paths for event in rtloop.load(path).events]
    return [event["what"]["step"] for event in events if event["kind"] == "recovery"]


def await_recovered(bench: Bench, count: int = 1) -> None:
    """Wait for `count` completed recoveries, and for a closed loop that drives, without trip or fault."""
    wait_for(lambda: bench.log().count(": recovered") >= count, f"recovery {count}; {bench.status().get('recovery')}")
    if not bench._follows_the_present_loop():
        bench.follow()
    report = bench.await_state("running")
    assert (report["mode"], report["trip"], report["faults"]) == ("closed_loop", [], []), report
    wait_for(lambda: abs(bench.output_record().last_v) > 1.0, "a drive")


def stays_safe(bench: Bench, seconds: float = STANDS_STILL_S) -> None:
    """Wait for 0 V, then require that output and service stay at 0 V and tripped for `seconds`."""
    wait_for(lambda: bench.output_record().last_v == 0.0, "a safe output")
    moved_ns, returns = bench.output_record().moved_ns, bench.log().count(": recovered")
    time.sleep(seconds)
    assert bench.output_record().moved_ns == moved_ns, f"the output moved; {bench.log()[-600:]}"
    report = wait_for(bench.status, "an answer")
    assert report["state"] == "tripped", report
    assert (report["recovery"] or {"state": "latched"})["state"] == "latched", report["recovery"]
    assert bench.log().count(": recovered") == returns


def await_return(bench: Bench) -> None:
    """Wait until a recovery drives the output back."""
    driving = lambda: abs(bench.output_record().last_v) > 0.5 and bench.status()["recovery"]["state"] == "returning"
    wait_for(driving, "a return", poll_s=0.002)


Strike = Callable[[Bench], None]


def board_sleeps(bench: Bench) -> None:
    """Stop the board until the loop trips by a stale input, then let the board run again."""
    assert bench.board is not None
    process = bench.board
    bench.strike(lambda: process.send_signal(signal.SIGSTOP))
    bench.await_state("tripped", "stale")
    process.send_signal(signal.SIGCONT)


def card_fails(fault: int) -> Strike:
    """Return a function that sets a fault of the card."""
    return lambda bench: bench.strike(lambda: bench.cause_fault(fault))


def loop_sleeps(bench: Bench) -> None:
    """Stop the loop for LATE_S, which trips it as late."""
    loop = bench.pid("rt")

    def sleep() -> None:
        os.kill(loop, signal.SIGSTOP)
        time.sleep(LATE_S)
        os.kill(loop, signal.SIGCONT)

    bench.strike(sleep)
    bench.await_state("tripped", "late")


def service_sleeps(bench: Bench) -> None:
    """Stop the service until the loop has parked, then let the service run again."""
    service = bench.pid("service")
    bench.strike(lambda: os.kill(service, signal.SIGSTOP))
    wait_for(lambda: bench.output_record().last_v == 0.0, "a safe output")
    os.kill(service, signal.SIGCONT)


def narrow(key: str, value: float, cause: str) -> Strike:
    """Return a function that sets an interlock's limit below the present signal, and waits for the trip."""

    def strike(bench: Bench) -> None:
        body = {"axis": "x", "section": "interlocks", "values": {key: value}}
        bench.strike(lambda: bench.client.post("/tune", body))
        bench.await_state("tripped", cause)

    return strike


def board_fault(fault: int) -> Strike:
    """Return a function that sets a fault of the board until the loop trips."""

    def strike(bench: Bench) -> None:
        bench.strike(lambda: bench.cause_fault(fault))
        bench.await_state("tripped")
        bench.cause_fault(board.NO_FAULT)

    return strike


def oscillates(bench: Bench) -> None:
    """Wait for the trip of a loop that oscillates from its start."""
    bench.await_state("tripped", "oscillation")


def loop_dies(bench: Bench) -> None:
    """Kill the loop and wait for its replacement."""
    bench.strike(lambda: os.kill(bench.pid("rt"), signal.SIGKILL))
    bench.await_restart()


def law_hangs(bench: Bench) -> None:
    """Set the setpoint at which the law never returns, and wait for another loop."""
    with suppress(RtloopError):
        bench.strike(lambda: bench.client.post("/setpoint", {"axis": "x", "value": ENDLESS_UM + 1.0}))
    bench.await_restart()


def enable_opens(bench: Bench) -> None:
    """Open the enable input until the loop trips."""
    bench.strike(lambda: bench.cause_fault(plain_card.ENABLE_OPEN))
    bench.await_state("tripped", "enable")
    bench.cause_fault(plain_card.NONE)


def expect_recovery(strike: Strike, *steps: str, new_loop: bool = False):
    """Return a fault after which the service must recover by `steps`; with `new_loop`, in a new loop."""

    def inject(bench: Bench) -> Outcome:
        strike(bench)
        if new_loop:
            bench.await_restart()
        await_recovered(bench)
        bench.stop()
        events = [step for step in recovery_steps(bench) if step != "unsound"]
        assert events == list(steps or ("begun", "confirmed", "returning", "recovered")), events
        return Outcome()

    return inject


def expect_latched(strike: Strike, new_loop: bool = False):
    """Return a fault after which the trip must stay latched; with `new_loop`, in a new loop."""

    def inject(bench: Bench) -> Outcome:
        strike(bench)
        if new_loop:
            bench.await_restart()
        stays_safe(bench)
        return Outcome()

    return inject


def latches_after_two(bench: Bench) -> Outcome:
    """Trip three times within an hour: the service recovers twice, then stays latched until a reset."""
    for count in (1, 2):
        board_sleeps(bench)
        await_recovered(bench, count)
        bench.await_drive()
    board_sleeps(bench)
    wait_for(lambda: bench.status().get("recovery", {}).get("state") == "latched", "a latched recovery")
    moved_ns = wait_for(lambda: bench.output_record().last_v == 0.0 and bench.output_record().moved_ns, "a safe output")
    time.sleep(STANDS_STILL_S)
    assert bench.output_record().moved_ns == moved_ns, "the output moved"
    report = bench.status()["recovery"]
    assert report["left"] == 0, report
    assert "max_per_hour" in report["reason"], report
    bench.recover()
    return Outcome(note=report["reason"])


def client_takes_over(command: str, in_state: str):
    """Return a fault that posts a stop or a reset while the recovery is `in_state`: the recovery must end."""

    def inject(bench: Bench) -> Outcome:
        assert bench.board is not None
        process = bench.board
        bench.strike(lambda: process.send_signal(signal.SIGSTOP))
        if in_state != "returning":
            wait_for(lambda: bench.status().get("recovery", {}).get("state") == in_state, in_state)
            bench.client.post(command)
            process.send_signal(signal.SIGCONT)
        else:
            bench.await_state("tripped", "stale")
            process.send_signal(signal.SIGCONT)
            await_return(bench)
            bench.client.post(command)
        wait_for(lambda: bench.output_record().last_v == 0.0, "a safe output")
        moved_ns = bench.output_record().moved_ns
        time.sleep(STANDS_STILL_S)
        assert bench.output_record().moved_ns == moved_ns, f"the output moved; {bench.log()[-800:]}"
        assert ": recovered" not in bench.log()
        assert ": ended" in bench.log()
        return Outcome()

    return inject


def trips_in_the_middle(bench: Bench) -> Outcome:
    """Stop the board again while the output returns: the service counts a second recovery."""
    assert bench.board is not None
    board_sleeps(bench)
    await_return(bench)
    board_sleeps(bench)
    await_recovered(bench)
    assert bench.status()["recovery"]["left"] == 1, bench.status()["recovery"]
    bench.stop()
    assert recovery_steps(bench).count("begun") == 2
    return Outcome()


def service_ends(bench: Bench) -> Outcome:
    """Send SIGTERM while the service confirms the readings: the output does not move, the exit code is 0."""
    board_sleeps(bench)
    moved_ns = wait_for(lambda: bench.output_record().last_v == 0.0 and bench.output_record().moved_ns, "a safe output")
    assert bench.stop() == 0
    assert bench.output_record().moved_ns == moved_ns, "the output moved"
    return Outcome()


def another_configuration(bench: Bench) -> Outcome:
    """Reload a changed configuration during a recovery: the trip stays latched."""
    assert bench.board is not None
    process = bench.board
    bench.strike(lambda: process.send_signal(signal.SIGSTOP))
    bench.await_state("tripped", "stale")
    bench.config.write_text(bench.config.read_text().replace("position_um = 60.0", "position_um = 55.0"))
    bench.client.post("/reload")
    process.send_signal(signal.SIGCONT)
    stays_safe(bench)
    assert "changed" in bench.status()["recovery"]["reason"], bench.status()["recovery"]
    return Outcome()


def card_flaps(bench: Bench) -> Outcome:
    """Make the card's read fail in each new loop: after three recoveries the trip stays latched."""
    bench.cause_fault(plain_card.RAISE_IN_READ)
    for count in range(1, 5):
        wait_for(
            lambda count=count: bench.status().get("restarts", 0) >= count and bench.status().get("ticks"), "a loop"
        )
        bench.follow()
        bench.cause_fault(plain_card.RAISE_IN_READ)
    bench.cause_fault(plain_card.NONE)
    wait_for(lambda: bench.status().get("ticks"), "a loop")
    if not bench._follows_the_present_loop():
        bench.follow()
    stays_safe(bench)
    assert bench.status()["recovery"]["left"] == 0, bench.status()["recovery"]
    return Outcome(note=f"{bench.status()['restarts']} loops, the service runs on")


READ, WRITE = card_fails(plain_card.RAISE_IN_READ), card_fails(plain_card.RAISE_IN_WRITE)
SINE = ("[recording]", "[service.depolarise]\namplitude_v = 0.8\nfrequency_hz = 10.0\ncycles = 5\n[recording]")
DEPOLARISED = ("begun", "confirmed", "depolarised", "returning", "recovered")
WITHOUT_POLICY = ("[recording]", "[service]\n[recording]")
NEVER_RECOVERED = (
    ("position", narrow("position_um", 10.0, "position"), ()),
    ("sensor_range", narrow("sensor_max_v", 1.0, "sensor_range"), ()),
    ("frozen", board_fault(board.FROZEN_INPUT), (("frozen_ticks = 2000", "frozen_ticks = 100"),)),
    ("tracking", board_fault(board.STUCK_OUTPUT), (("tracking_ticks = 2000", "tracking_ticks = 200"),)),
    ("loop SIGKILL", loop_dies, ()),
)


def _rows(name: str, strike: Strike, allowed: str, forbidden: str, *changes: tuple[str, str], **more) -> list[Fault]:  # type: ignore[no-untyped-def]
    """Return the rows of one cause outside the law: allowed by the policy, not allowed by it, and without a policy."""
    new_loop = more.pop("new_loop", False)
    return [
        Fault(f"recover: {name}, allowed", "confirmed, returns by ramp", expect_recovery(strike, new_loop=new_loop),
              changes=(policy(allowed), *changes), **more),
        Fault(f"recover: {name}, not in causes", "stays tripped", expect_latched(strike, new_loop),
              changes=(policy(forbidden), *changes), **more),
        Fault(f"recover: {name}, no policy", "stays tripped", expect_latched(strike, new_loop),
              changes=(WITHOUT_POLICY, *changes), **more),
    ]  # fmt: skip


FAULTS = (
    *_rows("stale", board_sleeps, "", 'causes = ["driver", "late", "heartbeat"]\n', SHORT_AGE),
    *_rows("late", loop_sleeps, "", 'causes = ["stale", "driver", "heartbeat"]\n', LATE),
    *_rows("heartbeat", service_sleeps, ALL_CAUSES, "", new_loop=True),
    *_rows("driver read", READ, "", 'causes = ["stale", "late", "heartbeat"]\n', card=True, new_loop=True),
    *_rows("driver write", WRITE, "", 'causes = ["stale", "late", "heartbeat"]\n', card=True, new_loop=True),
    *(
        Fault(f"recover: {name}, every cause allowed", "stays tripped", expect_latched(strike),
              changes=(policy(ALL_CAUSES), *changes))
        for name, strike, changes in NEVER_RECOVERED
    ),
    Fault("recover: oscillation, every cause allowed", "stays tripped", expect_latched(oscillates),
          changes=(policy(ALL_CAUSES), *SHIFTED), drives=False),
    Fault("recover: non_finite, every cause allowed", "stays tripped", expect_latched(card_fails(plain_card.NAN)),
          changes=(policy(ALL_CAUSES),), card=True),
    Fault("recover: enable, every cause allowed", "stays tripped", expect_latched(enable_opens),
          changes=(policy(ALL_CAUSES),), card=True),
    Fault("recover: law never ends, every cause allowed", "stays tripped", expect_latched(law_hangs),
          changes=(policy(ALL_CAUSES), *WITH_ENDLESS_LAW), around=endless_law_file),
    Fault("recover: stale, depolarises", "a sine, then returns by ramp", expect_recovery(board_sleeps, *DEPOLARISED),
          changes=(SHORT_AGE, ("[recording]", f"[service.recover]\n{QUICK}depolarise = true\n" + SINE[1]))),
    Fault("recover: third trip of two an hour", "latched until reset", latches_after_two,
          changes=(policy("max_per_hour = 2\n"), SHORT_AGE)),
    Fault("recover: stop while it waits", "ends; does not move", client_takes_over("/stop", "waiting"),
          changes=(policy(), SHORT_AGE)),
    Fault("recover: stop while it returns", "ends; ramps down", client_takes_over("/stop", "returning"),
          changes=(policy(), SHORT_AGE, SLOW_RETURN)),
    Fault("recover: reset while it confirms", "ends; does not move", client_takes_over("/reset", "confirming"),
          changes=(policy(), SHORT_AGE)),
    Fault("recover: trip while it returns", "counts, and returns again", trips_in_the_middle,
          changes=(policy(), SHORT_AGE, SLOW_RETURN)),
    Fault("recover: SIGTERM in the middle", "ends safe, exit 0", service_ends, changes=(policy(), SHORT_AGE)),
    Fault("recover: configuration replaced", "stays tripped", another_configuration, changes=(policy(), SHORT_AGE)),
    Fault("recover: card flaps", "latched after three; no drive, service lives", card_flaps, changes=(policy(),),
          card=True),
)  # fmt: skip
