"""Code of a documentation page: fenced blocks, and their execution in one folder, in the order of the page."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FENCE = re.compile(r"^```([a-z]+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ANY_TEXT = "…"
"""Placeholder for any text in an expected line."""


@dataclass(frozen=True)
class Block:
    """Fenced block of a page: its language, the name of its file (or ""), and its text."""

    language: str
    file: str
    text: str


def blocks(page: Path) -> list[Block]:
    """Return the fenced blocks of a page in order."""
    return [Block(*match.groups(default="")) for match in FENCE.finditer(page.read_text(encoding="utf-8"))]


def commands(console: str) -> Iterator[tuple[str, list[str]]]:
    """Yield (command, expected lines) of a block `console`; a command starts with "$ " and continues after a "\\"."""
    lines = iter(console.splitlines())
    command, expected = "", []
    for line in lines:
        if not line.startswith("$ "):
            expected.append(line)
            continue
        if command:
            yield command, expected
        command, expected = line.removeprefix("$ "), []
        while command.endswith("\\"):
            command += "\n" + next(lines)
    yield command, expected


def missing_line(expected: list[str], output: str) -> str | None:
    """Return the first expected line that does not follow the earlier ones in `output`; None if all do.

    Several blanks count as one blank; ANY_TEXT matches any text of a line.
    """
    lines = iter([" ".join(line.split()) for line in output.splitlines()])
    for line in expected:
        pattern = ".*".join(re.escape(part.strip()) for part in " ".join(line.split()).split(ANY_TEXT))
        if line.strip() and not any(re.fullmatch(pattern, candidate) for candidate in lines):
            return line
    return None


def run_page(page: Path, folder: Path) -> None:
    """Execute the blocks of a page in `folder`: files are written, commands and scripts run.

    Raises AssertionError for a command that fails, and for an expected line that the output lacks.
    """
    environment = program_environment(folder)
    for block in blocks(page):
        if block.file:
            (folder / block.file).write_text(block.text, encoding="utf-8")
        elif block.language == "python":
            _run([sys.executable, "-c", block.text], folder, environment)
        elif block.language == "console":
            for command, expected in commands(block.text):
                output = _run(["bash", "-euo", "pipefail", "-c", command], folder, environment)
                missing = missing_line(expected, output)
                assert missing is None, f"{page.name}: $ {command}\nlacks: {missing}\nprinted:\n{output}"


def program_environment(folder: Path) -> dict[str, str]:
    """Create `rtloop` and `python3` of the tests' interpreter beside `folder`; return an environment with them."""
    programs = folder.parent / f"{folder.name}-programs"
    programs.mkdir()
    for name, arguments in (("rtloop", " -m rtloop"), ("python3", "")):
        program = programs / name
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}"{arguments} "$@"\n')
        program.chmod(0o755)
    return os.environ | {
        "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "MPLBACKEND": "agg",
        "COLUMNS": "160",
    }


def _run(command: list[str], folder: Path, environment: dict[str, str]) -> str:
    """Return standard output and error of a command, together. Raises AssertionError if it does not end with 0."""
    completed = subprocess.run(
        command, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=120
    )
    assert completed.returncode == 0, f"{command[-1]}\nended with {completed.returncode}:\n{completed.stdout}"
    return completed.stdout
