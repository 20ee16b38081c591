"""A range cut out of a recording: bit for bit the recorded data, and it replays alone.

The public MCAP reader, which knows no ticks, snapshots and gaps, reads both files for the comparison.
"""

from __future__ import annotations

import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.engine.commands import send
from rtloop.engine.messages import Kind, message
from rtloop.errors import OutputError
from rtloop.recording.cutting.cut import cut
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Reader
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from tests.command_line import answer
from tests.command_line import run as command
from tests.recording.hand_made_loop import make_rows, write_recording
from tests.recording.real_loop import ROOT, RecordedRun, eventful_configuration
from tests.recording.tamper import flip_byte

TICKS, BURST = 16_000, 500
TEXT = eventful_configuration().replace("rate_hz = 10000\n", 'rate_hz = 10000\nlaws = ["pid"]\n', 1)
PID = '[axis.controller]\nkind = "pid"\nki_per_s = 150.0\nkd_s = 1e-5\nfilter_s = 2e-4\n'
CONTROLLER = TEXT[TEXT.index("[axis.controller]") : TEXT.index("# Eq (5)")]
LAWS_AT = {4_000: ("gain = 0.016", "gain = 0.011"), 8_000: (CONTROLLER, PID), 14_500: ("gain = 0.016", "gain = 0.013")}
SNAPSHOT_TICKS = 1_700


def record_run(path: Path, **options: Any) -> list[Path]:
    """Record modes, trips, references and new laws; copy the unfinished file at tick 12,000. Returns the files."""
    recorded = RecordedRun(path, TEXT, paced=False, **options)
    loop, session = recorded.loop, recorded.session
    loop.take_snapshots_every(SNAPSHOT_TICKS)
    while loop.tick < TICKS:
        if change := LAWS_AT.get(loop.tick):
            changed = prepare(parse(TEXT.replace(*change), "test", ROOT / "deploy", "test"))
            staged = changed.plan.coefficients.tobytes()
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
    return [Path(name) for name in recorded.end()["paths"]]


@pytest.fixture(scope="module")
def run_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the run in one file."""
    path = record_run(tmp_path_factory.mktemp("whole") / "run.mcap")[0]
    kinds = [event["kind"] for event in load(path).events]
    assert kinds.count("load_law") == 3
    assert {"set_mode", "tripped", "reset_trip", "set_reference"} <= set(kinds)
    return path


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Files of the same run, rotated every 0.3 s."""
    return record_run(tmp_path_factory.mktemp("parts") / "run.mcap", rotate_s=0.3)


def topic_messages(path: Path, topic: str) -> list[tuple[int, bytes]]:
    """Return (log time, payload) of each message of a topic, by the public reader."""
    with path.open("rb") as file:
        rows = make_reader(file, validate_crcs=True).iter_messages([topic], log_time_order=False)
        return [(row.log_time, row.data) for _, _, row in rows]


def tick_payloads(path: Path) -> list[bytes]:
    return [data for _, data in topic_messages(path, "/ticks")]


@pytest.fixture(scope="module")
def payloads(run_path: Path) -> list[bytes]:
    """The payload of each tick's message."""
    return tick_payloads(run_path)


def snapshot_ticks(path: Path) -> list[int]:
    """Return the ticks of the recorded snapshots."""
    return [int.from_bytes(data[32:40], "little") for _, data in topic_messages(path, "/law")]


def is_identical(path: Path, ticks: int) -> bool:
    """Return whether a cut replays identically, with `ticks` ticks and no gap or problem."""
    report = replay(load(path))
    return report.identical and (report.ticks, report.gaps, report.problems) == (ticks, [], [])


def test_a_cut_begins_at_the_newest_snapshot_and_replays(run_path: Path, payloads: list[bytes], tmp_path: Path):
    """The ranges begin at and around each snapshot, and at random ticks."""
    snapshots, random_numbers = snapshot_ticks(run_path), random.Random(7)
    assert set(LAWS_AT) < set(snapshots)
    begins = [tick + offset for tick in snapshots for offset in (-1, 0, 1)]
    ranges = [(first, first + ticks) for first in begins for ticks in (1, 2) if 0 <= first <= TICKS - ticks]
    ranges += [tuple(sorted(random_numbers.sample(range(TICKS + 1), 2))) for _ in range(12)] + [(0, TICKS)]
    for number, (first, end) in enumerate(ranges):
        out = tmp_path / f"{number}.mcap"
        report = cut(run_path, first, end, out)
        begin = max(tick for tick in snapshots if tick <= first)
        assert (report["begin"], report["ticks"], report["gaps"]) == (begin, end - begin, []), (first, end)
        assert (report["complete"], report["problems"]) == (True, [])
        assert tick_payloads(out) == payloads[begin:end]
        assert snapshot_ticks(out) == [tick for tick in snapshots if begin <= tick < end]
        assert is_identical(out, end - begin), (first, end)
        out.unlink()


def test_a_cut_has_the_recorded_times_events_and_header(run_path: Path, tmp_path: Path):
    first_cut, second_cut, direct_cut = (tmp_path / f"{name}.mcap" for name in ("cut", "again", "once"))
    cut(run_path, 3_500, 12_345, first_cut)
    begin, copy, original = 3_400, load(first_cut), load(run_path)
    for topic in ("/ticks", "/law", "/events"):
        assert set(topic_messages(first_cut, topic)[:-1]) <= set(topic_messages(run_path, topic))
    *events, last = copy.events
    assert events == [event for event in original.events if begin <= event["tick"] < 12_345]
    assert (last["kind"], last["what"]["ticks_executed"]) == ("cut", 12_345)
    origin = {"first": 3_500, "end": 12_345, "files": ["run.mcap"]}
    assert copy.header == original.header | {"first_tick": begin, "ticks_expected": 12_345 - begin, "cut": origin}
    cut(first_cut, 5_000, 6_000, second_cut)
    cut(run_path, 5_000, 6_000, direct_cut)
    assert load(second_cut).header["cut"]["files"] == ["cut.mcap"]
    assert topic_messages(second_cut, "/ticks") == topic_messages(direct_cut, "/ticks")


@pytest.mark.parametrize(
    ("first", "end"), [(2_000, 9_000), (3_400, 3_401), (6_799, 6_801), (0, TICKS), (15_999, TICKS)]
)
def test_a_rotated_run_is_cut_across_its_files(
    parts: list[Path], payloads: list[bytes], tmp_path: Path, first: int, end: int
):
    assert len(parts) > 3
    for files in ([parts[i] for i in (2, 0, 3, 1, *range(4, len(parts)))], str(parts[0].parent / "run-*.mcap")):
        out = tmp_path / "cut.mcap"
        begin = cut(files, first, end, out)["begin"]
        assert (tick_payloads(out), is_identical(out, end - begin)) == (payloads[begin:end], True)
        names = [part.name for part in parts if {*range(begin, end)} & {*load(part)["tick"].astype(int)}]
        assert ("sequence" in load(out).header, load(out).header["cut"]["files"]) == (False, names)
        out.unlink()


@pytest.mark.parametrize("missing", [0, 1, 5_000])
def test_an_unfinished_file_is_cut_up_to_its_last_tick(
    run_path: Path, payloads: list[bytes], tmp_path: Path, missing: int
):
    part = tmp_path / "run.mcap.part"
    data = (run_path.parent / "growing-run.mcap.part").read_bytes()
    part.write_bytes(data[: len(data) - missing])
    end = len(load(part))
    report = cut(part, end - 100, end)
    output, begin = Path(report["output"]), report["begin"]
    assert (report["complete"], report["problems"], output) == (True, [], tmp_path / f"run.cut-{end - 100}.mcap")
    assert (tick_payloads(output), is_identical(output, end - begin)) == (payloads[begin:end], True)
    with pytest.raises(
        RecordingError, match=f"to before {end + 1} are not in the recording; allowed: ticks 0 to {end - 1}$"
    ):
        cut(part, 0, end + 1)


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"first": 5, "end": 5}, "empty range; allowed: an end after the beginning"),
        ({"first": 7, "end": 3}, "empty range"),
        ({"first": -1, "end": 3}, r"not in the recording; allowed: ticks 0 to 15999"),
        ({"first": TICKS, "end": TICKS + 1}, "not in the recording"),
        ({"from_s": 9.0}, r"9 s is not in the recording; the last tick was due at 1\.5999 s"),
    ],
)
def test_a_range_that_is_not_in_the_recording_is_refused(
    run_path: Path, tmp_path: Path, limits: dict[str, Any], words: str
):
    with pytest.raises(RecordingError, match=words):
        cut(run_path, **limits, output=tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_cut_overwrites_no_file(run_path: Path, tmp_path: Path):
    out = tmp_path / "out.mcap"
    out.write_bytes(b"mine")
    with pytest.raises(OutputError, match="exists already; a recording is never overwritten"):
        cut(run_path, 0, 10, out)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"mine"]
    with pytest.raises(OutputError, match="No such file"):
        cut(run_path, 0, 10, tmp_path / "absent" / "out.mcap")


def test_a_run_without_its_oldest_files_is_cut(parts: list[Path], tmp_path: Path):
    report = cut(parts[1:], 3_400, 5_000, tmp_path / "out.mcap")
    assert (report["complete"], report["problems"]) == (True, [])
    assert is_identical(tmp_path / "out.mcap", 1_600)
    lost, following = (load(part)["tick"].astype(int).tolist() for part in parts[1:3])
    report = cut([parts[0], parts[2]], lost[0] - 5, following[0] + 5, tmp_path / "hole.mcap")
    problem = f"{len(lost)} recorded ticks are missing: they are damaged, or in a file of the run that was not given"
    assert (report["gaps"], report["problems"]) == ([(lost[0], len(lost))], [problem])
    path = write_recording(tmp_path / "late.mcap", make_rows(3_000, first=500), first_tick=500)
    with pytest.raises(RecordingError, match="not in the recording; allowed: ticks 500 to 3499"):
        cut(path, 499, 600)
    assert cut(path, 500, 600)["begin"] == 500


def test_ticks_that_the_recorder_lost_are_a_gap_of_the_cut(tmp_path: Path):
    path, outputs = tmp_path / "run.mcap", [tmp_path / f"{name}.mcap" for name in ("cut", "inside", "after")]
    recorded = RecordedRun(path, paced=False)
    recorded.loop.take_snapshots_every(SNAPSHOT_TICKS)
    recorded.loop.run(3_000)
    recorded.session.drain()
    recorded.loop.run(150_000)
    recorded.drain()
    lost = recorded.end()["ticks_lost"]
    assert lost > 1_000
    end = 3_000 + lost + 5_000
    report = cut(path, 2_000, end, outputs[0])
    assert (report["gaps"], report["complete"], report["problems"]) == ([(3_000, lost)], False, [])
    assert report["ticks"] == 3_000 - 1_700 + 5_000
    replayed = replay(load(outputs[0]))
    assert (replayed.gaps, replayed.first_difference) == ([{"first_tick": 3_000, "count": lost}], None)
    assert cut(path, 3_500, end, outputs[1])["begin"] == 1_700
    assert is_identical(outputs[2], cut(path, 150_000, 152_000, outputs[2])["ticks"])


def test_damaged_ticks_are_a_gap_and_named(tmp_path: Path):
    path = write_recording(tmp_path / "run.mcap", make_rows(5_000))
    with Reader(path) as reader:
        entry = reader.tick_chunks[2]
    flip_byte(path, entry.offset + entry.length // 2)
    report = cut(path, 1_500, 3_500)
    assert (report["gaps"], report["complete"]) == ([(2_000, 1_000)], False)
    assert any("is damaged" in problem for problem in report["problems"])
    assert (
        report["problems"][-1]
        == "1000 recorded ticks are missing: they are damaged, or in a file of the run that was not given"
    )
    assert cut(path, 3_500, 3_600)["complete"]


def test_the_command_cuts_by_time_and_by_tick(run_path: Path, tmp_path: Path):
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    result = command("cut", run_path, "--from", 0.35, "--until", 0.5, "--out", first)
    assert result.exit_code == 0
    assert "3500 to 4999, preceded by ticks 3400 to 3499" in " ".join(result.output.split())
    assert answer("cut", run_path, "--from-tick", 3_500, "--until-tick", 5_000, "--out", second)["ticks"] == 1_600
    assert first.read_bytes() == second.read_bytes()
    for code, arguments in (
        (73, ("--from-tick", 5, "--out", first)),
        (66, ("--from", 77, "--out", tmp_path / "c.mcap")),
        (2, ("--from", 1, "--from-tick", 5)),
    ):
        assert command("cut", run_path, *arguments).exit_code == code
    report = answer("info", first)
    figures = (report["complete"], report["ticks_logged"], report["ticks_lost"], report["cut"]["first"])
    assert figures == (True, 1_600, 0, 3_500)
    assert command("replay", first).exit_code == 0
