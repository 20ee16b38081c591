"""Compile all code that runs in real time, so that the first run starts as fast as every later one."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

MAX_CACHES = 8


def main() -> int:
    """Compile all code that runs in real time into the cache of this version and processor. Returns 0.

    Deletes quarantined files of the cache, and all but the newest MAX_CACHES caches. Prints the cache's folder on
    stderr.
    """
    from rtloop.engine.assembly import rehearse
    from rtloop.foundation.native import cache_files as stored
    from rtloop.foundation.native.cache import CACHE_FOLDER, CACHE_IS_PERSISTENT

    rehearse()
    _rehearse_other_processes()
    for path in stored.quarantined_files(CACHE_FOLDER):
        path.unlink(missing_ok=True)
    if CACHE_IS_PERSISTENT:
        caches = sorted(CACHE_FOLDER.parent.iterdir(), key=lambda folder: folder.stat().st_mtime, reverse=True)
        for folder in caches[MAX_CACHES:]:
            if folder != CACHE_FOLDER:
                shutil.rmtree(folder, ignore_errors=True)
    print(f"compiled into {CACHE_FOLDER}", file=sys.stderr)
    return 0


def _rehearse_other_processes() -> None:
    """Compile the functions that recorder, service, board and replay use besides the loop, mostly by calling them."""
    import numpy as np

    from rtloop.drivers.comedi import comedi_read, comedi_write
    from rtloop.drivers.node.exchange import node_read, node_write
    from rtloop.drivers.node.tags import write_tag_from_python
    from rtloop.drivers.playback import playback_read, playback_wait, playback_write
    from rtloop.drivers.shm import ShmOptions, shm_read, shm_write
    from rtloop.engine.commands import send, withdraw
    from rtloop.engine.memory import SharedBlock, Sizes
    from rtloop.engine.messages import MESSAGE, Kind, message
    from rtloop.engine.ring import drain
    from rtloop.hil.board import serve
    from rtloop.recording.capture.recorder import Recorder
    from rtloop.recording.file.topics.tick_kernels import RecordLayout, first_fault
    from rtloop.recording.replay.kernels import fill_tape, first_unequal
    from rtloop.signals import COMMON_SIGNALS

    playback = playback_read, playback_wait, playback_write
    node = node_read, node_write, write_tag_from_python
    for function in (comedi_read, comedi_write, *node, shm_read, shm_write, *playback):
        _ = function.address  # compiles it
    block = SharedBlock.create(Sizes(columns=1, axes=1, rate_hz=1.0, snapshot_bytes=8, table_samples=1))
    Recorder(block)
    drain(block.ring("events"), 0, np.zeros(1, MESSAGE))
    withdraw(block, send(block, message(Kind.STOP)))
    rows = np.zeros((1, len(COMMON_SIGNALS)))
    first_unequal(rows, rows)
    first_fault(np.zeros((2, 1)), np.zeros((2, 2)), np.zeros((2, 1), np.int64), 1)
    RecordLayout(np.zeros(8, np.uint8), np.zeros(8, np.bool_)).take_out(bytes(8), np.zeros(1, np.int64))
    fill_tape(rows, np.zeros((0, 2), np.int64), rows.copy(), np.zeros(1, np.bool_))
    with tempfile.TemporaryDirectory() as folder:
        serve(Path(folder) / "board", ShmOptions(), ["x"], 1000.0, lambda: True)


if __name__ == "__main__":
    sys.exit(main())
