"""Random choice of the mutants from the places of each room; equal sources and an equal seed give equal mutants."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from random import Random

from tests.mutants.mutant import Change, Mutant
from tests.mutants.places import apply_change, places
from tests.mutants.rooms import ROOMS, ROOT, room_sources, shares


def draw_mutants(total: int, seed: int, tree: Path = ROOT) -> list[Mutant]:
    """Draw `total` mutants, room by room. A smaller total with the same seed gives the first mutants of each room."""
    places_by_room = {
        name: [
            (file, changes)
            for file in room_sources(room, tree)
            for changes in places((tree / file).read_text(encoding="utf-8")).values()
        ]
        for name, room in ROOMS.items()
    }
    numbers = shares({name: len(places_of_room) for name, places_of_room in places_by_room.items()}, total)
    return [
        mutant
        for name, places_of_room in places_by_room.items()
        for mutant in _draw_room(name, places_of_room, numbers[name], f"{seed} {name}", tree)
    ]


def load_or_draw(folder: Path, total: int, seed: int) -> list[Mutant]:
    """Return the mutants of `draw_mutants`, which takes a minute; `folder` stores them until the sources change."""
    digest = hashlib.sha256()
    for file in [file for room in ROOMS.values() for file in room_sources(room)]:
        digest.update(file.encode() + (ROOT / file).read_bytes())
    path = folder / f"drawn-{total}-{seed}-{digest.hexdigest()[:12]}.json"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(draw_mutants(total, seed)), encoding="utf-8")
    return [Mutant(*fields) for fields in json.loads(path.read_text(encoding="utf-8"))]


def _draw_room(room: str, options: list[tuple[str, list[Change]]], count: int, seed: str, tree: Path) -> list[Mutant]:
    """Draw `count` mutants: each time a place, then one of its changes, so that all places are equally likely."""
    random, mutants = Random(seed), []
    for file, changes in random.sample(options, len(options)):
        if len(mutants) == count:
            break
        mutant = make_mutant(room, file, (tree / file).read_text(encoding="utf-8"), random.choice(changes))
        if mutant is not None:
            mutants.append(mutant)
    return mutants


def make_mutant(room: str, file: str, source: str, change: Change) -> Mutant | None:
    """Return the mutant of a change with the lines that it changes; None if the change gives no valid Python."""
    text = apply_change(source, change)
    if text is None:
        return None
    old, new = source.splitlines(), text.splitlines()
    first = next(number for number, (a, b) in enumerate(zip(old, new, strict=False)) if a != b)
    unchanged_at_end = next(n for n, (a, b) in enumerate(zip(reversed(old), reversed(new), strict=False)) if a != b)
    before, after = old[first : len(old) - unchanged_at_end], new[first : len(new) - unchanged_at_end]
    return Mutant(room, file, first + 1, *change, _one_line(before), _one_line(after))


def _one_line(lines: list[str]) -> str:
    """Return the lines without indentation, joined by spaces."""
    return " ".join(line.strip() for line in lines)
