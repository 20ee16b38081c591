"""What came of the mutants: results kept line by line, mutants that change nothing, and the table by room."""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

from rich.table import Table

from tests.mutants.mutant import Mutant

EQUIVALENT = Path(__file__).with_name("equivalent.toml")


class Verdict(StrEnum):
    """What the tests made of a mutant."""

    DIED = "died"
    TIMED_OUT = "timed out"
    SURVIVED = "survived"
    UNTESTED = "untested"
    """No test of the room executes its line: it survived, and nothing had to be run to know it."""


class Result(NamedTuple):
    """A verdict, how long it took, and the test that killed the mutant."""

    key: str
    verdict: Verdict
    seconds: float
    test: str


class Equivalent(NamedTuple):
    """A change that no test can see, and why; found again by its lines, wherever in the file they stand by now."""

    file: str
    before: str
    after: str
    reason: str


def equivalents(path: Path = EQUIVALENT) -> list[Equivalent]:
    """The kept list of mutants that change no behaviour."""
    return [Equivalent(**entry) for entry in tomllib.loads(path.read_text(encoding="utf-8")).get("equivalent", [])]


def kept(path: Path) -> dict[str, Result]:
    """Results by key, the newest of each; nothing where the file is not there yet."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    told = (json.loads(line) for line in lines)
    return {
        entry["key"]: Result(entry["key"], Verdict(entry["verdict"]), entry["seconds"], entry["test"]) for entry in told
    }


def keep(path: Path, mutant: Mutant, result: Result) -> None:
    """Add one result."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps({**mutant._asdict(), **result._asdict()}) + "\n")


def table(
    mutants: Iterable[Mutant], results: dict[str, Result], known: Iterable[Equivalent]
) -> tuple[Table, list[Mutant], float]:
    """The table by room, the survivors that are not known to be equivalent, and the score of all rooms.

    The score is the share that died or timed out among those that are not equivalent.
    """
    harmless = {(entry.file, entry.before, entry.after) for entry in known}
    rooms: dict[str, Counter[str]] = {}
    survivors = []
    for mutant in mutants:
        if (result := results.get(mutant.key)) is None:
            continue
        verdict = str(result.verdict)
        if result.verdict in (Verdict.SURVIVED, Verdict.UNTESTED):
            if (mutant.file, mutant.before, mutant.after) in harmless:
                verdict = "equivalent"
            else:
                survivors.append(mutant)
        rooms.setdefault(mutant.room, Counter())[verdict] += 1
    whole: Counter[str] = sum(rooms.values(), Counter())
    columns = ("died", "timed out", "survived", "untested", "equivalent")
    shown = Table("room", "drawn", *columns, "score")
    for name, counts in (*rooms.items(), ("all", whole)):
        score = f"{100 * _score(counts):.0f} %"
        shown.add_row(name, str(counts.total()), *(str(counts[column]) for column in columns), score)
    return shown, survivors, _score(whole)


def _score(counts: Counter[str]) -> float:
    judged = counts.total() - counts["equivalent"]
    return (counts["died"] + counts["timed out"]) / judged if judged else 1.0
