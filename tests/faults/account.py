"""Account of the ticks of a bench's runs: each is recorded or stated as lost, and the recordings replay."""

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
    """Ticks executed and lost in all runs. `problems` lists every figure that contradicts another."""

    executed: int
    lost: int
    periods_missed: int
    problems: list[str]


def runs_in(folder: Path) -> list[list[Path]]:
    """Return the recordings in `folder` as a list of files for each run, the oldest run first."""
    runs: dict[int, list[Path]] = defaultdict(list)
    for path in folder.glob("*.mcap"):
        with Reader(path, tolerant=True) as reader:
            runs[reader.header["created_unix_ns"]].append(path)
    return [sorted(paths) for _, paths in sorted(runs.items())]


def unexplained(verdict: ReplayReport, rate_hz: float, ended: bool = True) -> list[str]:
    """Return the problems of a replay that a gap does not explain.

    Ticks between a gap and the next snapshot cannot be compared: not verifying them is no problem. With `ended` False
    the run may also lack a recorded end.
    """
    snapshot_ticks = SNAPSHOT_SECONDS * rate_hz
    first = verdict.first_difference
    problems = [*verdict.problems, *([f"first difference {first}"] if first else [])]
    behind_gaps = {gap["first_tick"] + gap["count"] for gap in verdict.gaps}
    for entry in verdict.not_verified:
        behind_a_gap = entry["first_tick"] in behind_gaps and (entry["count"] or snapshot_ticks) < snapshot_ticks
        if not behind_a_gap and (ended or "has no recorded end" not in entry["why"]):
            problems.append(f"not verified: {entry}")
    return problems


def account(folder: Path, blocks: list[SharedBlock]) -> Account:
    """Compare the recordings in `folder` with the ticks that the loops counted in their shared blocks, `blocks`."""
    executed = lost = missed = 0
    problems = [f"{path.name}: unfinished file left in the folder" for path in folder.glob("*.part")]
    runs = runs_in(folder)
    if len(runs) < len(blocks):
        problems.append(f"{len(blocks)} loops ran, {len(runs)} are recorded")
    for number, paths in enumerate(runs):
        summary, recording = summarise(paths), rtloop.load(paths)
        recorded, stated_lost = len(recording), summary.ticks_lost
        total = recorded + stated_lost
        if number < len(blocks) and len(runs) == len(blocks) and total != int(blocks[number]["ticks_head"][0]):
            problems.append(f"{paths[0].name}: {total} ticks accounted, {blocks[number]['ticks_head'][0]} executed")
        verdict = replay(recording, trust=TrustedLaws(recorded=True))  # laws from files are written by this suite
        replay_problems = unexplained(verdict, recording.header["rate_hz"])
        problems += [f"{paths[0].name}: replay: {problem}" for problem in replay_problems]
        if sum(gap["count"] for gap in verdict.gaps) > stated_lost:
            problems.append(f"{paths[0].name}: {verdict.gaps} missing, {stated_lost} stated as lost")
        executed, lost, missed = executed + total, lost + stated_lost, missed + summary.periods_missed
    return Account(executed, lost, missed, problems)
