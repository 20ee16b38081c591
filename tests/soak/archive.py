"""An archive of 500 recordings, 7 of them bent, cut or forged: exactly these are named, on processes and on Dask."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.campaigns.bad_recordings import BAD, archive, bad_rows, dask_cluster, make_archive, record_short_run

RECORDINGS, WORKERS = 500, 2


def main() -> int:
    """Print a table of all calls and one of the bad recordings; return 1 if a call names others."""
    parser = argparse.ArgumentParser(prog="archive", description=__doc__)
    parser.add_argument("--recordings", type=int, default=RECORDINGS)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        for part in ("good", "archive", "dask"):
            (place / part).mkdir()
        make_archive(place / "archive", record_short_run(place / "good"), options.recordings - len(BAD), list(BAD))
        print(f"{'workers':14}{'s':>7}{'recordings/s':>14}  verdicts", flush=True)
        results = [_replay(place, f"{jobs} process{'es' * (jobs > 1)}", "--jobs", jobs) for jobs in (1, WORKERS)]
        with dask_cluster(place / "dask", WORKERS) as address:
            results.append(_replay(place, f"Dask, {WORKERS} workers", "--scheduler", address))
        _print_rows(results[0])
    misses = [fault for result in results for fault in _find_misses(result, results[0])]
    print("\n".join(misses) or f"exactly the {len(BAD)} bad recordings are named, equally by all workers")
    return 1 if misses else 0


def _replay(place: Path, workers: str, *options: object) -> dict:
    """Replay the archive, and print duration, rate and counts. Returns the report."""
    _, report = archive("replay", place / "archive", *options, folder=place)
    counts = ", ".join(f"{count} {verdict}" for verdict, count in report["counts"].items())
    print(f"{workers:14}{report['duration_s']:7.1f}{report['rate_per_s']:14.1f}  {counts}", flush=True)
    return report


def _print_rows(report: dict) -> None:
    """Print the bad recordings with their verdicts and reasons."""
    for name, row in bad_rows(report).items():
        print(f"{name:13}{row['verdict']:16}{row['tick'] or '':5} {row['column'] or '':15}{row['reason']}")


def _find_misses(report: dict, first: dict) -> list[str]:
    """Return a sentence for each wrong verdict, and one for rows that differ from those of the first report."""
    rows = bad_rows(report)
    misses = [f"{name}: not named" for name in BAD if name not in rows]
    misses += [f"{name}: {row['verdict']}, but it is good" for name, row in rows.items() if name not in BAD]
    for name in BAD.keys() & rows.keys():
        _, verdict, reason = BAD[name]
        if rows[name]["verdict"] != verdict or reason not in rows[name]["reason"]:
            misses.append(f"{name}: {rows[name]['verdict']} ({rows[name]['reason']}); expected: {verdict} ({reason})")
    return misses + ["the workers disagree"] * (report["verdicts"] != first["verdicts"])


if __name__ == "__main__":
    sys.exit(main())
