"""Texts in the source below the fields of classes: they describe the keys in JSON Schema and in the reference."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Sequence
from functools import cache


def texts_below(owner: type) -> dict[str, str]:
    """Return the string below each field or member of a class and of its bases in this project, by its name.

    The text of a class replaces the text of its base for the same field.
    """
    texts: dict[str, str] = {}
    for base in reversed(owner.__mro__):
        if base.__module__.startswith("rtloop."):
            texts |= _texts_of_module(base.__module__).get(base.__name__, {})
    return texts


@cache
def _texts_of_module(name: str) -> dict[str, dict[str, str]]:
    """Return the string below each field of each class of a module, by the names of class and field."""
    tree = ast.parse(inspect.getsource(sys.modules[name]))
    return {node.name: _texts_of_body(node.body) for node in tree.body if isinstance(node, ast.ClassDef)}


def _texts_of_body(statements: Sequence[ast.stmt]) -> dict[str, str]:
    """Return the string that follows each assignment in the body of a class, by the assigned name."""
    texts: dict[str, str] = {}
    name = ""
    for statement in statements:
        if name and isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
            texts[name] = inspect.cleandoc(str(statement.value.value))
        target = statement.targets[0] if isinstance(statement, ast.Assign) else getattr(statement, "target", None)
        name = target.id if isinstance(target, ast.Name) else ""
    return texts
