"""The supervisor's heart: a thread that renews the heartbeat for the loop while the loop is watched."""

from __future__ import annotations

import atexit
import os
import threading
from collections.abc import Callable

import numpy as np

from rtloop.engine.heartbeat import ENDED, HEART_WORDS, WATCH_TIMEOUT_NS, WATCHES, WORDS_ADDRESS, beat_until_ended
from rtloop.engine.memory import SharedBlock, Word
from rtloop.foundation.native.compiled import unlocked_call

WATCH_TIMEOUT_S = 2.0
"""The heartbeat continues while the last watch is not older than this."""


class Heart:
    """Heartbeat of the supervisor on `block`, from the start until `end`, while `watch` is called often enough."""

    def __init__(self, block: SharedBlock, watch_timeout_s: float = WATCH_TIMEOUT_S) -> None:
        """Start the thread, and write its number and this process's to the block.

        No beat comes while `watch` was not called for `watch_timeout_s`.
        """
        self._words = np.zeros(HEART_WORDS, np.uint64)
        self._words[WATCH_TIMEOUT_NS] = round(watch_timeout_s * 1e9)
        self._words[WORDS_ADDRESS] = block["words"].ctypes.data
        self._thread = threading.Thread(
            target=_beat, args=(unlocked_call(beat_until_ended), self._words, block), daemon=True
        )
        self._thread.start()
        block.store(Word.SUPERVISOR_PID, os.getpid())
        block.store(Word.HEART_THREAD, self._thread.native_id or 0)
        atexit.register(self.end)  # The thread runs without the interpreter, which may free its memory at the exit.

    def watch(self) -> None:
        """Let the heartbeat go on for the time without a watch."""
        self._words[WATCHES] += np.uint64(1)

    def end(self) -> None:
        """Let the thread end, and wait for its end; a second call has no effect."""
        self._words[ENDED] = 1
        self._thread.join()
        atexit.unregister(self.end)


def _beat(beat: Callable[[int, int], int], words: np.ndarray, _: SharedBlock) -> None:
    """Run the compiled thread; its arguments keep the memory that it uses."""
    beat(words.ctypes.data, 0)
