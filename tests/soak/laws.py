"""A thousand live changes of every shipped controller: its numbers, modes, and other laws. `make soak NAME=laws`.

Without a slew limit, so that the drive does what the law says, and judged by the demand, which nothing has limited yet.
In the tick of a change in closed loop it must go on from the drive in force; from tick to tick it may move by half as
much again as under C(z) alone, changed as often. The recording must replay identical: whole, in several files, and cut
off anywhere and recovered. Nothing may be written outside a record.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from random import Random

import rtloop
from rtloop.recording.capture.session import Options
from rtloop.recording.file.recover import recover
from rtloop.recording.replay.laws import TrustedLaws
from rtloop.recording.replay.replay import replay
from tests.laws.changing import (
    AT_CHANGE_V,
    CONTROLLERS,
    MORE,
    PAIR,
    TOGETHER,
    LawChanges,
    Steps,
    change_at_random,
    steps_of,
)
from tests.soak.guarded_process import broken, guarded, guarding

CHANGES, ROTATE_S = 1000, 5.0
LAWS = [*CONTROLLERS, "coupled"]


def changed(folder: Path, sections: dict[str, str], seed: int) -> tuple[LawChanges, Path, list[Path]]:
    """The changes of one run, its recording in one file, and in several."""
    whole, parts = folder / "whole.mcap", folder / "parts.mcap"
    files = {whole: Options(min_free_bytes=0), parts: Options(min_free_bytes=0, rotate_s=ROTATE_S)}
    with guarding():
        changes = change_at_random(folder, sections, files, seed=seed, count=CHANGES, model=True)
    return changes, whole, sorted(folder.glob("parts-*.mcap"))


def steps_alone(seed: int) -> Steps:
    """Of C(z), changed as often, with no other law beside it."""
    with tempfile.TemporaryDirectory(prefix="rtloop-laws-") as name:
        _, whole, _ = changed(Path(name), {"transfer": CONTROLLERS["transfer"]}, seed)
        return steps_of(rtloop.load(whole))


def cut_off(path: Path, chance: Random) -> Path:
    """A copy that ends after any byte of the last four fifths, recovered."""
    data, part = path.read_bytes(), path.with_name("cut.mcap.part")
    part.write_bytes(data[: round(len(data) * chance.uniform(0.2, 1.0))])
    return Path(recover(part)["output"])


def soak(first: str, seed: int, alone: Steps) -> None:
    """The run that begins with one law, judged."""
    beside = TOGETHER if first in TOGETHER else CONTROLLERS
    sections = {first: beside[first]} | beside
    with tempfile.TemporaryDirectory(prefix="rtloop-laws-") as name:
        (Path(name) / "pair.py").write_text(PAIR, encoding="utf-8")
        changes, whole, parts = changed(Path(name), sections, seed)
        recording = rtloop.load(whole)
        steps = steps_of(recording)
        trips = [event["what"] for event in recording.events if event["kind"] == "tripped"]
        kinds = {"whole": whole, "recovered": cut_off(whole, Random(seed)), f"{len(parts)} files": parts}
        trust = TrustedLaws(recorded=True)
        verdicts = {kind: replay(rtloop.load(files), trust=trust) for kind, files in kinds.items()}
    said = ", ".join(
        f"{kind} {'identical' if verdict.identical else verdict.first_difference or verdict.not_verified} "
        f"({verdict.ticks} ticks)"
        for kind, verdict in verdicts.items()
    )
    print(
        f"{first}, seed {seed}: {changes.of[first]} changes of it, {changes.done.total()} in all {dict(changes.done)}, "
        f"{changes.refused} refused, {len(trips)} trips\n"
        f"  largest |Δdemand| {steps.at_change_v:.1e} V at a change, {steps.largest_v:.4f} V in any tick "
        f"(allowed {AT_CHANGE_V:g} V, {MORE * alone.largest_v:.4f} V), {steps.limited} ticks limited\n"
        f"  replay: {said}; {broken()} bytes written beside {guarded()} records",
        flush=True,
    )
    assert not trips
    assert steps.at_change_v <= AT_CHANGE_V
    assert steps.largest_v <= MORE * alone.largest_v
    assert steps.limited == 0
    assert len(parts) > 2
    assert verdicts["whole"].ticks == verdicts[f"{len(parts)} files"].ticks > verdicts["recovered"].ticks
    assert all(verdict.identical and not verdict.problems for verdict in verdicts.values())
    assert guarded()
    assert broken() == 0


def main() -> None:
    """Every controller with every seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", nargs="*", type=int, default=[14])
    parser.add_argument("--laws", nargs="*", choices=LAWS, default=list(LAWS))
    given = parser.parse_args()
    for seed in given.seeds:
        alone = steps_alone(seed)
        print(f"C(z) alone, seed {seed}: {alone.at_change_v:.1e} V at a change, {alone.largest_v:.4f} V in any tick")
        for first in given.laws:
            soak(first, seed, alone)


if __name__ == "__main__":
    main()
