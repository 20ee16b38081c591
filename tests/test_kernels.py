"""Kernels stand only where the compilation cache looks: elsewhere an edit could leave old code running."""

from __future__ import annotations

import ast
from pathlib import Path

from hil.compiled import KERNELS

ROOT = Path(__file__).resolve().parent.parent
COMPILERS = {"jit", "cfunc", "inlined", "seldom", "intrinsic"}


def compiles(path: Path) -> bool:
    """Whether a file imports one of the decorators that compile."""
    imports = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
    return any(node.module == "hil.compiled" and COMPILERS & {alias.name for alias in node.names} for node in imports)


def test_kernels_stand_where_the_cache_looks() -> None:
    places = [ROOT / place for place in KERNELS]
    sources = [path for package in ("hil", "drivers", "rtloop") for path in (ROOT / package).rglob("*.py")]
    found = [path for path in sources if compiles(path)]
    assert len(found) > 10
    assert all(any(place in (path, *path.parents) for place in places) for path in found)


def test_kernels_import_nothing_of_the_project_from_elsewhere() -> None:
    """What a kernel is made from, too, must be in the digest."""
    for path in [path for package in ("hil", "rtloop/engine", "rtloop/law") for path in (ROOT / package).rglob("*.py")]:
        if not compiles(path):
            continue
        modules = [
            node.module or "" for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)
        ]
        for module in (module for module in modules if module.split(".")[0] in ("rtloop", "drivers", "hil")):
            assert module.replace(".", "/").startswith(
                ("hil", "drivers", "rtloop/law", "rtloop/engine", "rtloop/signals")
            )
