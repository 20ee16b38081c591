"""An archive of 500 recordings, 7 of them bent, cut or forged: exactly these are reported, on processes and on Dask."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.campaigns.bad_recordings import BAD, archive, bad_rows, dask_cluster, make_archive, record_short_run

RECORDINGS, WORKERS = 500, 2


def main() -> int:
    """Print a table of all replays and one of the bad recordings; return 1 if a report has a wrong verdict."""
    parser = argparse.ArgumentParser(prog="archive", description=__doc__)
    parser.add_argument("--recordings", type=int, default=RECORDINGS)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for subfolder in ("good", "archive", "dask"):
            (folder / subfolder).mkdir()
        make_archive(folder / "archive", record_short_run(folder / "good"), options.recordings - len(BAD), list(BAD))
        print(f"{'workers':14}{'s':>7}{'recordings/s':>14}  verdicts", flush=True)
        results = [_replay(folder, f"{jobs} process{'es' * (jobs > 1)}", "--jobs", jobs) for jobs in (1, WORKERS)]
        with dask_cluster(folder / "dask", WORKERS) as address:
            results.append(_replay(folder, f"Dask, {WORKERS} workers", "--scheduler", address))
        _print_rows(results[0])
    faults = [fault for result in results for fault in _find_faults(result, results[0])]
    print("\n".join(faults) or f"exactly the {len(BAD)} bad recordings are reported, equally by all workers")
    return 1 if faults else 0


def _replay(folder: Path, workers: str, *options: object) -> dict:
    """Replay the archive; print duration, rate and counts of verdicts. Return the report."""
    _, report = archive("replay", folder / "archive", *options, folder=folder)
    counts = ", ".join(f"{count} {verdict}" for verdict, count in report["counts"].items())
    print(f"{workers:14}{report['duration_s']:7.1f}{report['rate_per_s']:14.1f}  {counts}", flush=True)
    return report


def _print_rows(report: dict) -> None:
    """Print the bad recordings with their verdicts and reasons."""
    for name, row in bad_rows(report).items():
        print(f"{name:13}{row['verdict']:16}{row['tick'] or '':5} {row['column'] or '':15}{row['reason']}")


def _find_faults(report: dict, first: dict) -> list[str]:
    """Return a sentence for each wrong verdict, and one if the verdicts differ from the first report's."""
    rows = bad_rows(report)
    faults = [f"{name}: not reported" for name in BAD if name not in rows]
    faults += [f"{name}: {row['verdict']}, but the recording is good" for name, row in rows.items() if name not in BAD]
    for name in BAD.keys() & rows.keys():
        _, verdict, reason = BAD[name]
        if rows[name]["verdict"] != verdict or reason not in rows[name]["reason"]:
            faults.append(f"{name}: {rows[name]['verdict']} ({rows[name]['reason']}); expected: {verdict} ({reason})")
    return faults + ["the workers disagree"] * (report["verdicts"] != first["verdicts"])


if __name__ == "__main__":
    sys.exit(main())
