"""The wheel in a fresh environment runs README's commands from a folder that holds the files of `deploy/` alone.

    make soak NAME=wheel FLAGS="--pip-args='--no-index --find-links FOLDER'"

Commands of SKIPPED are printed as skipped; commands that README gives in part are ignored.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

import pytest

from tests.packaging.distribution import ROOT, build, copy_tree

COMMAND = re.compile(r"`(rtloop [^`]+)`")
COMPLETE = re.compile(r"deploy/[\w-]+\.toml|recordings/FILE\.mcap")
"""A command that names a shipped file or a recording is complete."""
SKIPPED = ("panel", "serve", "hil", "experiment all", "archive", "campaign")
"""Services, and commands that take minutes or need other recordings."""
JUDGES_HOST = "rtloop doctor"
"""Command that ends with 1 where the host has a fault, as most hosts do."""
PATIENCE_S = 900.0
FEWEST = 6
"""Least number of complete commands in README; fewer mean that COMMAND no longer finds them."""


def readme_commands() -> list[str]:
    """Return the complete commands of README; the commands that read a recording come last."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    commands = [command for command in dict.fromkeys(COMMAND.findall(text)) if COMPLETE.search(command)]
    return ["rtloop laws", "rtloop drivers", *sorted(commands, key=lambda command: "recordings/" in command)]


def install_wheel(folder: Path, pip_args: list[str]) -> Path:
    """Build the wheel and install it into a fresh environment; return its folder of programs."""
    wheel = build("wheel", copy_tree(folder / "source"), folder / "dist")
    venv.create(folder / "venv", with_pip=True)
    programs = folder / "venv" / "bin"
    constraints = ["--constraint", str(ROOT / "constraints.txt")]
    command = [str(programs / "python"), "-m", "pip", "install", "--quiet", *pip_args, *constraints, f"{wheel}[design]"]
    subprocess.run(command, check=True, cwd=folder)
    return programs


def run_command(command: str, programs: Path, folder: Path) -> bool:
    """Run a command of README in `folder`; print it with its exit code. Returns whether it succeeded."""
    recording = next(iter(sorted(folder.glob("recordings/*.mcap"))), None)
    arguments = shlex.split(command.replace("recordings/FILE.mcap", str(recording)))
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    result = subprocess.run(
        [str(programs / arguments[0]), *arguments[1:]], cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S,
        env=environment | {"XDG_CACHE_HOME": str(folder / "cache"), "MPLBACKEND": "agg"},
    )  # fmt: skip
    print(f"{result.returncode:3}  {command}", flush=True)
    is_expected = result.returncode == 0 or (result.returncode == 1 and command.startswith(JUDGES_HOST))
    if not is_expected or "Traceback" in result.stderr:
        print(result.stderr[-2000:])
        return False
    return True


def main() -> int:
    """Run all commands, then the long tests of tests/packaging; return 0 if none fails or shows a traceback."""
    parser = argparse.ArgumentParser(prog="wheel", description=__doc__)
    parser.add_argument("--pip-args", type=shlex.split, default=[], help="For pip, where there is no network.")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "place"
        shutil.copytree(ROOT / "deploy", folder / "deploy")
        programs = install_wheel(Path(name), options.pip_args)
        results = []
        for command in readme_commands():
            if command.removeprefix("rtloop ").startswith(SKIPPED):
                print(f"skipped: {command}")
            else:
                results.append(run_command(command, programs, folder))
    if not all(results) or len(results) < FEWEST:
        return 1
    return pytest.main(["-m", "soak", str(ROOT / "tests/packaging")])


if __name__ == "__main__":
    sys.exit(main())
