"""Kernels stand only where the compilation cache looks: elsewhere an edit could leave old code running."""

from __future__ import annotations

import ast
import shutil
from collections.abc import Iterable
from pathlib import Path

import pytest

import rtloop
from rtloop.foundation.native import cache
from rtloop.foundation.native.cache import KERNELS, OPTIONS, source_digest

PACKAGE = Path(rtloop.__file__).parent
COMPILERS = {"jit", "cfunc", "jit_inline", "jit_rare", "intrinsic", "jit_checked", "jit_rare_checked"}


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
    """Whether the digest that names the cache covers a file."""
    return path.name != OPTIONS and any(PACKAGE / place in (path, *path.parents) for place in KERNELS)


def names_in(nodes: Iterable[ast.AST]) -> set[str]:
    return {name.id for node in nodes for name in ast.walk(node) if isinstance(name, ast.Name)}


def made_from(path: Path) -> set[str]:
    """Names in a file's kernels, and in the values that the file computes when it is imported."""
    tree = ast.parse(path.read_text())
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    kernels = [function for function in functions if COMPILERS & names_in(function.decorator_list)]
    values = [node.value for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value]
    return names_in([*kernels, *values])


def test_kernels_stand_where_the_cache_looks() -> None:
    found = [path for path in sources() if compiles(path)]
    assert len(found) > 20
    assert all(seen(path) for path in found)


def test_kernels_are_made_from_nothing_that_stands_elsewhere() -> None:
    """Neither a function nor a constant: what a kernel is made from must be in the digest, too."""
    for path in filter(compiles, sources()):
        made = made_from(path)
        assert made
        for node in imported(path):
            if not (node.module or "").startswith("rtloop."):
                continue
            place = PACKAGE.joinpath(*str(node.module).split(".")[1:])
            if not seen(place if place.is_dir() else place.with_suffix(".py")):
                assert not made & {alias.asname or alias.name for alias in node.names}, (path, node.module)


@pytest.mark.parametrize(
    ("name", "recompiles"), [("hil/options.py", False), ("configuration/axis.py", False), ("law/law.py", True)]
)
def test_what_an_edit_makes_anew(name, recompiles, tmp_path, monkeypatch) -> None:
    for place in (*KERNELS, "configuration/axis.py"):
        copied = shutil.copytree if (PACKAGE / place).is_dir() else shutil.copy
        (tmp_path / place).parent.mkdir(exist_ok=True)
        copied(PACKAGE / place, tmp_path / place)
    monkeypatch.setattr(cache, "PACKAGE", tmp_path)
    before = source_digest()
    (tmp_path / name).write_text((tmp_path / name).read_text() + '"""An edited text."""\n')
    assert (source_digest() != before) == recompiles
