"""Results of the mutants (one JSON line each), list of mutants that change no behaviour, and scores of the rooms."""

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
    """The outcome of the tests of a mutant."""

    DIED = "died"
    TIMED_OUT = "timed out"
    SURVIVED = "survived"
    UNTESTED = "untested"
    """No test of the room executes the changed line: the mutant survived, and no test was run."""


class Result(NamedTuple):
    """A mutant's verdict, the duration of its tests, and the first test that failed (empty if none did)."""

    key: str
    verdict: Verdict
    seconds: float
    test: str


class Equivalent(NamedTuple):
    """A change that alters no behaviour, and the reason; it is identified by its lines, not by their numbers."""

    file: str
    before: str
    after: str
    reason: str


def read_equivalents(path: Path = EQUIVALENT) -> list[Equivalent]:
    """Return the listed mutants that change no behaviour."""
    return [Equivalent(**entry) for entry in tomllib.loads(path.read_text(encoding="utf-8")).get("equivalent", [])]


def read_results(path: Path) -> dict[str, Result]:
    """Return the newest result of each mutant by its key; an empty dict if the file does not exist."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    rows = (json.loads(line) for line in lines)
    return {row["key"]: Result(row["key"], Verdict(row["verdict"]), row["seconds"], row["test"]) for row in rows}


def append_result(path: Path, mutant: Mutant, result: Result) -> None:
    """Append the result of a mutant to the file `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps({**mutant._asdict(), **result._asdict()}) + "\n")


def summarise_results(
    mutants: Iterable[Mutant], results: dict[str, Result], equivalents: Iterable[Equivalent]
) -> tuple[Table, list[Mutant], float]:
    """Return the table by room, the survivors that are not listed as equivalent, and the score of all rooms (0 … 1).

    The score is the share of mutants that died or timed out, among the mutants that are not equivalent.
    """
    equivalent_lines = {(entry.file, entry.before, entry.after) for entry in equivalents}
    rooms: dict[str, Counter[str]] = {}
    survivors = []
    for mutant in mutants:
        if (result := results.get(mutant.key)) is None:
            continue
        verdict = str(result.verdict)
        if result.verdict in (Verdict.SURVIVED, Verdict.UNTESTED):
            if (mutant.file, mutant.before, mutant.after) in equivalent_lines:
                verdict = "equivalent"
            else:
                survivors.append(mutant)
        rooms.setdefault(mutant.room, Counter())[verdict] += 1
    totals: Counter[str] = sum(rooms.values(), Counter())
    columns = ("died", "timed out", "survived", "untested", "equivalent")
    table = Table("room", "drawn", *columns, "score")
    for name, counts in (*rooms.items(), ("all", totals)):
        score = f"{100 * _score(counts):.0f} %"
        table.add_row(name, str(counts.total()), *(str(counts[column]) for column in columns), score)
    return table, survivors, _score(totals)


def _score(counts: Counter[str]) -> float:
    """Return the share of mutants that died or timed out, without the equivalent ones; 1 if there are none."""
    counted = counts.total() - counts["equivalent"]
    return (counts["died"] + counts["timed out"]) / counted if counted else 1.0
