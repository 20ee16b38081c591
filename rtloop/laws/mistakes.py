"""Mistakes in the text of somebody's own law, found before anything of it is compiled: one sentence, with its line.

Looked at are `output`, `update` and `enter` where a class defines them: their parameters, what they ask of their
records, names that nobody defined, a missing `return`, calls that would wait. The compiler finds the same, and more,
in words of its own.
"""

from __future__ import annotations

import ast
import builtins
from collections.abc import Collection, Iterator, Mapping
from difflib import get_close_matches
from typing import Any, NamedTuple

from rtloop.law.layout import told_by
from rtloop.laws.contract import Feedforward, Law

WAITING = {"print", "open", "input", "exec", "eval", "__import__", "breakpoint"}
"""Builtin functions that a tick has no time for."""
USUAL = {"np": "import numpy as np", "numpy": "import numpy", "math": "import math"}
HIDDEN = {"reserved", "scratch"}
"""Fields of records that are not the law's."""


class Mistake(NamedTuple):
    """A line of the text, and what is wrong there."""

    line: int
    what: str


def mistakes(text: str, names: Mapping[str, Any]) -> Iterator[Mistake]:
    """In the laws of a text, in the order of their lines; `names` are those that it defines when it is run."""
    for node in ast.parse(text).body:
        law = names.get(node.name) if isinstance(node, ast.ClassDef) else None
        if isinstance(node, ast.ClassDef) and isinstance(law, type) and issubclass(law, Law):
            for function in node.body:
                if isinstance(function, ast.FunctionDef) and function.name in ("output", "update", "enter"):
                    yield from sorted(_in_function(function, law, names))


def _in_function(function: ast.FunctionDef, law: type[Law], names: Mapping[str, Any]) -> Iterator[Mistake]:
    feedforward = issubclass(law, Feedforward)
    wanted = ["c", "s", "command_um" if function.name == "output" else "drive_v"] if feedforward else ["c", "s", "told"]
    given = [one.arg for one in function.args.args]
    if len(given) != len(wanted):
        extra = ", without `self`: it has only what it is given" if given[:1] == ["self"] else ""
        yield Mistake(function.lineno, f"{function.name}({', '.join(given)}): {function.name}({', '.join(wanted)}) is "
                      f"needed{extra}")  # fmt: skip
        return
    records = law.records(max(law.axes, 1)) if not feedforward else law.records()
    fields = {given[0]: ("coefficients", records.coefficients.names), given[1]: ("state", records.state.names)}
    if not feedforward:
        fields[given[2]] = ("what it is told", told_by(max(law.axes, 1)).names)
    yield from _unknown_fields(function, fields)
    yield from _unknown_names(function, given, names)
    if _must_return(function, law) and not any(isinstance(one, ast.Return) and one.value for one in ast.walk(function)):
        yield Mistake(function.lineno, f"{function.name} returns nothing: a `return` is missing")


def _must_return(function: ast.FunctionDef, law: type[Law]) -> bool:
    """A coupled controller sets commands in place of returning one."""
    if issubclass(law, Feedforward):
        return function.name in ("output", "update")
    raises = any(isinstance(one, ast.Raise) for one in ast.walk(function))
    return function.name == "output" and law.axes == 1 and not raises


def _unknown_fields(
    function: ast.FunctionDef, fields: Mapping[str, tuple[str, tuple[str, ...] | None]]
) -> Iterator[Mistake]:
    for node in ast.walk(function):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in fields:
            which, known = fields[node.value.id]
            there = [name for name in known or () if name not in HIDDEN]
            if node.attr not in (known or ()):
                said = f"{node.value.id}.{node.attr}: not among {'its ' if which != 'what it is told' else ''}{which}"
                yield Mistake(node.lineno, f"{said}{_meant(node.attr, there)}")


def _unknown_names(function: ast.FunctionDef, given: Collection[str], names: Mapping[str, Any]) -> Iterator[Mistake]:
    nodes = [node for node in ast.walk(function) if isinstance(node, ast.Name)]
    own = {*given, *(node.id for node in nodes if not isinstance(node.ctx, ast.Load))}
    for node in nodes:
        if node.id in own or node.id in names:
            continue
        if node.id in WAITING:
            yield Mistake(node.lineno, f"{node.id}: it may wait, and a tick cannot")
        elif not hasattr(builtins, node.id):
            usual = f"; `{USUAL[node.id]}` at the top of the file?" if node.id in USUAL else ""
            yield Mistake(node.lineno, f"{node.id}: nothing has this name{usual or _meant(node.id, [*own, *names])}")


def _meant(name: str, known: Collection[str]) -> str:
    """What was meant, as far as a name like it is known; else all that is known, where that is little."""
    near = get_close_matches(name, [one for one in known if not one.startswith("_")], 1)
    return f"; {near[0]} is meant?" if near else f"; there are {', '.join(known)}" if 0 < len(known) <= 12 else ""
