"""Recovery by policy: each cause of a trip under each policy, and what comes between a trip and the return.

A row that recovers reads its steps from the recordings; a row that must not sees the output stand still.
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
from tests.faults.fault import Fault, Measured
from tests.faults.hardware import SHIFTED
from tests.faults.laws import WITH_IT, beside_the_configuration
from tests.laws.failing import ENDLESS_UM

QUICK = "wait_s = 0.2\nconfirmations = 3\nconfirmation_s = 0.1\n"
EVERY = 'causes = ["stale", "driver", "late", "heartbeat"]\n'
CONFIRMED_S = 0.2 + 3 * 0.1
STANDS_STILL_S = 3.0
"""A row that must not recover is watched for so long: five times the time that a recovery takes."""
SHORT_AGE = ("sample_age_us = 400000.0", "sample_age_us = 100000.0")
LATE = ("sample_age_us = 400000.0", "sample_age_us = 400000.0\nlate_us = 10000.0\nlate_ticks = 1")
LATE_S = 0.025
SLOW_RETURN = ("[axis.limits]\n", "[axis.limits]\nbump_s = 0.1\n")
"""A return takes ten times as long as a bump: a second, so that a busy host can act in the middle of it."""


def policy(text: str = "", before: str = "") -> tuple[str, str]:
    """A change of the configuration: [service.recover] with these keys, and keys of [service] before it."""
    return "[recording]", f"[service]\n{before}[service.recover]\n{QUICK}{text}[recording]"


def recovery_steps(bench: Bench) -> list[str]:
    """Steps of the recoveries that the recordings hold, in order, once the service has ended."""
    names = sorted((bench.folder / "recordings").glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)
    events = [event for path in names for event in rtloop.load(path).events]
    return [event["what"]["step"] for event in events if event["kind"] == "recovery"]


def await_recovered(bench: Bench, count: int = 1) -> None:
    """Wait for this many returns, with the loop closed and driving, and with no trip or fault."""
    wait_for(lambda: bench.log().count(": recovered") >= count, f"return {count}; {bench.status().get('recovery')}")
    if not bench._follows_the_present_loop():
        bench.follow()
    report = bench.await_state("running")
    assert (report["mode"], report["trip"], report["faults"]) == ("closed_loop", [], []), report
    wait_for(lambda: abs(bench.seen().last_v) > 1.0, "a drive")


def stays_safe(bench: Bench, seconds: float = STANDS_STILL_S) -> None:
    """The output is at 0 V, does not move for a while, and the service stays tripped."""
    wait_for(lambda: bench.seen().last_v == 0.0, "a safe output")
    moved_ns, returns = bench.seen().moved_ns, bench.log().count(": recovered")
    time.sleep(seconds)
    assert bench.seen().moved_ns == moved_ns, f"the output moved; {bench.log()[-600:]}"
    report = wait_for(bench.status, "an answer")
    assert report["state"] == "tripped", report
    assert (report["recovery"] or {"state": "latched"})["state"] == "latched", report["recovery"]
    assert bench.log().count(": recovered") == returns


def await_return(bench: Bench) -> None:
    """Wait until the output is on its way back."""
    driving = lambda: abs(bench.seen().last_v) > 0.5 and bench.status()["recovery"]["state"] == "returning"
    wait_for(driving, "a return", poll_s=0.002)


Strike = Callable[[Bench], None]


def board_sleeps(bench: Bench) -> None:
    assert bench.board is not None
    process = bench.board
    bench.strike(lambda: process.send_signal(signal.SIGSTOP))
    bench.await_state("tripped", "stale")
    process.send_signal(signal.SIGCONT)


def card_fails(fault: int) -> Strike:
    return lambda bench: bench.strike(lambda: bench.ask_for(fault))


def loop_sleeps(bench: Bench) -> None:
    loop = bench.pid("rt")

    def sleep() -> None:
        os.kill(loop, signal.SIGSTOP)
        time.sleep(LATE_S)
        os.kill(loop, signal.SIGCONT)

    bench.strike(sleep)
    bench.await_state("tripped", "late")


def service_sleeps(bench: Bench) -> None:
    service = bench.pid("service")
    bench.strike(lambda: os.kill(service, signal.SIGSTOP))
    wait_for(lambda: bench.seen().last_v == 0.0, "a safe output")
    os.kill(service, signal.SIGCONT)


def narrow(key: str, value: float, cause: str) -> Strike:
    """An interlock narrower than what the loop does now."""

    def strike(bench: Bench) -> None:
        body = {"axis": "x", "section": "interlocks", "values": {key: value}}
        bench.strike(lambda: bench.client.post("/tune", body))
        bench.await_state("tripped", cause)

    return strike


def board_fault(fault: int) -> Strike:
    def strike(bench: Bench) -> None:
        bench.strike(lambda: bench.ask_for(fault))
        bench.await_state("tripped")
        bench.ask_for(board.NO_FAULT)

    return strike


def oscillates(bench: Bench) -> None:
    bench.await_state("tripped", "oscillation")


def loop_dies(bench: Bench) -> None:
    bench.strike(lambda: os.kill(bench.pid("rt"), signal.SIGKILL))
    bench.await_restart()


def law_hangs(bench: Bench) -> None:
    with suppress(RtloopError):
        bench.strike(lambda: bench.client.post("/setpoint", {"axis": "x", "value": ENDLESS_UM + 1.0}))
    bench.await_restart()


def enable_opens(bench: Bench) -> None:
    bench.strike(lambda: bench.ask_for(plain_card.ENABLE_OPEN))
    bench.await_state("tripped", "enable")
    bench.ask_for(plain_card.NONE)


def recovers(strike: Strike, *steps: str, new_loop: bool = False):
    def inject(bench: Bench) -> Measured:
        strike(bench)
        if new_loop:
            bench.await_restart()
        await_recovered(bench)
        bench.stop()
        seen = [step for step in recovery_steps(bench) if step != "unsound"]
        assert seen == list(steps or ("begun", "confirmed", "returning", "recovered")), seen
        return Measured()

    return inject


def stays(strike: Strike, new_loop: bool = False):
    def inject(bench: Bench) -> Measured:
        strike(bench)
        if new_loop:
            bench.await_restart()
        stays_safe(bench)
        return Measured()

    return inject


def latches_after_two(bench: Bench) -> Measured:
    """Two trips are recovered from; the third within the hour stays latched, and a reset makes it go on."""
    for count in (1, 2):
        board_sleeps(bench)
        await_recovered(bench, count)
        bench.await_drive()
    board_sleeps(bench)
    wait_for(lambda: bench.status().get("recovery", {}).get("state") == "latched", "a latched recovery")
    moved_ns = wait_for(lambda: bench.seen().last_v == 0.0 and bench.seen().moved_ns, "a safe output")
    time.sleep(STANDS_STILL_S)
    assert bench.seen().moved_ns == moved_ns, "the output moved"
    report = bench.status()["recovery"]
    assert report["left"] == 0, report
    assert "max_per_hour" in report["reason"], report
    bench.recover()
    return Measured(note=report["reason"])


def client_takes_over(command: str, in_state: str):
    """A stop or a reset in the middle of a recovery: the output does not move again."""

    def inject(bench: Bench) -> Measured:
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
        wait_for(lambda: bench.seen().last_v == 0.0, "a safe output")
        moved_ns = bench.seen().moved_ns
        time.sleep(STANDS_STILL_S)
        assert bench.seen().moved_ns == moved_ns, f"the output moved; {bench.log()[-800:]}"
        assert ": recovered" not in bench.log()
        assert ": ended" in bench.log()
        return Measured()

    return inject


def trips_in_the_middle(bench: Bench) -> Measured:
    """The board sleeps again while the output comes back: that is another recovery."""
    assert bench.board is not None
    board_sleeps(bench)
    await_return(bench)
    board_sleeps(bench)
    await_recovered(bench)
    assert bench.status()["recovery"]["left"] == 1, bench.status()["recovery"]
    bench.stop()
    assert recovery_steps(bench).count("begun") == 2
    return Measured()


def service_ends(bench: Bench) -> Measured:
    """SIGTERM while the readings are confirmed: the output does not move, the exit code is 0."""
    board_sleeps(bench)
    moved_ns = wait_for(lambda: bench.seen().last_v == 0.0 and bench.seen().moved_ns, "a safe output")
    assert bench.stop() == 0
    assert bench.seen().moved_ns == moved_ns, "the output moved"
    return Measured()


def another_configuration(bench: Bench) -> Measured:
    """The file is replaced and reloaded in the middle: the law is another, and the trip stays latched."""
    assert bench.board is not None
    process = bench.board
    bench.strike(lambda: process.send_signal(signal.SIGSTOP))
    bench.await_state("tripped", "stale")
    bench.config.write_text(bench.config.read_text().replace("position_um = 60.0", "position_um = 55.0"))
    bench.client.post("/reload")
    process.send_signal(signal.SIGCONT)
    stays_safe(bench)
    assert "changed" in bench.status()["recovery"]["reason"], bench.status()["recovery"]
    return Measured()


def card_flaps(bench: Bench) -> Measured:
    """The card's read fails again and again: three recoveries are begun, then the trip stays latched; never a drive."""
    bench.ask_for(plain_card.RAISE_IN_READ)
    for count in range(1, 5):
        wait_for(
            lambda count=count: bench.status().get("restarts", 0) >= count and bench.status().get("ticks"), "a loop"
        )
        bench.follow()
        bench.ask_for(plain_card.RAISE_IN_READ)
    bench.ask_for(plain_card.NONE)
    wait_for(lambda: bench.status().get("ticks"), "a loop")
    if not bench._follows_the_present_loop():
        bench.follow()
    stays_safe(bench)
    assert bench.status()["recovery"]["left"] == 0, bench.status()["recovery"]
    return Measured(note=f"{bench.status()['restarts']} loops, the service goes on")


READ, WRITE = card_fails(plain_card.RAISE_IN_READ), card_fails(plain_card.RAISE_IN_WRITE)
SINE = ("[recording]", "[service.depolarise]\namplitude_v = 0.8\nfrequency_hz = 10.0\ncycles = 5\n[recording]")
DEPOLARISED = ("begun", "confirmed", "depolarised", "returning", "recovered")
WITHOUT = ("[recording]", "[service]\n[recording]")
NEVER = (
    ("position", narrow("position_um", 10.0, "position"), ()),
    ("sensor_range", narrow("sensor_max_v", 1.0, "sensor_range"), ()),
    ("frozen", board_fault(board.FROZEN_INPUT), (("frozen_ticks = 2000", "frozen_ticks = 100"),)),
    ("tracking", board_fault(board.STUCK_OUTPUT), (("tracking_ticks = 2000", "tracking_ticks = 200"),)),
    ("loop SIGKILL", loop_dies, ()),
)


def _outside(name: str, strike: Strike, allowed: str, forbidden: str, *changes: tuple[str, str], **more) -> list[Fault]:  # type: ignore[no-untyped-def]
    """Rows of one outside cause: allowed, not allowed by the policy, and without a policy."""
    new_loop = more.pop("new_loop", False)
    return [
        Fault(f"recover: {name}, allowed", "confirmed, returns by ramp", recovers(strike, new_loop=new_loop),
              changes=(policy(allowed), *changes), **more),
        Fault(f"recover: {name}, not in causes", "stays tripped", stays(strike, new_loop),
              changes=(policy(forbidden), *changes), **more),
        Fault(f"recover: {name}, no policy", "stays tripped", stays(strike, new_loop), changes=(WITHOUT, *changes),
              **more),
    ]  # fmt: skip


FAULTS = (
    *_outside("stale", board_sleeps, "", 'causes = ["driver", "late", "heartbeat"]\n', SHORT_AGE),
    *_outside("late", loop_sleeps, "", 'causes = ["stale", "driver", "heartbeat"]\n', LATE),
    *_outside("heartbeat", service_sleeps, EVERY, "", new_loop=True),
    *_outside("driver read", READ, "", 'causes = ["stale", "late", "heartbeat"]\n', card=True, new_loop=True),
    *_outside("driver write", WRITE, "", 'causes = ["stale", "late", "heartbeat"]\n', card=True, new_loop=True),
    *(
        Fault(f"recover: {name}, every cause allowed", "stays tripped", stays(strike),
              changes=(policy(EVERY), *changes))
        for name, strike, changes in NEVER
    ),
    Fault("recover: oscillation, every cause allowed", "stays tripped", stays(oscillates),
          changes=(policy(EVERY), *SHIFTED), drives=False),
    Fault("recover: non_finite, every cause allowed", "stays tripped", stays(card_fails(plain_card.NAN)),
          changes=(policy(EVERY),), card=True),
    Fault("recover: enable, every cause allowed", "stays tripped", stays(enable_opens), changes=(policy(EVERY),),
          card=True),
    Fault("recover: law never ends, every cause allowed", "stays tripped", stays(law_hangs),
          changes=(policy(EVERY), *WITH_IT), around=beside_the_configuration),
    Fault("recover: stale, depolarises", "a sine, then returns by ramp", recovers(board_sleeps, *DEPOLARISED),
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
