"""Wheel and source archive of the working tree, built without a network, and their contents."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("deploy", "drivers", "hil", "rtloop")
A_TEST = "tests/test_values.py"
"""A test file, which setuptools packs into a source archive unless MANIFEST.in excludes it."""
SETUPTOOLS = 77
"""Oldest setuptools that reads a licence expression."""


def can_build() -> bool:
    """Whether the tests' interpreter has the build backend that pyproject.toml names."""
    try:
        return int(version("setuptools").split(".")[0]) >= SETUPTOOLS
    except PackageNotFoundError:
        return False


def copy_tree(target: Path) -> Path:
    """Copy all files that a build may read to a new folder, links as links, without caches; return the folder."""
    ignored = shutil.ignore_patterns("__pycache__", "*.pyc", ".*")
    target.mkdir()
    for folder in FOLDERS:
        shutil.copytree(ROOT / folder, target / folder, symlinks=True, ignore=ignored)
    (target / A_TEST).parent.mkdir()
    shutil.copy2(ROOT / A_TEST, target / A_TEST)
    for file in ROOT.iterdir():
        if file.is_file() and not file.name.startswith("."):
            shutil.copy2(file, target)
    return target


def build(kind: str, source: Path, target: Path) -> Path:
    """Build `sdist` or `wheel` of the tree `source` into the folder `target`; return the archive."""
    program = f"import sys; from setuptools import build_meta; print(build_meta.build_{kind}(sys.argv[1]))"
    target.mkdir(exist_ok=True)
    completed = subprocess.run(
        [sys.executable, "-c", program, str(target)], cwd=source, capture_output=True, text=True,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
    )  # fmt: skip
    assert completed.returncode == 0, completed.stderr
    return target / completed.stdout.split()[-1]


def unpack_sdist(sdist: Path, target: Path) -> Path:
    """Unpack a source archive; return its top folder."""
    with tarfile.open(sdist) as archive:
        safe = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # Python below 3.11.4 has no filters
        archive.extractall(target, **safe)
    return target / sdist.name.removesuffix(".tar.gz")


def wheel_files(wheel: Path) -> dict[str, bytes]:
    """Return the contents of the files of a wheel by name."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}
