"""Hysteresis of commercial AFMs' scanners, from recordings that nobody here made. `make soak-afm`.

The recordings are the tests' data of afmformats (MIT), in its source distribution: drive ("height (piezo)") and
position sensor ("height (measured)") of z scanners, both in metres. Each curve is imported through `rtloop import`;
the model is identified on the first curve of a file and judged on the others. Drive is in µm of the maker's scale and
stands as if it were volts. Skipped, with the reason, where the distribution or its reader cannot be fetched.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tarfile
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner

from rtloop.cli import main as rtloop

AFMFORMATS = "afmformats==0.18.7"
SETTLED_MAP, ALLOWED_PERCENT = "map-data-reference-points", 2.0
LEFT_OUT = {"spring constant": 1.0, "sensitivity": 1e-8}
"""What the reader asks for and the scanner does not need."""


def main() -> None:
    """A table of every file; 1 where the settled map's curves are missed by more than is allowed."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for what in (
            ("download", "--quiet", "--no-deps", "--no-binary", ":all:", "--dest", name, AFMFORMATS),
            ("install", "--quiet", "--target", str(folder / "reader"), AFMFORMATS),
        ):
            done = subprocess.run(
                [sys.executable, "-m", "pip", "--disable-pip-version-check", *what], capture_output=True
            )
            if done.returncode:
                print(f"skipped: pip {what[0]}: {done.stderr.decode().strip().splitlines()[-1]}")
                return
        with tarfile.open(next(folder.glob("afmformats-*.tar.gz"))) as archive:
            archive.extractall(folder, filter="data")
        sys.path.append(str(folder / "reader"))
        print(f"{'file':48}{'curve':>6}{'':10}{'rms %':>8}{'at most %':>11}  remarks")
        files = sorted(folder.glob("afmformats-*/tests/data/fmt-jpk-*"))
        missed = [one for one in files if shown(one, folder) > ALLOWED_PERCENT and SETTLED_MAP in one.name]
    sys.exit(1 if missed else 0)


def shown(path: Path, folder: Path) -> float:
    """Print the rows of one file; returns the largest held-out error of its further curves, in % of their range."""
    name = path.name.removeprefix("fmt-jpk-")[:46]
    curves = recordings(path, folder)
    if not curves:
        print(f"{name:48} holds no position sensor")
        return 0.0
    others = [part for curve in curves[1:] for part in ("--validate", curve)]
    found = command("identify", "hysteresis", curves[0], *others, "--json", "--plot", folder / "one.png")
    (folder / "one.png").unlink(missing_ok=True)
    if "error" in found:
        print(f"{name:48} refused: {found['error']}")
        return 0.0
    for i, row in enumerate(found["held_out"]):
        if not row["judged_percent"]:
            print(f"{name if i == 0 else '':48}{i:6}  not judged: its memory is never known")
            continue
        share, apart = (100 * row[key] / row["range_um"] for key in ("rms_error_um", "unsettled_um"))
        remarks = [f"{row['judged_percent']:.0f} % of it", f"the rest {row['early_max_error_percent']:.2f} %"]
        remarks += [f"{apart:.2f} % from a settled loop"]
        remarks += ["unsettled"] if row["unsettled"] else []
        remarks += [f"for strokes up to {found['stroke_v']:.3g}"] if i == 0 else []
        kind = "fitted" if row["fitted"] else "held out"
        print(
            f"{name if i == 0 else '':48}{i:6}  {kind:8}{share:8.3f}{row['max_error_percent']:11.3f}  "
            f"{', '.join(remarks)}",
            flush=True,
        )
    keys = ("max_error_percent", "early_max_error_percent")
    return max((row[key] or 0.0 for row in found["held_out"][1:] for key in keys), default=0.0)


def recordings(path: Path, folder: Path) -> list[Path]:
    """Every curve of a file as an imported recording."""
    import afmformats  # pyright: ignore[reportMissingImports]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        curves = list(afmformats.load_data(path, meta_override=LEFT_OUT))
    made = []
    for i, curve in enumerate(curves):
        if "height (measured)" not in curve.columns:
            continue
        source, made_here = folder / f"{path.stem}-{i}.npz", folder / f"{path.stem}-{i}.mcap"
        t, piezo, sensor = (np.array(curve[name]) for name in ("time", "height (piezo)", "height (measured)"))
        np.savez(source, t=t, piezo=piezo, sensor=sensor)
        maps = ("--time", "t [s]", "--map", "x_drive_v=piezo [V] * 1e6", "--map", "x_position_um=sensor [m]")
        command("import", source, *maps, "--out", made_here)
        made.append(made_here)
    return made


def command(*arguments: str | Path) -> dict[str, Any]:
    """What `rtloop` reports, or its error."""
    result = CliRunner().invoke(rtloop, [str(argument) for argument in arguments])
    if result.exit_code:
        return {"error": (result.stderr or result.output).strip().splitlines()[-1]}
    return json.loads(result.stdout) if "--json" in arguments else {}


if __name__ == "__main__":
    main()
