"""Silence of the supervisor in scripted time: a dead, a stopped, a hanging and a starved one are told apart."""

from __future__ import annotations

import ctypes
import os
import time
from pathlib import Path

import numpy as np
import pytest

from rtloop.engine.loop import Outcome
from rtloop.engine.memory import SharedBlock, Sizes, Word
from rtloop.signals import Flag, Silence
from rtloop.supervision.heart import Heart
from tests.engine.harness import FOR_EVER, LoopBench, ScriptedClock
from tests.engine.test_failures import RAW

BEAT_S, PERIOD_S = 5.0, 0.01
"""Time of the last heartbeat; time between the ticks of the script. The timeout is 1 s."""


class SilentSupervisor:
    """Loop on scripted wakes (s), whose supervisor is silent since BEAT_S; `stat` is the text of its state in /proc."""

    def __init__(self, folder: Path, wakes_s: np.ndarray, stat: str, missed: np.ndarray | None = None) -> None:
        missed = np.zeros(len(wakes_s)) if missed is None else missed
        grid = np.zeros(len(wakes_s))
        self.bench = LoopBench(RAW, clock=ScriptedClock(np.column_stack([grid, grid, missed, wakes_s * 1e9])))
        self.bench.block.store(Word.HEARTBEAT_NS, round(BEAT_S * 1e9))
        self.wakes_s, self._file = wakes_s, folder / "stat"
        self.stat(stat)
        self.bench.assembly.loop.heart_fd = os.open(self._file, os.O_RDONLY)

    def stat(self, text: str) -> None:
        self._file.write_text(text)

    def run(self, ticks: int = FOR_EVER) -> np.ndarray:
        return self.bench.column(self.bench.run(ticks), "flags").astype(int)

    def lost_s(self) -> float:
        """Run to the end, and return the length of the silence at the trip."""
        flags = self.run()
        (lost,) = np.flatnonzero(np.diff(flags & Flag.TRIP_HEARTBEAT, prepend=0))
        assert self.bench.outcome is Outcome.HEARTBEAT_LOST
        return float(self.wakes_s[lost] - BEAT_S)

    def reason(self) -> str:
        (trip,) = self.bench.trips()
        return trip["what"]["reason"]


def wakes(until_s: float = 20.0) -> np.ndarray:
    return np.arange(BEAT_S, until_s, PERIOD_S)


def stat(letter: str, name: str = "rtloop") -> str:
    return f"4711 ({name}) {letter} 1 4711 4711 0 -1 4194560 100\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "died"),
        (stat("Z"), "died"),
        (stat("T"), "stopped by a signal"),
        (stat("t"), "stopped by a signal"),
        (stat("S"), "watch of the loop stood still"),
        (stat("D"), "watch of the loop stood still"),
        (stat("T", name="a (b) R"), "stopped by a signal"),
    ],
)
def test_a_supervisor_that_is_dead_stopped_or_hangs_is_lost_at_the_timeout(tmp_path: Path, text: str, words: str):
    loop = SilentSupervisor(tmp_path, wakes(), text)
    assert loop.lost_s() == pytest.approx(1.0, abs=1.5 * PERIOD_S)
    reason = loop.reason()
    assert reason.startswith("the heartbeat of `rtloop run` or of the service stopped for 1 s: that process ")
    assert words in reason


@pytest.mark.parametrize("name", ["rtloop", "a (b) T", ") T"])
def test_a_supervisor_without_a_processor_has_five_timeouts(tmp_path: Path, name: str):
    """The trip then names the host's stall with its length."""
    loop = SilentSupervisor(tmp_path, wakes(), stat("R", name))
    assert loop.lost_s() == pytest.approx(5.0, abs=0.03)  # it looks every 20 ms
    assert "for 5 s: the host stalled that process" in loop.reason()


def test_a_starved_supervisor_that_beats_again_trips_nothing(tmp_path: Path):
    loop = SilentSupervisor(tmp_path, wakes(), stat("R"))
    assert not np.any(loop.run(300) & Flag.HEARTBEAT_LOST)
    loop.bench.block.store(Word.HEARTBEAT_NS, round((BEAT_S + 3.0) * 1e9))
    loop.stat(stat("S"))
    assert not np.any(loop.run(90) & Flag.HEARTBEAT_LOST)


@pytest.mark.parametrize("text", ["", stat("T")])
def test_a_starved_supervisor_that_then_dies_is_lost_at_the_next_look(tmp_path: Path, text: str):
    loop = SilentSupervisor(tmp_path, wakes(), stat("R"))
    loop.run(250)
    loop.stat(text)
    flags = loop.run()
    assert np.flatnonzero(flags & Flag.HEARTBEAT_LOST)[0] <= 2


@pytest.mark.parametrize(("letter", "trips"), [("S", False), ("T", True)])
def test_a_stall_of_the_whole_host_is_no_silence_of_the_supervisor(tmp_path: Path, letter: str, trips: bool):
    """The loop runs first after a stall of 1.5 s; the supervisor, which still sleeps, beats 10 ms later."""
    times = np.concatenate([wakes(BEAT_S + 0.5), wakes(BEAT_S + 1.0) + 1.9])
    missed = np.where(np.diff(times, prepend=BEAT_S) > 1.0, 15_000.0, 0.0)
    loop = SilentSupervisor(tmp_path, times, stat(letter), missed)
    flags = loop.run(int(np.argmax(missed)) + 1)
    assert bool(np.any(flags & Flag.HEARTBEAT_LOST)) == trips
    loop.bench.block.store(Word.HEARTBEAT_NS, round(times[np.argmax(missed) + 1] * 1e9))
    assert bool(np.any(loop.run(40) & Flag.TRIP_HEARTBEAT)) == trips


def test_each_cause_is_recorded_by_its_number(tmp_path: Path):
    numbers = []
    for text in ("", stat("T"), stat("S"), stat("R")):
        loop = SilentSupervisor(tmp_path, wakes(), text)
        loop.run()
        ((*_, silent_s, timeout_s, bit, number),) = loop.bench.events(5)
        numbers.append(Silence(int(number)))
        assert (silent_s, timeout_s, bit) == (pytest.approx(5.02 if "R" in text else 1.01), 1.0, 0.0)
    assert numbers == [Silence.DEAD, Silence.STOPPED, Silence.UNWATCHED, Silence.STARVED]


@pytest.fixture
def block() -> SharedBlock:
    return SharedBlock.create(Sizes(columns=21, axes=1, rate_hz=1_000, snapshot_bytes=100, table_samples=1))


def beat_s(block: SharedBlock) -> float:
    return block.load(Word.HEARTBEAT_NS) / 1e9


def await_true(condition) -> None:
    while not condition():
        time.sleep(0.001)


def test_the_heart_beats_only_while_the_loop_is_watched(block: SharedBlock):
    heart = Heart(block, watch_timeout_s=0.1)
    try:
        await_true(lambda: time.monotonic() - beat_s(block) > 0.5)  # a thread that only slept late would beat again
        last_s = beat_s(block)
        heart.watch()
        await_true(lambda: beat_s(block) > last_s)
    finally:
        heart.end()
        heart.end()


def test_the_heart_beats_while_another_thread_holds_the_interpreter(block: SharedBlock):
    """A beat within the time of a call that holds the lock, which the C library's function does here."""
    hold, hold_s, heart = ctypes.PyDLL(None).usleep, 0.2, Heart(block)

    def beats_while_held() -> bool:
        begin_s = time.monotonic()
        hold(round(hold_s * 1e6))
        return begin_s < beat_s(block) < begin_s + hold_s

    try:
        await_true(beats_while_held)
    finally:
        heart.end()


def test_the_block_names_the_thread_that_beats(block: SharedBlock):
    heart = Heart(block)
    try:
        assert block.load(Word.SUPERVISOR_PID) == os.getpid()
        assert f"{block.load(Word.HEART_THREAD)}" in os.listdir("/proc/self/task")
    finally:
        heart.end()
