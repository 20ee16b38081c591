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
from tests.test_opened_files import sources

PACKAGE = Path(rtloop.__file__).parent
COMPILERS = {"jit", "cfunc", "jit_inline", "jit_rare", "intrinsic", "jit_checked", "jit_rare_checked"}


def imported(path: Path) -> list[ast.ImportFrom]:
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]


def compiles(path: Path) -> bool:
    """Whether a file imports one of the decorators that compile."""
    return any(
        (node.module or "").endswith(".compiled") and COMPILERS & {alias.name for alias in node.names}
        for node in imported(path)
    )


def is_in_digest(path: Path) -> bool:
    """Whether the digest that names the cache covers a file."""
    return path.name != OPTIONS and any(PACKAGE / place in (path, *path.parents) for place in KERNELS)


def names_in(nodes: Iterable[ast.AST]) -> set[str]:
    return {name.id for node in nodes for name in ast.walk(node) if isinstance(name, ast.Name)}


def kernel_names(path: Path) -> set[str]:
    """Names in a file's kernels, and in the values that the file computes when it is imported."""
    tree = ast.parse(path.read_text())
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    kernels = [function for function in functions if COMPILERS & names_in(function.decorator_list)]
    values = [node.value for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value]
    return names_in([*kernels, *values])


def test_all_kernels_are_in_the_digest() -> None:
    kernels = [path for path in sources() if compiles(path)]
    assert len(kernels) > 20
    assert all(is_in_digest(path) for path in kernels)


def test_kernels_use_nothing_from_outside_the_digest() -> None:
    """Functions and constants that a kernel uses are in the digest of the cache, as the kernel is."""
    for path in filter(compiles, sources()):
        names = kernel_names(path)
        assert names
        for node in imported(path):
            if not (node.module or "").startswith("rtloop."):
                continue
            place = PACKAGE.joinpath(*str(node.module).split(".")[1:])
            if not is_in_digest(place if place.is_dir() else place.with_suffix(".py")):
                assert not names & {alias.asname or alias.name for alias in node.names}, (path, node.module)


@pytest.mark.parametrize(
    ("name", "recompiles"), [("hil/options.py", False), ("configuration/axis.py", False), ("kernel/step.py", True)]
)
def test_an_edit_of_a_kernel_room_recompiles(name, recompiles, tmp_path, monkeypatch) -> None:
    for place in (*KERNELS, "configuration/axis.py"):
        copied = shutil.copytree if (PACKAGE / place).is_dir() else shutil.copy
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        copied(PACKAGE / place, tmp_path / place)
    monkeypatch.setattr(cache, "PACKAGE", tmp_path)
    before = source_digest()
    (tmp_path / name).write_text((tmp_path / name).read_text() + '"""An edited text."""\n')
    assert (source_digest() != before) == recompiles
