"""Heartbeat of the supervisor: the compiled thread that beats, and the judgement of its silence in the loop.

The thread is compiled so that it holds no interpreter lock: other threads of the supervisor cannot delay it. Its state
in /proc then tells a supervisor that died or was stopped from one that is ready to run and gets no processor.
"""

from __future__ import annotations

import os

import numpy as np

from rtloop.engine.context import WORDS, control_words
from rtloop.engine.memory import SharedBlock, Word
from rtloop.foundation.native import uncompiled
from rtloop.foundation.native.atomics import load_acquire, store_release
from rtloop.foundation.native.compiled import c_library_function, cfunc, jit, jit_rare
from rtloop.foundation.native.monotonic import monotonic_ns, sleep_for
from rtloop.foundation.native.pointers import SIGNATURE, address_pointer, carray
from rtloop.signals import Silence

HEARTBEAT_WORD = int(Word.HEARTBEAT_NS)
PERIOD_NS = 20_000_000
LONGEST_STEP_NS = 2 * PERIOD_NS
"""Longest time between two beats that counts as time without a watch: a stall of the host is no fault of the watch."""
TIMESPEC, WATCHES, ENDED, WATCH_TIMEOUT_NS, WORDS_ADDRESS, HEART_WORDS = 0, 2, 3, 4, 5, 6
"""Words (uint64) of a heart: scratch memory of the clock (2), number of watches, whether to end, time without a watch
after which it stops beating, address of the block's control words; their count."""

LOOK_NS = 20_000_000.0
"""Time after which the loop looks again at a supervisor whose silence the host explains."""
LONGEST_STALL = 5.0
"""Multiple of `heartbeat_timeout_s` after which the loop parks, also where the host explains the silence."""
STAT_BYTES = 512
READY, STOPPED, TRACED, ZOMBIE, NAME_END = (ord(letter) for letter in "RTtZ)")


UNKNOWN, DEAD, HALTED, UNWATCHED, STARVED = (int(silence) for silence in Silence)


def _pread_in_python(fd: int, address: int, count: int, offset: int) -> int:
    """Read from an open file to an address, like the C library's `pread`; return the bytes read, -1 for an error."""
    try:
        data = os.pread(fd, count, offset)
    except OSError:
        return -1
    uncompiled.carray(address, len(data), np.uint8)[:] = np.frombuffer(data, np.uint8)
    return len(data)


_pread = c_library_function("pread", "intp(int32, intp, intp, intp)", _pread_in_python)


@cfunc(SIGNATURE)
def beat_until_ended(context, _):
    """Renew the heartbeat in the block's control words until ENDED is set; return 0.

    `context` has the words of a heart. No beat comes while WATCHES stood still for WATCH_TIMEOUT_NS of the time in
    which this thread ran.
    """
    heart = carray(context, HEART_WORDS, np.uint64)
    words = carray(address_pointer(heart[WORDS_ADDRESS]), WORDS, np.uint64)
    scratch = heart.ctypes.data
    watches, unwatched_ns, last_ns = load_acquire(heart, WATCHES), 0, monotonic_ns(scratch)
    while load_acquire(heart, ENDED) == 0:
        now_ns, newest = monotonic_ns(scratch), load_acquire(heart, WATCHES)
        unwatched_ns = unwatched_ns + min(now_ns - last_ns, LONGEST_STEP_NS) if newest == watches else 0
        watches, last_ns = newest, now_ns
        if unwatched_ns < np.int64(heart[WATCH_TIMEOUT_NS]):
            store_release(words, HEARTBEAT_WORD, np.uint64(now_ns))
        sleep_for(PERIOD_NS, scratch)
    return 0


def open_heart_state(block: SharedBlock) -> int:
    """Open the state in /proc of the thread that beats for `block`; return the descriptor, -1 if that is refused."""
    path = f"/proc/{block.load(Word.SUPERVISOR_PID)}/task/{block.load(Word.HEART_THREAD)}/stat"
    try:
        return os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return -1


@jit
def is_heartbeat_lost(loop, now_ns, late_ns):
    """Whether the supervisor is lost at `now_ns`, in ns of CLOCK_MONOTONIC; NaN, in virtual time, loses none.

    `late_ns` is the time by which the tick is late, its missed periods included. Stores a cause and the length of the
    silence in `loop.silence` and `loop.silence_s`.
    """
    silent_ns = now_ns - float(load_acquire(control_words(loop), HEARTBEAT_WORD))
    return silent_ns > loop.heartbeat_timeout_ns and _is_silence_final(loop, now_ns, silent_ns, late_ns)


@jit_rare
def _is_silence_final(loop, now_ns, silent_ns, late_ns):
    """Whether a heartbeat that is older than its timeout is lost; it is not while the host explains the silence.

    The host explains it while the beating thread is ready to run and gets no processor. It also does in a tick that is
    late itself, because a stall of the whole host may let the loop run first.
    """
    if loop.silence_s > 0.0:
        return True  # judged already; the ramp must not look again in each tick
    if now_ns < loop.next_look_ns:
        return False
    silence = _cause_of_silence(loop)
    is_explained = silence == STARVED or (silence == UNWATCHED and late_ns > LOOK_NS)
    if is_explained and silent_ns <= LONGEST_STALL * loop.heartbeat_timeout_ns:
        loop.next_look_ns = now_ns + LOOK_NS
        return False
    loop.silence, loop.silence_s = silence, silent_ns * 1e-9
    return True


@jit_rare
def _cause_of_silence(loop):
    """Return the Silence that the state of the beating thread means: R is ready to run, and so starved if it is silent.

    `loop.heart_fd` is its open file /proc/PID/task/TID/stat, -1 without one: "PID (NAME) STATE …", of which NAME may
    have blanks and brackets.
    """
    if loop.heart_fd < 0:
        return UNKNOWN
    text = carray(address_pointer(loop.heart_text), STAT_BYTES, np.uint8)
    position = _pread(loop.heart_fd, loop.heart_text, STAT_BYTES, 0) - 1
    while position >= 0 and text[position] != NAME_END:
        position -= 1
    if position < 0 or position + 2 >= STAT_BYTES or text[position + 2] == ZOMBIE:
        return DEAD
    state = text[position + 2]
    if state in (STOPPED, TRACED):
        return HALTED
    return STARVED if state == READY else UNWATCHED
