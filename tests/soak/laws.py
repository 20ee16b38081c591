"""A thousand live changes of every shipped controller: parameters, modes, and other laws. `make soak NAME=laws`.

There is no slew limit, so that the drive follows the law; the demand, before all limits, is judged. In the tick of a
change in closed loop the demand must continue from the drive in force; from tick to tick it may move by half as much
again as under C(z) alone, changed as often. The recording must replay identical: in one file, in several files, and
recovered after a cut at any byte. No write may fall outside a record.
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
    drive_steps,
)
from tests.soak.guarded_process import guard_records, guarded_count, overwritten_bytes

CHANGES, ROTATE_S = 1000, 5.0
LAWS = [*CONTROLLERS, "coupled"]


def record_changes(folder: Path, sections: dict[str, str], seed: int) -> tuple[LawChanges, Path, list[Path]]:
    """Record a run with random changes. Return the changes, the recording in one file, and in several files."""
    single_file, part_files = folder / "whole.mcap", folder / "parts.mcap"
    files = {single_file: Options(min_free_bytes=0), part_files: Options(min_free_bytes=0, rotate_s=ROTATE_S)}
    with guard_records():
        changes = change_at_random(folder, sections, files, seed=seed, count=CHANGES, model=True)
    return changes, single_file, sorted(folder.glob("parts-*.mcap"))


def steps_alone(seed: int) -> Steps:
    """Return the largest steps of the demand under C(z) alone, changed as often, without another law."""
    with tempfile.TemporaryDirectory(prefix="rtloop-laws-") as name:
        _, path, _ = record_changes(Path(name), {"transfer": CONTROLLERS["transfer"]}, seed)
        return drive_steps(rtloop.load(path))


def cut_and_recover(path: Path, random: Random) -> Path:
    """Cut a copy of the file at a random byte of the last four fifths; return the path of the recovered copy."""
    data, part = path.read_bytes(), path.with_name("cut.mcap.part")
    part.write_bytes(data[: round(len(data) * random.uniform(0.2, 1.0))])
    return Path(recover(part)["output"])


def check_law(first: str, seed: int, alone: Steps) -> None:
    """Check a run that begins with the law `first` and print its figures. Raises AssertionError for a fault."""
    controllers = TOGETHER if first in TOGETHER else CONTROLLERS
    sections = {first: controllers[first]} | controllers
    with tempfile.TemporaryDirectory(prefix="rtloop-laws-") as name:
        (Path(name) / "pair.py").write_text(PAIR, encoding="utf-8")
        changes, path, part_paths = record_changes(Path(name), sections, seed)
        recording = rtloop.load(path)
        steps = drive_steps(recording)
        trips = [event["what"] for event in recording.events if event["kind"] == "tripped"]
        kinds = {
            "one file": path,
            "recovered": cut_and_recover(path, Random(seed)),
            f"{len(part_paths)} files": part_paths,
        }
        trust = TrustedLaws(recorded=True)
        verdicts = {kind: replay(rtloop.load(files), trust=trust) for kind, files in kinds.items()}
    replay_text = ", ".join(
        f"{kind} {'identical' if verdict.identical else verdict.first_difference or verdict.not_verified} "
        f"({verdict.ticks} ticks)"
        for kind, verdict in verdicts.items()
    )
    print(
        f"{first}, seed {seed}: {changes.of[first]} changes of it, {changes.done.total()} in all {dict(changes.done)}, "
        f"{changes.refused} refused, {len(trips)} trips\n"
        f"  largest |Δdemand| {steps.at_change_v:.1e} V at a change, {steps.largest_v:.4f} V in any tick "
        f"(allowed {AT_CHANGE_V:g} V, {MORE * alone.largest_v:.4f} V), {steps.limited} ticks limited\n"
        f"  replay: {replay_text}; {overwritten_bytes()} bytes overwritten around {guarded_count()} records",
        flush=True,
    )
    assert not trips
    assert steps.at_change_v <= AT_CHANGE_V
    assert steps.largest_v <= MORE * alone.largest_v
    assert steps.limited == 0
    assert len(part_paths) > 2
    assert verdicts["one file"].ticks == verdicts[f"{len(part_paths)} files"].ticks > verdicts["recovered"].ticks
    assert all(verdict.identical and not verdict.problems for verdict in verdicts.values())
    assert guarded_count()
    assert overwritten_bytes() == 0


def main() -> None:
    """Check every controller with every seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", nargs="*", type=int, default=[14])
    parser.add_argument("--laws", nargs="*", choices=LAWS, default=list(LAWS))
    options = parser.parse_args()
    for seed in options.seeds:
        alone = steps_alone(seed)
        print(f"C(z) alone, seed {seed}: {alone.at_change_v:.1e} V at a change, {alone.largest_v:.4f} V in any tick")
        for first in options.laws:
            check_law(first, seed, alone)


if __name__ == "__main__":
    main()
