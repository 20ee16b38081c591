"""The recorder's process: what it writes is what the rings held, and whatever it lost it says."""

from __future__ import annotations

import numpy as np
from hand_made_loop import (
    HandMadeLoop,
    RecorderProcess,
    make_header,
    make_rows,
    snapshot,
)

from rtloop.recording.reader import Reader
from rtloop.signals import Mode


def test_records_everything_in_order(loop: HandMadeLoop, recorder: RecorderProcess, tmp_path):
    rows = make_rows(25_000, paced=False)
    recorder.start(tmp_path / "run.mcap", make_header(paced=False, ticks_expected=len(rows)))
    loop.command(0, Mode.CLOSED_LOOP)
    loop.run(rows, slack=20_000)
    loop.trip(24_000)
    loop.end()
    code, totals = recorder.result()
    assert (code, totals["complete"], totals["error"]) == (0, True, None)
    assert (totals["ticks_logged"], totals["ticks_lost"]) == (len(rows), 0)
    with Reader(tmp_path / "run.mcap") as reader:
        assert np.concatenate(list(reader.blocks())).tobytes() == rows.tobytes()
        assert [event["kind"] for event in reader.events] == ["set_mode", "tripped", "finished"]
        assert [s.data for s in reader.snapshots()] == [snapshot(k).tobytes() for k in (0, 10_000, 20_000)]
    assert not (tmp_path / "run.mcap.part").exists()
