"""Kernels stand only where the compilation cache looks: elsewhere an edit could leave old code running."""

from __future__ import annotations

import ast
from pathlib import Path

import rtloop
from rtloop.hil.native.compiled import KERNELS

PACKAGE = Path(rtloop.__file__).parent
COMPILERS = {"jit", "cfunc", "inlined", "seldom", "intrinsic", "guarded", "seldom_guarded"}


def sources() -> list[Path]:
    """Every module of the package; two of its rooms are links to folders beside it."""
    rooms = [path for path in PACKAGE.iterdir() if path.is_dir()]
    return [*PACKAGE.glob("*.py"), *(path for room in rooms for path in room.rglob("*.py"))]


def imported(path: Path) -> list[ast.ImportFrom]:
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]


def compiles(path: Path) -> bool:
    """Whether a file imports one of the decorators that compile."""
    return any(
        (node.module or "").endswith(".compiled") and COMPILERS & {alias.name for alias in node.names}
        for node in imported(path)
    )


def seen(path: Path) -> bool:
    return any(PACKAGE / place in (path, *path.parents) for place in KERNELS)


def test_kernels_stand_where_the_cache_looks() -> None:
    found = [path for path in sources() if compiles(path)]
    assert len(found) > 20
    assert all(seen(path) for path in found)


def test_kernels_import_nothing_of_the_project_from_elsewhere() -> None:
    """What a kernel is made from, too, must be in the digest."""
    for path in sources():
        if not compiles(path):
            continue
        for module in (node.module or "" for node in imported(path)):
            if module.startswith("rtloop."):
                place = PACKAGE.joinpath(*module.split(".")[1:])
                assert seen(place if place.is_dir() else place.with_suffix(".py")), (path, module)
