"""Installation of a third party's package without pip: the modules and entry points of its pyproject.toml."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path


def install(target: Path) -> Path:
    """Install the package into the folder `target`, and return the folder, which must be on the Python path."""
    source = Path(__file__).with_name("third_party")
    pyproject = tomllib.loads((source / "pyproject.toml").read_text())
    project, modules = pyproject["project"], pyproject["tool"]["setuptools"]["py-modules"]
    for module in modules:
        shutil.copy(source / f"{module}.py", target)
    lines = [f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
             for group, points in project["entry-points"].items()]  # fmt: skip
    write_distribution(target, project["name"], project["version"], "".join(lines))
    return target


def write_distribution(target: Path, name: str, version: str, entry_points: str) -> None:
    """Write the metadata of an installed distribution."""
    info = target / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(entry_points)


def built_modules(folder: Path) -> list[str]:
    """Return the sorted names of the files that setuptools builds from the project in a folder."""
    target = folder / "built"
    shutil.rmtree(target, ignore_errors=True)
    command = [sys.executable, "-W", "ignore", "-c", "import setuptools; setuptools.setup()"]
    subprocess.run([*command, "-q", "build_py", "--build-lib", target], cwd=folder, check=True, timeout=60)
    return sorted(path.name for path in target.iterdir())
