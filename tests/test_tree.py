"""The tree keeps what its texts say: no circles of files, and every path, command and name in the docs exists."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import defaultdict
from functools import cache
from importlib import import_module
from pathlib import Path

import click
import grimp
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rtloop.cli import main
from tests.soak.__main__ import LONG_TESTS

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = sorted(path for top in ("rtloop", "drivers", "hil") for path in (ROOT / top).rglob("*.py"))
DOCS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("**/*.md"))]
PATH = re.compile(r"(?<![\w/.~-])(?:rtloop|drivers|hil|tests|deploy|docs)/[\w./-]*[\w/]")
MAKE = re.compile(r"`make ([a-z-]+)(?: NAME=([a-z-]+))?")
COMMAND = re.compile(r"`rtloop ((?:[a-z][a-z-]* ?)+)")
IMPORT = re.compile(r"^ *from (rtloop[\w.]*) import ([\w, ]+)$", re.MULTILINE)
NAME = re.compile(r"`(?:[\w.]+\.)?(_?[A-Za-z]\w*)(?:\(\))?`")
FOREIGN = {"fastmath", "shared_memory", "py", "msg"}
"""Names that documentation mentions and that this tree does not define: of numba, of Python, of files and of ROS."""


def test_no_files_import_each_other_in_a_circle():
    graph = grimp.build_graph("rtloop")
    modules = sorted(graph.modules)
    number = {module: i for i, module in enumerate(modules)}
    arrows = [
        (number[module], number[imported])
        for module in modules
        for imported in graph.find_modules_directly_imported_by(module)
    ]
    rows, columns = np.array(arrows).T
    matrix = coo_array((np.ones(len(arrows)), (rows, columns)), shape=(len(modules), len(modules)))
    _, labels = connected_components(matrix, directed=True, connection="strong")
    circles = defaultdict(list)
    for module, label in zip(modules, labels, strict=True):
        circles[label].append(module)
    assert [circle for circle in circles.values() if len(circle) > 1] == []


@cache
def _docstrings(path: Path) -> list[tuple[str, str]]:
    """Return (place, text) of each docstring and of each string below a constant or a field."""
    return [
        (f"{path.relative_to(ROOT)}:{node.lineno}", node.value.value)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]


def _texts() -> list[tuple[str, str]]:
    """Return (place, text) of all documentation: pages, and docstrings of the product."""
    pages = [(str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")) for path in DOCS]
    return pages + [text for path in PRODUCT for text in _docstrings(path)]


def test_paths_in_the_documentation_exist():
    missing = {
        f"{place}: {match}"
        for place, text in _texts()
        for match in PATH.findall(text)
        if not (ROOT / match).exists() and not list(ROOT.glob(f"{match}*")) and match.split("/")[1] not in FOREIGN
    }
    assert not missing


def test_files_that_the_architecture_names_exist():
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    names = re.findall(r"`([\w/]+(?:/|\.py))`", text)
    assert len(names) > 20
    assert [name for name in names if not any((ROOT / top / name).exists() for top in ("", "rtloop"))] == []


def test_make_targets_in_the_documentation_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.search(r"^\.PHONY: (.*)$", makefile, re.MULTILINE)[1].split())
    missing = {
        f"{place}: {target} {name}"
        for place, text in _texts()
        for target, name in MAKE.findall(text)
        if target not in targets or (name and name not in LONG_TESTS)
    }
    assert not missing


def test_commands_in_the_documentation_exist():
    missing = set()
    for place, text in _texts():
        for words in COMMAND.findall(text):
            command: click.Command = main
            for word in words.split():
                if not isinstance(command, click.Group):
                    break
                if (subcommand := command.get_command(click.Context(command), word)) is None:
                    missing.add(f"{place}: rtloop {words}")
                    break
                command = subcommand
    assert not missing


def test_imports_in_the_documentation_work():
    imports = {
        (str(path.relative_to(ROOT)), module, name.strip())
        for path in DOCS
        for module, names in IMPORT.findall(path.read_text(encoding="utf-8"))
        for name in names.split(",")
    }
    assert imports
    missing = {entry for entry in imports if not hasattr(import_module(entry[1]), entry[2])}
    assert not missing


@cache
def _known_names() -> frozenset[str]:
    """Return all names in the tree's Python code, every string that is one word, and the names of files and folders."""
    names = set()
    for path in [*PRODUCT, *(ROOT / "tests").rglob("*.py")]:
        text = path.read_text(encoding="utf-8")
        names |= {token.string for token in tokenize.generate_tokens(io.StringIO(text).readline) if token.type == 1}
        names |= set(re.findall(r"""["']([A-Za-z_]\w*)["']""", text))
        names |= {path.stem, *path.relative_to(ROOT).parts[:-1]}
    return frozenset(names)


@pytest.mark.parametrize("room", sorted({path.relative_to(ROOT).parts[:2] for path in PRODUCT}), ids="/".join)
def test_names_in_docstrings_exist(room: tuple[str, str]):
    inside = (path for path in PRODUCT if path.relative_to(ROOT).parts[:2] == room)
    missing = {
        f"{place}: {name}"
        for path in inside
        for place, text in _docstrings(path)
        for name in NAME.findall(text)
        if name not in _known_names() | FOREIGN and not name.endswith(("_min", "_max", "_mean"))
    }
    assert not missing


@pytest.mark.parametrize("bench", ["tests.faults.bench", "tests.panel.web.browser", "tests.epics.bench",
                                   "tests.panel.page.station", "tests.node.node_process"])  # fmt: skip
def test_what_starts_real_processes_has_the_mark_of_the_system(bench: str):
    """Without the mark `make test` would run it, in real time."""
    files = [file for file in (ROOT / "tests").rglob("test_*.py") if f"from {bench} import" in file.read_text()]
    assert files
    assert [file.name for file in files if "mark.system" not in file.read_text()] == []
