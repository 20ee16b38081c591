"""Counts, indices, numbers and texts of a file are validated; the message names the invalid one."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.cli.run import recover_leftovers
from rtloop.hysteresis.play_model import MAX_PLAYS
from rtloop.kernel.layout import MAX_SECTIONS, MAX_TAPS
from rtloop.laws.shipped.transfer import MAX_ORDER
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics import format
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from rtloop.workbench.other_law import replay_on_the_rig
from tests.recording.forging import DEPTH, DIGEST_BYTES, Base, Chunk, first_chunk, pack_changed_snapshot, pack_file

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def pack_changed_event(base: Base, kind: str, change: Any) -> bytes:
    """Pack the file with the first event of a kind changed by the function `change`, or replaced by the bytes."""
    for i, j in base.messages(format.EVENTS):
        event = json.loads(base.chunks[i].messages[j].payload)
        if event["kind"] == kind:
            if not isinstance(change, bytes):
                change(event)
            return pack_file(
                base.replace_payload(i, j, change if isinstance(change, bytes) else json.dumps(event).encode())
            )
    raise AssertionError(kind)


def pack_changed_tick(base: Base, column: str, value: float) -> bytes:
    """Pack the file with one number of the fourth tick of the third chunk of ticks replaced."""
    i = [i for i, chunk in enumerate(base.chunks) if not chunk.channels][2]
    records = np.frombuffer(base.chunks[i].content, base.dtype).copy()
    records[column][3] = value
    return pack_file(base.replace_chunk(i, Chunk(records.tobytes())))


INDICES = [
    *[("x.tap_count", value, f"a multiple of 4 from 0 to {MAX_TAPS}") for value in (-1, 2, MAX_TAPS + 1, 2**40)],
    *[("x.section_count", value, f"0 to {MAX_SECTIONS}") for value in (-1, MAX_SECTIONS + 1)],
    *[("x.play_count", value, f"a multiple of 4 from 0 to {MAX_PLAYS}") for value in (3, 68, 255)],
    *[("x.order", value, f"a multiple of 8 from 0 to {MAX_ORDER}") for value in (4, 32, 255)],
    *[("x.row_start", value, f"0 to {MAX_ORDER}") for value in (25, 255)],
    *[("x.row_stop", value, f"0 to {MAX_ORDER}") for value in (25, 255)],
    ("x.coupled", 2, "0 to 1"),
    *[("x.tap_index", value, f"-1 to {MAX_TAPS - 1}") for value in (-2, MAX_TAPS, 10**6)],
    *[("x.entering", value, "0 to 2") for value in (-1, 3)],
    ("x.usable", 2, "0 to 1"),
    ("x.swing_direction", 2, "-1 to 1"),
    ("x.late_count", -1, "0 to "),
    ("x.frozen_ticks", -1, "0 to "),
    *[("loop.mode", value, "0 to 3") for value in (-1, 4)],
    ("loop.settled", -1, "0 to 1"),
    ("loop.trip", 1, "bits of "),
]


@pytest.mark.parametrize(("field", "value", "allowed"), INDICES)
def test_counts_and_indices_of_a_snapshot_are_refused(field: str, value: int, allowed: str, base: Base, path: Path):
    for which in (0, 2):
        path.write_bytes(pack_changed_snapshot(base, field, value, which))
        name = field.partition(".")[2]
        with pytest.raises(RecordingError, match=rf"run\.mcap: .*{name}.*: {value}; allowed: {allowed}"):
            replay(load(path))
    path.write_bytes(pack_changed_snapshot(base, field, value))
    with pytest.raises(RecordingError, match=field.partition(".")[2]):
        replay_on_the_rig([path], None)


def test_uncompiled_kernels_find_an_index_out_of_range_only_in_refused_snapshots(base: Base):
    """The uncompiled law uses numpy, which checks indices."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    i, j = base.messages(format.LAW)[1]
    snapshot = base.chunks[i].messages[j].payload[DIGEST_BYTES:]
    command = [sys.executable, "-m", "tests.recording.uncompiled_law"]
    result = subprocess.run(command, input=snapshot, cwd=ROOT, env=environment, capture_output=True)
    assert result.returncode == 0, result.stderr.decode()[-2_000:]
    counts = json.loads(result.stdout)
    assert min(counts["accepted"], counts["refused"]) > 100
    assert counts["accepted, out of range"] == 0
    assert counts["refused, out of range"] > 10


def set_detail(key: str, value: Any) -> Any:
    """Return a function that sets a field in the `what` of an event."""
    return lambda event: event["what"].update({key: value})


EVENTS = [
    ("set_mode", b"{", "not JSON"),
    ("set_mode", b"null", "object"),
    ("set_mode", b"\xff\xfe", "not JSON"),
    ("set_mode", b"[" * DEPTH, "not JSON"),
    ("set_mode", lambda event: event.update(tick=-1), "tick"),
    ("set_mode", lambda event: event.update(tick=10**400), "tick"),
    ("set_mode", lambda event: event.update(axis="y"), "axis.*'y'.*x"),
    ("set_mode", lambda event: event.update(who="[/red]"), "who"),
    ("finished", lambda event: event.update(who=""), "who"),
    ("set_mode", set_detail("values", [7.0, *[0.0] * 11]), "set_mode.*is 7; "),
    ("set_mode", set_detail("values", [3.0]), "values"),
    ("set_mode", set_detail("identity", None), "identity"),
    ("load_law", lambda event: event.update(axis=None), "axis"),
    ("load_law", set_detail("values", [2.0, *[0.0] * 11]), "2"),
    ("set_reference", set_detail("values", [6.0, *[0.0] * 11]), "6"),
    ("set_reference", set_detail("values", [1.0, -5.0, 10.0, 1.0, *[0.0] * 8]), "-5"),
    ("finished", set_detail("ticks_executed", "many"), "ticks_executed"),
    ("finished", lambda event: event.pop("what"), "what"),
]


@pytest.mark.parametrize(("kind", "change", "message"), EVENTS)
def test_malformed_events_are_problems_by_name(kind: str, change: Any, message: str, base: Base, path: Path):
    path.write_bytes(pack_changed_event(base, kind, change))
    for problems in (summarise(path).problems, load(path).problems, recover(path)["problems"]):
        assert any(re.search(f"event.*{message}", problem) for problem in problems)
    assert not replay(load(path)).identical


def test_a_leftover_that_cannot_be_read_does_not_stop_the_recovery_of_others(
    base: Base, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    valid = pack_file(base)
    (tmp_path / "a.mcap.part").write_bytes(pack_changed_event(base, "set_mode", b"{"))
    (tmp_path / "b.mcap.part").write_bytes(pack_file(base, first_chunk(b"{", base.header["columns"])))
    (tmp_path / "c.mcap.part").write_bytes(valid[: len(valid) * 2 // 3])
    recover_leftovers(tmp_path)
    messages = capsys.readouterr().err
    assert all((tmp_path / name).exists() for name in ("a.mcap", "c.mcap"))
    assert all(text in messages for text in ("event", f"warning: {tmp_path / 'b.mcap.part'}: "))


HEADERS = [
    ("format", "1", "format"),
    ("format", True, "format"),
    ("rate_hz", -0.0, "rate_hz"),
    ("rate_hz", float("inf"), "not JSON"),
    ("axes", [], "axes"),
    ("axes", ["x", "x"], "axes"),
    ("axes", ["y"], "axes"),
    ("observed", "none", "observed"),
    ("observed", ["x_true_position_um"], "observed"),
    ("created_unix_ns", 2**63, "created_unix_ns"),
    ("law", None, "law"),
    ("law", {"laws": ["file"]}, r"law\.laws"),
    ("driver", None, "driver"),
    ("driver", {"kind": ["sim"]}, r"driver\.kind"),
    ("configuration", 5, "configuration"),
    ("sequence", -1, "sequence"),
    ("first_tick", 0.5, "first_tick"),
    ("name", "$x^$\0", "name"),
]


@pytest.mark.parametrize(("key", "value", "message"), HEADERS)
def test_malformed_headers_are_refused_by_name(key: str, value: Any, message: str, base: Base, path: Path):
    header = {**base.header, key: value}
    path.write_bytes(pack_file(base, first_chunk(header, base.header["columns"])))
    with pytest.raises(RecordingError, match=rf"run\.mcap: .*{message}") as caught:
        replay(load(path))
    assert "\n" not in str(caught.value)


def test_a_recording_of_an_older_version_is_refused_by_the_name_of_that_version(base: Base, path: Path):
    """The recordings of version 0.1.0 have no column x_feed_um."""
    columns = [name for name in base.header["columns"] if name != "x_feed_um"]
    header = {**base.header, "columns": columns, "versions": {"rtloop": "0.1.0"}}
    path.write_bytes(pack_file(base, first_chunk(header, columns)))
    for use in (load, recover, summarise):
        with pytest.raises(RecordingError, match=r"made by rtloop 0\.1\.0; read it with that version"):
            use(path)


@pytest.mark.parametrize(
    ("column", "value"),
    [("tick", np.nan), ("tick", -1.0), ("tick", 3.5), ("deadline_ns", np.inf), ("deadline_ns", 1e19), ("flags", np.nan),
     ("flags", 0.5), ("mode", 4.0), ("mode", np.inf), ("periods_missed", -1.0), ("driver_status", 1e10)],
)  # fmt: skip
def test_invalid_ticks_are_left_out_and_named(column: str, value: float, base: Base, path: Path):
    path.write_bytes(pack_changed_tick(base, column, value))
    summary = summarise(path)
    assert (summary.ticks_logged, summary.complete) == (500, False)
    assert any(column in problem for problem in summary.problems)
    assert not replay(load(path)).identical
