"""Are all ticks of a bench's runs accounted for, and do they replay?"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import rtloop
from rtloop.engine.assembly import SNAPSHOT_SECONDS
from rtloop.engine.memory import SharedBlock
from rtloop.recording.file.reader import Reader
from rtloop.recording.replay.laws import TrustedLaws
from rtloop.recording.replay.replay import replay
from rtloop.recording.replay.verdict import ReplayReport
from rtloop.recording.views.summary import summarise


class Account(NamedTuple):
    """Ticks executed and lost over all runs; `problems` says what does not add up."""

    executed: int
    lost: int
    periods_missed: int
    problems: list[str]


def runs_in(folder: Path) -> list[list[Path]]:
    """Files of each run, the oldest first."""
    runs: dict[int, list[Path]] = defaultdict(list)
    for path in folder.glob("*.mcap"):
        with Reader(path, tolerant=True) as reader:
            runs[reader.header["created_unix_ns"]].append(path)
    return [sorted(paths) for _, paths in sorted(runs.items())]


def unexplained(verdict: ReplayReport, rate_hz: float, ended: bool = True) -> list[str]:
    """What a gap does not explain: behind one, nothing can be compared before the next snapshot."""
    snapshot_ticks = SNAPSHOT_SECONDS * rate_hz
    found = [*verdict.problems, *([f"first difference {first}"] if (first := verdict.first_difference) else [])]
    behind_gaps = {gap["first_tick"] + gap["count"] for gap in verdict.gaps}
    for entry in verdict.not_verified:
        behind_a_gap = entry["first_tick"] in behind_gaps and (entry["count"] or snapshot_ticks) < snapshot_ticks
        if not behind_a_gap and (ended or "has no recorded end" not in entry["why"]):
            found.append(f"not verified: {entry}")
    return found


def account(folder: Path, blocks: list[SharedBlock]) -> Account:
    """Judge the recordings in `folder` against what the loops themselves say that they executed, in `blocks`."""
    executed = lost = missed = 0
    problems = [f"{path.name}: left behind" for path in folder.glob("*.part")]
    runs = runs_in(folder)
    if len(runs) < len(blocks):
        problems.append(f"{len(blocks)} loops ran, {len(runs)} are recorded")
    for number, paths in enumerate(runs):
        summary, recording = summarise(paths), rtloop.load(paths)
        there, stated = len(recording), summary.ticks_lost
        total = there + stated
        if number < len(blocks) and len(runs) == len(blocks) and total != int(blocks[number]["ticks_head"][0]):
            problems.append(f"{paths[0].name}: {total} ticks accounted, {blocks[number]['ticks_head'][0]} executed")
        verdict = replay(recording, trust=TrustedLaws(recorded=True))  # a law of one's own is this suite's
        left = unexplained(verdict, recording.header["rate_hz"])
        problems += [f"{paths[0].name}: replay: {problem}" for problem in left]
        if sum(gap["count"] for gap in verdict.gaps) > stated:
            problems.append(f"{paths[0].name}: {verdict.gaps} missing, {stated} stated")
        executed, lost, missed = executed + total, lost + stated, missed + summary.periods_missed
    return Account(executed, lost, missed, problems)
