"""Faults of the hardware: the board, a card behind a driver in plain Python, the plant."""

from __future__ import annotations

import signal

from rtloop.hil import board
from rtloop.hil.board import LSB_V
from tests.faults import plain_card
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.faults.fault import Fault, Outcome
from tests.faults.processes import STOPPED_SAFE_MS

FROZEN_MS, AT_ONCE_MS = 250.0, 60.0
"""Bounds in ms from the fault to 0 V on a host that does not stall."""


def board_killed(bench: Bench) -> Outcome:
    """Kill the board: the loop trips and writes 0 V; it runs again on a new board."""
    assert bench.board is not None
    process = bench.board
    bench.strike(process.kill)
    process.wait()
    bench.await_state("tripped", "stale")
    wait_for(lambda: bench.memory.dac_codes[0] == 0, "a code of 0 V")
    bench.store_record()
    bench.start_board()
    bench.recover()
    return Outcome(note="code at 0 V; the dead board has no output")


def board_paused(bench: Bench) -> Outcome:
    """Stop the board until the loop has tripped and written 0 V, then let it run again."""
    assert bench.board is not None
    process = bench.board
    bench.strike(lambda: process.send_signal(signal.SIGSTOP))
    bench.await_state("tripped", "stale")
    wait_for(lambda: bench.memory.dac_codes[0] == 0, "a code of 0 V")
    process.send_signal(signal.SIGCONT)
    wait_for(lambda: bench.output_record().last_v == 0.0, "a safe output")
    bench.recover()
    return Outcome(note="code at 0 V while the board was stopped")


def input_frozen(bench: Bench) -> Outcome:
    """Freeze the board's input: the loop trips and ramps to 0 V."""
    bench.strike(lambda: bench.cause_fault(board.FROZEN_INPUT))
    took_ms = bench.await_safe(FROZEN_MS)
    trips = bench.await_state("tripped")["trip"]
    assert {"frozen", "stale"} & set(trips), trips
    bench.cause_fault(board.NO_FAULT)
    bench.recover()
    return Outcome(took_ms, note=trips[0])


def output_stuck(bench: Bench) -> Outcome:
    """Make the output ignore its codes: the loop trips and writes 0 V, which the output takes once it is free."""
    bench.strike(lambda: bench.cause_fault(board.STUCK_OUTPUT))
    bench.await_state("tripped", "tracking")
    wait_for(lambda: abs(int(bench.memory.dac_codes[0])) * LSB_V == 0.0, "a code of 0 V")
    bench.store_record()
    bench.cause_fault(board.NO_FAULT)
    wait_for(lambda: bench.output_record().last_v == 0.0, "a safe output")
    bench.recover()
    return Outcome(note="code at 0 V")


def card_fault(fault: int, safe_ms: float, *causes: str, new_loop: bool):
    """Return a fault of the card that must trip the loop; with `new_loop` the loop's process must be replaced too."""

    def inject(bench: Bench) -> Outcome:
        bench.strike(lambda: bench.cause_fault(fault))
        took_ms = bench.await_safe(safe_ms)
        if new_loop:
            bench.cause_fault(plain_card.NONE)
            bench.await_restart()
        bench.await_state("tripped", *causes)
        bench.cause_fault(plain_card.NONE)
        bench.recover()
        return Outcome(took_ms)

    return inject


def blocks_once(bench: Bench) -> Outcome:
    """Make one read of the card take 50 ms: the loop runs on and counts the missed periods."""
    ticks = bench.ticks
    bench.strike(lambda: bench.cause_fault(plain_card.BLOCK_50_MS))
    wait_for(lambda: bench.ticks > ticks + 2000, "another second")
    report = bench.status()
    assert report["state"] == "running", report
    assert report["periods_missed"] >= 90, report
    return Outcome(note=f"{report['periods_missed']} periods missed")


def unstable(bench: Bench) -> Outcome:
    """Run on a rig whose resonance lies 5 % above the model's: the unstable loop trips before 45 µm."""
    report = bench.await_state("tripped", "oscillation")
    wait_for(lambda: bench.output_record().last_v == 0.0, "a safe output")
    largest_um = float(bench.memory.evidence[0]["largest_position_um"])
    assert largest_um < 45.0, largest_um
    return Outcome(note=f"|x| ≤ {largest_um:.1f} µm; {', '.join(report['trip'])}")


SHIFTED = (
    ("[driver.plant.sensor]", "[driver.plant.dynamics]\nresonance_shift = 0.05\n[driver.plant.sensor]"),
    ("[loop]\nrate_hz = 4000", "[loop]\nrate_hz = 10000"),
    ("board_rate_hz = 8000", "board_rate_hz = 10000"),
    ("\nslew_v_per_s = 500.0", "\nslew_v_per_s = 2500.0"),
    ("trip_slew_v_per_s = 500.0", "trip_slew_v_per_s = 2500.0"),
    ('"sine"\namplitude = 8.0\noffset = 20.0\nfrequency_hz = 5.0', '"steps"\nlevels = [0.0, 20.0]\ndwell_s = 1.0'),
)
"""Changes of the configuration: a shifted resonance, 10 kHz, steps of 20 µm. A tick may change the drive by 0.25 V, as
on the card."""
FAULTS = (
    Fault("board SIGKILL", "trip: stale; runs again on another board", board_killed),
    Fault("board SIGSTOP", "trip: stale; code to 0 V", board_paused),
    Fault("input frozen", "trip: frozen or stale", input_frozen,
          changes=(("frozen_ticks = 2000", "frozen_ticks = 100"),)),
    Fault("output stuck", "trip: tracking; code to 0 V", output_stuck,
          changes=(("tracking_ticks = 2000", "tracking_ticks = 200"),)),
    Fault("input NaN", "held, then trip: non_finite",
          card_fault(plain_card.NAN, AT_ONCE_MS, "non_finite", new_loop=False), card=True),
    Fault("driver raises in read", "trip, ramp, another loop",
          card_fault(plain_card.RAISE_IN_READ, AT_ONCE_MS, new_loop=True), card=True),
    Fault("driver raises in write", "trip, ramp by further writes, another loop",
          card_fault(plain_card.RAISE_IN_WRITE, AT_ONCE_MS, new_loop=True), card=True),
    Fault("driver blocks 50 ms", "runs on; missed periods are counted", blocks_once,
          changes=(("[recording]", "[service]\nstall_ms = 200.0\n[recording]"),), card=True),
    Fault("driver blocks for good", "loop killed, parked, another loop",
          card_fault(plain_card.BLOCK, STOPPED_SAFE_MS, new_loop=True), card=True),
    Fault("enable input opens", "trip: enable",
          card_fault(plain_card.ENABLE_OPEN, AT_ONCE_MS, "enable", new_loop=False), card=True),
    Fault("unstable loop (resonance +5 %)", "trip: oscillation, |x| < 45 µm", unstable, changes=SHIFTED, drives=False),
)  # fmt: skip
