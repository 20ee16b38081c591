"""Which mutants are tried: drawn at random from the places of each room, the same for the same sources and seed."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from random import Random

from tests.mutants.mutant import Change, Mutant
from tests.mutants.places import mutated, places
from tests.mutants.rooms import ROOMS, ROOT, shares, sources_of


def drawn(total: int, seed: int, tree: Path = ROOT) -> list[Mutant]:
    """The mutants, room by room; fewer of one seed are the first of more in each room."""
    of_rooms = {
        name: [
            (file, changes)
            for file in sources_of(room, tree)
            for changes in places((tree / file).read_text(encoding="utf-8")).values()
        ]
        for name, room in ROOMS.items()
    }
    numbers = shares({name: len(found) for name, found in of_rooms.items()}, total)
    return [
        mutant
        for name, found in of_rooms.items()
        for mutant in _of_room(name, found, numbers[name], f"{seed} {name}", tree)
    ]


def stored_draw(folder: Path, total: int, seed: int) -> list[Mutant]:
    """As `drawn`, which takes a minute, kept in `folder` for as long as the sources are the same."""
    digest = hashlib.sha256()
    for file in [file for room in ROOMS.values() for file in sources_of(room)]:
        digest.update(file.encode() + (ROOT / file).read_bytes())
    path = folder / f"drawn-{total}-{seed}-{digest.hexdigest()[:12]}.json"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(drawn(total, seed)), encoding="utf-8")
    return [Mutant(*fields) for fields in json.loads(path.read_text(encoding="utf-8"))]


def _of_room(room: str, found: list[tuple[str, list[Change]]], number: int, seed: str, tree: Path) -> list[Mutant]:
    """A place is drawn first and then one of its changes, so that a place with many does not come up more often."""
    random, mutants = Random(seed), []
    for file, changes in random.sample(found, len(found)):
        if len(mutants) == number:
            break
        mutant = described(room, file, (tree / file).read_text(encoding="utf-8"), random.choice(changes))
        if mutant is not None:
            mutants.append(mutant)
    return mutants


def described(room: str, file: str, source: str, change: Change) -> Mutant | None:
    """A change with the lines that it touches; None where it makes no Python."""
    text = mutated(source, change)
    if text is None:
        return None
    old, new = source.splitlines(), text.splitlines()
    first = next(number for number, (a, b) in enumerate(zip(old, new, strict=False)) if a != b)
    behind = next(n for n, (a, b) in enumerate(zip(reversed(old), reversed(new), strict=False)) if a != b)
    before, after = old[first : len(old) - behind], new[first : len(new) - behind]
    return Mutant(room, file, first + 1, *change, _one_line(before), _one_line(after))


def _one_line(lines: list[str]) -> str:
    return " ".join(line.strip() for line in lines)
