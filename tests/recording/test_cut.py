"""A stretch of a recording as one of its own: bit for bit what was recorded, and it replays by itself.

Against the public MCAP reader, which knows nothing of ticks, snapshots and gaps.
"""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from rtloop.cli import main
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.engine.commands import send
from rtloop.engine.messages import Kind, message
from rtloop.errors import OutputError
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.cutting.cut import cut
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Reader
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from tests.recording.hand_made_loop import make_rows, write_recording
from tests.recording.real_loop import ROOT, RealLoop, scheduled

TICKS, BURST = 16_000, 500
TEXT = scheduled().replace("rate_hz = 10000\n", 'rate_hz = 10000\nlaws = ["pid"]\n', 1)
PID = '[axis.controller]\nkind = "pid"\nki_per_s = 150.0\nkd_s = 1e-5\nfilter_s = 2e-4\n'
CONTROLLER = TEXT[TEXT.index("[axis.controller]") : TEXT.index("# Eq (5)")]
LAWS_AT = {4_000: ("gain = 0.016", "gain = 0.011"), 8_000: (CONTROLLER, PID), 14_500: ("gain = 0.016", "gain = 0.013")}
SNAPSHOTS = 1_700


def run(path: Path, **options: Any) -> list[Path]:
    """Modes, trips, references and laws that change while it runs; beside the file, what it was as it grew."""
    loop = RealLoop(TEXT)
    loop.take_snapshots_every(SNAPSHOTS)
    session = Session(loop.block, path, loop.header, Options(min_free_bytes=0, **options))
    while loop.tick < TICKS:
        if change := LAWS_AT.get(loop.tick):
            other = prepare(parse(TEXT.replace(*change), "test", ROOT / "deploy", "test"))
            staged = other.plan.coefficients.tobytes()
            loop.block["staged"][: len(staged)] = np.frombuffer(staged, np.uint8)
            send(loop.block, message(Kind.LOAD_LAW, axis=0, values=[1.0]))
        loop.run(BURST)
        while session.cursor < loop.tick:
            session.drain()
            if loop.tick % 3_000 == 0:
                session._write_all()
        if loop.tick == 12_000:
            for part in path.parent.glob("*.part"):
                shutil.copy(part, path.parent / f"growing-{part.name}")
    return [Path(name) for name in session.finish("finished")["paths"]]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = run(tmp_path_factory.mktemp("whole") / "run.mcap")[0]
    kinds = [event["kind"] for event in load(path).events]
    assert kinds.count("load_law") == 3
    assert {"set_mode", "tripped", "reset_trip", "set_reference"} <= set(kinds)
    return path


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return run(tmp_path_factory.mktemp("parts") / "run.mcap", rotate_s=0.3)


@pytest.fixture(scope="module")
def payloads(whole: Path) -> list[bytes]:
    """The message of each tick."""
    return [data for _, data in messages(whole, "/ticks")]


def messages(path: Path, topic: str) -> list[tuple[int, bytes]]:
    """(log time, payload) of each message of a topic, by the public reader."""
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages([topic], log_time_order=False)
        return [(one.log_time, one.data) for _, _, one in found]


def snapshots(path: Path) -> list[int]:
    """The ticks at which a state of the law was recorded."""
    return [int.from_bytes(data[32:40], "little") for _, data in messages(path, "/law")]


def identical(path: Path, ticks: int) -> bool:
    """Whether a cut replays as a whole, and accounts for each of its ticks."""
    report = replay(load(path))
    return report.identical and (report.ticks, report.gaps, report.problems) == (ticks, [], [])


def test_at_every_alignment_to_snapshots(whole: Path, payloads: list[bytes], tmp_path: Path):
    """It begins at the newest snapshot, holds the very messages, and replays: about each snapshot, and at random."""
    known, chance = snapshots(whole), random.Random(7)
    assert set(LAWS_AT) < set(known)
    begins = [tick + way for tick in known for way in (-1, 0, 1)]
    stretches = [(first, first + ticks) for first in begins for ticks in (1, 2) if 0 <= first <= TICKS - ticks]
    stretches += [tuple(sorted(chance.sample(range(TICKS + 1), 2))) for _ in range(12)] + [(0, TICKS)]
    for number, (first, end) in enumerate(stretches):
        out = tmp_path / f"{number}.mcap"
        report = cut(whole, first, end, out)
        begin = max(tick for tick in known if tick <= first)
        assert (report["begin"], report["ticks"], report["gaps"]) == (begin, end - begin, []), (first, end)
        assert (report["complete"], report["problems"]) == (True, [])
        assert [data for _, data in messages(out, "/ticks")] == payloads[begin:end]
        assert snapshots(out) == [tick for tick in known if begin <= tick < end]
        assert identical(out, end - begin), (first, end)
        out.unlink()


def test_times_events_and_header(whole: Path, tmp_path: Path):
    cut(whole, 3_500, 12_345, tmp_path / "cut.mcap")
    began, out = 3_400, load(tmp_path / "cut.mcap")
    for topic in ("/ticks", "/law", "/events"):
        assert set(messages(tmp_path / "cut.mcap", topic)[:-1]) <= set(messages(whole, topic))
    ours = [event for event in load(whole).events if began <= event["tick"] < 12_345]
    assert out.events[:-1] == ours
    assert out.events[-1]["kind"] == "cut"
    assert out.events[-1]["what"]["ticks_executed"] == 12_345
    assert out.header["cut"] == {"first": 3_500, "end": 12_345, "files": ["run.mcap"]}
    before = load(whole).header | {"first_tick": began, "ticks_expected": 12_345 - began, "cut": out.header["cut"]}
    assert out.header == before
    cut(tmp_path / "cut.mcap", 5_000, 6_000, tmp_path / "again.mcap")
    cut(whole, 5_000, 6_000, tmp_path / "once.mcap")
    assert load(tmp_path / "again.mcap").header["cut"]["files"] == ["cut.mcap"]
    assert messages(tmp_path / "again.mcap", "/ticks") == messages(tmp_path / "once.mcap", "/ticks")


@pytest.mark.parametrize(
    ("first", "end"), [(2_000, 9_000), (3_400, 3_401), (6_799, 6_801), (0, TICKS), (15_999, TICKS)]
)
def test_of_a_rotated_run(parts: list[Path], payloads: list[bytes], tmp_path: Path, first: int, end: int):
    assert len(parts) > 3
    for files in ([parts[i] for i in (2, 0, 3, 1, *range(4, len(parts)))], str(parts[0].parent / "run-*.mcap")):
        out = tmp_path / "cut.mcap"
        report = cut(files, first, end, out)
        assert [data for _, data in messages(out, "/ticks")] == payloads[report["begin"] : end]
        assert identical(out, end - report["begin"])
        held = [part.name for part in parts if {*range(report["begin"], end)} & {*load(part)["tick"].astype(int)}]
        assert ("sequence" in load(out).header, load(out).header["cut"]["files"]) == (False, held)
        out.unlink()


def test_of_a_file_that_grows(whole: Path, payloads: list[bytes], tmp_path: Path):
    """Of an unfinished file, whatever it ends with, to its last tick."""
    part = tmp_path / "run.mcap.part"
    data = (whole.parent / "growing-run.mcap.part").read_bytes()
    for missing in (0, 1, 5_000):
        part.write_bytes(data[: len(data) - missing])
        there = len(load(part))
        report = cut(part, there - 100, there)
        assert (report["complete"], report["problems"]) == (True, [])
        assert Path(report["output"]) == tmp_path / f"run.cut-{there - 100}.mcap"
        assert [data for _, data in messages(Path(report["output"]), "/ticks")] == payloads[report["begin"] : there]
        assert identical(Path(report["output"]), there - report["begin"])
        with pytest.raises(
            RecordingError, match=f"to before {there + 1}: not in the recording; ticks 0 to {there - 1} "
        ):
            cut(part, 0, there + 1)
        Path(report["output"]).unlink()


def test_what_is_none(whole: Path, tmp_path: Path):
    out = tmp_path / "out.mcap"
    for first, end, words in (
        (5, 5, "no range; allowed: an end after the beginning"),
        (7, 3, "no range"),
        (-1, 3, r"not in the recording; ticks 0 to 15999 are"),
        (TICKS, TICKS + 1, "not in the recording"),
    ):
        with pytest.raises(RecordingError, match=words):
            cut(whole, first, end, out)
    with pytest.raises(RecordingError, match=r"9 s: not in the recording; its last tick was due at 1\.5999 s"):
        cut(whole, from_s=9.0, output=out)
    assert list(tmp_path.iterdir()) == []
    out.write_bytes(b"mine")
    with pytest.raises(OutputError, match="exists already; a recording is never overwritten"):
        cut(whole, 0, 10, out)
    assert [one.read_bytes() for one in tmp_path.iterdir()] == [b"mine"]
    with pytest.raises(OutputError, match="No such file"):
        cut(whole, 0, 10, tmp_path / "nowhere" / "out.mcap")


def test_without_a_snapshot_before_it(whole: Path, parts: list[Path], tmp_path: Path):
    """The oldest parts were deleted, and one that a recorder began which took over in the middle is alone."""
    report = cut(parts[1:], 3_400, 5_000, tmp_path / "out.mcap")
    assert (report["complete"], report["problems"]) == (True, [])
    assert identical(tmp_path / "out.mcap", 1_600)
    missing, behind = (load(part)["tick"].astype(int).tolist() for part in parts[1:3])
    report = cut([parts[0], parts[2]], missing[0] - 5, behind[0] + 5, tmp_path / "hole.mcap")
    hole = len(missing)
    assert report["gaps"] == [(missing[0], hole)]
    assert report["problems"] == [f"{hole} of its ticks are not in the recording, and no gap says why"]
    rows = make_rows(3_000, first=500)
    path = write_recording(tmp_path / "late.mcap", rows, first_tick=500)
    with pytest.raises(RecordingError, match="ticks 500 to 3499 are"):
        cut(path, 499, 600)
    assert cut(path, 500, 600)["begin"] == 500


def test_lost_ticks_stay_lost_and_are_said(tmp_path: Path):
    """Ticks that the recorder never had, and ticks that it says nothing of."""
    loop = RealLoop(scheduled())
    loop.take_snapshots_every(SNAPSHOTS)
    session = Session(loop.block, tmp_path / "run.mcap", loop.header, Options(min_free_bytes=0))
    loop.run(3_000)
    session.drain()
    loop.run(150_000)
    while session.cursor < loop.tick:
        session.drain()
        session.write_due()
    lost = session.finish("finished")["ticks_lost"]
    assert lost > 1_000
    report = cut(tmp_path / "run.mcap", 2_000, 3_000 + lost + 5_000, tmp_path / "cut.mcap")
    assert report["gaps"] == [(3_000, lost)]
    assert (report["complete"], report["problems"]) == (False, [])
    assert report["ticks"] == 3_000 - 1_700 + 5_000
    played = replay(load(tmp_path / "cut.mcap"))
    assert played.gaps == [{"first_tick": 3_000, "count": lost}]
    assert played.first_difference is None
    inside = cut(tmp_path / "run.mcap", 3_500, 3_000 + lost + 5_000, tmp_path / "inside.mcap")
    assert inside["begin"] == 1_700
    behind = cut(tmp_path / "run.mcap", 150_000, 152_000, tmp_path / "behind.mcap")
    assert identical(tmp_path / "behind.mcap", behind["ticks"])


def test_damage_is_said(tmp_path: Path):
    path = write_recording(tmp_path / "run.mcap", make_rows(5_000))
    data = bytearray(path.read_bytes())
    with Reader(path) as reader:
        entry = reader.tick_chunks[2]
    data[entry.offset + entry.length // 2] ^= 1
    path.write_bytes(data)
    report = cut(path, 1_500, 3_500)
    assert (report["gaps"], report["complete"]) == ([(2_000, 1_000)], False)
    assert any("is damaged" in problem for problem in report["problems"])
    assert report["problems"][-1] == "1000 of its ticks are not in the recording, and no gap says why"
    assert cut(path, 3_500, 3_600)["complete"]


def test_the_command(whole: Path, tmp_path: Path):
    def rtloop(*arguments: object) -> Any:
        return CliRunner().invoke(main, ["cut", str(whole), *map(str, arguments)])

    done = rtloop("--from", 0.35, "--until", 0.5, "--out", tmp_path / "a.mcap")
    assert done.exit_code == 0
    assert "3500 to 4999, and what leads to them from tick 3400 on" in " ".join(done.output.split())
    done = rtloop("--from-tick", 3_500, "--until-tick", 5_000, "--out", tmp_path / "b.mcap", "--json")
    assert json.loads(done.stdout)["ticks"] == 1_600
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert rtloop("--from-tick", 5, "--out", tmp_path / "a.mcap").exit_code == 73
    assert rtloop("--from", 77, "--out", tmp_path / "c.mcap").exit_code == 66
    assert rtloop("--from", 1, "--from-tick", 5).exit_code == 2
    shown = CliRunner().invoke(main, ["info", str(tmp_path / "a.mcap"), "--json"])
    report = json.loads(shown.stdout)
    assert (report["complete"], report["ticks_logged"], report["ticks_lost"], report["cut"]["first"]) == (
        True,
        1_600,
        0,
        3_500,
    )
    assert CliRunner().invoke(main, ["replay", str(tmp_path / "a.mcap")]).exit_code == 0
