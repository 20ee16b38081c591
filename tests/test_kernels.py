"""Kernels stand only where the compilation cache looks: elsewhere an edit could leave old code running."""

from __future__ import annotations

import ast
import shutil
from collections.abc import Iterable
from pathlib import Path

import pytest

import rtloop
from rtloop.foundation.native import cache
from rtloop.foundation.native.cache import ROOMS, WHOLE, kernel_sources, source_digest
from tests.test_opened_files import sources

PACKAGE = Path(rtloop.__file__).parent
COMPILERS = {
    *("jit", "jit_checked", "jit_inline", "jit_rare", "jit_rare_checked", "jit_strict"),
    *("cfunc", "intrinsic", "intrinsic_like", "python_entry"),
}


def imported(path: Path) -> list[ast.ImportFrom]:
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]


def compiles(path: Path) -> bool:
    """Whether a file imports one of the decorators that compile."""
    return any(
        (node.module or "").endswith(".compiled") and COMPILERS & {alias.name for alias in node.names}
        for node in imported(path)
    )


@pytest.fixture(scope="module")
def covered() -> set[Path]:
    """Files that the digest covers, which names the cache."""
    return {PACKAGE / name for name, _ in kernel_sources()}


def names_in(nodes: Iterable[ast.AST]) -> set[str]:
    return {name.id for node in nodes for name in ast.walk(node) if isinstance(name, ast.Name)}


def kernel_names(path: Path) -> set[str]:
    """Names in a file's kernels, and in the values that the file computes when it is imported."""
    tree = ast.parse(path.read_text())
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    kernels = [function for function in functions if COMPILERS & names_in(function.decorator_list)]
    values = [node.value for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value]
    return names_in([*(statement for kernel in kernels for statement in kernel.body), *values])


def test_all_kernels_are_in_the_digest(covered: set[Path]) -> None:
    kernels = [path for path in sources() if compiles(path)]
    assert len(kernels) > 20
    assert covered.issuperset(kernels)


def test_kernels_use_nothing_from_outside_the_digest(covered: set[Path]) -> None:
    """Functions and constants that a kernel uses are in the digest of the cache, as the kernel is."""
    for path in sorted(covered):
        names = kernel_names(path)
        for node in imported(path):
            used = names & {alias.asname or alias.name for alias in node.names}
            if used and (node.module or "").startswith("rtloop."):
                place = PACKAGE.joinpath(*str(node.module).split(".")[1:])
                files = [place / f"{name}.py" for name in used] if place.is_dir() else [place.with_suffix(".py")]
                assert covered.issuperset(filter(Path.is_file, files)), (path, node.module, used)


@pytest.mark.parametrize(
    ("name", "recompiles"),
    [
        *(("hil/options.py", False), ("configuration/axis.py", False), ("drivers/node/link.py", False)),
        *(("kernel/step.py", True), ("laws/shipped/pid.py", True), ("drivers/node/exchange.py", True)),
        *(("hil/stages/creep.py", True), ("foundation/native/word_access.py", True)),
    ],
)
def test_an_edit_of_a_kernel_recompiles(name, recompiles, tmp_path, monkeypatch) -> None:
    for place in ("configuration", *ROOMS, *WHOLE):
        copied = shutil.copytree if (PACKAGE / place).is_dir() else shutil.copy
        if not (tmp_path / place).exists():
            (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
            copied(PACKAGE / place, tmp_path / place)
    monkeypatch.setattr(cache, "PACKAGE", tmp_path)
    before = source_digest()
    (tmp_path / name).write_text((tmp_path / name).read_text() + '"""An edited text."""\n')
    assert (source_digest() != before) == recompiles
