"""A folder of somebody else: a file for each name that a program might import, run or read there."""

from __future__ import annotations

import sys
from importlib.metadata import packages_distributions
from pathlib import Path

MARKER = "ran-{}"
CODE = """import os
os.close(os.open({marker!r}, os.O_CREAT | os.O_WRONLY, 0o666))
raise SystemExit("planted code runs")
"""
MATPLOTLIBRC = "text.usetex: True\nlines.linewidth: 20\nsavefig.facecolor: red\nfont.size: 40\n"
NUMBA = "disable_jit: 1\nopt: 0\nboundscheck: 1\n"
ENTRY_POINTS = "".join(
    f"[{group}]\nplanted = planted_plugin:init\n"
    for group in ("rtloop.drivers", "rtloop.laws", "numba_extensions", "can.interface", "pydantic", "console_scripts")
)


def plant(folder: Path, markers: Path, without: tuple[str, ...] = ()) -> None:
    """Write the files into `folder`; code among them that runs writes a file into `markers`. `without`: no such module.

    Modules are named like all modules of the standard library and of the installed packages, and like files that
    Python, pytest and numba run by themselves.
    """
    extra = {"sitecustomize", "usercustomize", "conftest", "planted_plugin", "rtloop", "drivers", "hil"}
    names = {name for name in sys.stdlib_module_names | packages_distributions().keys() | extra if name.isidentifier()}
    for name in names - set(without):
        marker = markers / MARKER.format(name)
        (folder / f"{name}.py").write_text(CODE.format(marker=str(marker)))
    for name in ("cc", "gcc", "latex", "sh", "env"):
        program = folder / name
        program.write_text(f"#!/bin/bash\n: > {markers / MARKER.format(name)}\nexit 1\n")
        program.chmod(0o755)
    (folder / "planted.pth").write_text("import planted_plugin\n")
    for kind in ("egg-info", "dist-info"):
        information = folder / f"planted_{kind[:4].strip('-')}-1.0.{kind}"
        information.mkdir()
        for name in ("METADATA", "PKG-INFO"):
            (information / name).write_text("Metadata-Version: 2.1\nName: planted\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(ENTRY_POINTS)
    (folder / "matplotlibrc").write_text(MATPLOTLIBRC)
    (folder / ".numba_config.yaml").write_text(NUMBA)
    for name in ("can.ini", "can.conf", "setup.cfg", "pyproject.toml", "pyvenv.cfg", ".env", "libc.so.6", "libm.so.6"):
        (folder / name).write_text("[default]\ninterface = no_such_interface\n")
    for name in (".dask", "dask", ".config"):
        (folder / name).mkdir()
        (folder / name / "x.yaml").write_text("distributed: {worker: {preload: [planted_plugin]}}\n")
