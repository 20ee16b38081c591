"""Mistakes in `output`, `update` and `enter` of somebody's own law, read from its text.

Parameters, fields of the records, names that are not defined, what is returned, and calls that would wait.
"""

from __future__ import annotations

import ast
import builtins
from collections.abc import Collection, Iterator, Mapping
from difflib import get_close_matches
from typing import Any, NamedTuple

from rtloop.kernel.layout import control_dtype
from rtloop.laws.contract import Feedforward, Law

PER_TICK = ("output", "update", "enter")
"""Functions of a law that are compiled."""
WAITING = {"print", "open", "input", "exec", "eval", "__import__", "breakpoint"}
"""Builtin functions that a tick has no time for."""
REMEDIES = {
    "np": "; add `import numpy as np` at the top of the file",
    "numpy": "; add `import numpy` at the top of the file",
    "math": "; add `import math` at the top of the file",
    "self": f"; {', '.join(PER_TICK)} have no self: `build` gives the numbers that they need as coefficients",
}
"""For names that are often not defined."""
HIDDEN = {"reserved", "scratch"}
"""Fields of records that are not the law's."""
MOST_LISTED = 12


class Mistake(NamedTuple):
    """A line of the text, and the sentence about it."""

    line: int
    what: str


class _Parameter(NamedTuple):
    """A record that a function gets: the noun for a field of it, its fields, and whether the function may set them."""

    noun: str
    fields: tuple[str, ...]
    settable: bool


def mistakes_in_function(function: ast.FunctionDef, law: type[Law], names: Mapping[str, Any]) -> Iterator[Mistake]:
    """Yield the mistakes in one function of a law; `names` are those that the module defines."""
    feedforward = issubclass(law, Feedforward)
    last = "told" if not feedforward else "command_um" if function.name == "output" else "drive_v"
    needed, given = ["c", "s", last], [one.arg for one in function.args.args]
    if len(given) != len(needed) or (set(given) == set(needed) and given != needed):
        without = ", without self" if given[:1] == ["self"] else ""
        signature, right = (f"{function.name}({', '.join(one)})" for one in (given, needed))
        yield Mistake(function.lineno, f"{signature}: {right} is needed{without}")
        return
    records = law.records(max(law.axes, 1)) if not feedforward else law.records()
    parameters = {
        given[0]: _Parameter("coefficient", records.coefficients.names or (), False),
        given[1]: _Parameter("state", records.state.names or (), True),
    }
    if not feedforward:
        parameters[given[2]] = _Parameter("signal", control_dtype(max(law.axes, 1)).names or (), False)
    yield from _wrong_fields(function, parameters)
    yield from _unknown_names(function, given, names)
    yield from _wrong_returns(function, law)


def _wrong_fields(function: ast.FunctionDef, parameters: Mapping[str, _Parameter]) -> Iterator[Mistake]:
    for node in ast.walk(function):
        if not (isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in parameters):
            continue
        record, (noun, fields, settable) = node.value.id, parameters[node.value.id]
        field = f"{record}.{node.attr}"
        if node.attr not in fields:
            known = [f"{record}.{name}" for name in fields if name not in HIDDEN]
            yield Mistake(node.lineno, f"{field}: unknown {noun}{_suggestion(field, known)}")
        elif not settable and not isinstance(node.ctx, ast.Load):
            yield Mistake(node.lineno, f"{field}: a {noun} cannot be set; keep the value in the state")


def _unknown_names(function: ast.FunctionDef, given: Collection[str], names: Mapping[str, Any]) -> Iterator[Mistake]:
    nodes = [node for node in ast.walk(function) if isinstance(node, ast.Name)]
    own = {*given, *(node.id for node in nodes if not isinstance(node.ctx, ast.Load))}
    for node in nodes:
        if node.id in own or node.id in names:
            continue
        if node.id in WAITING:
            yield Mistake(node.lineno, f"{node.id}: may wait, and a tick must not wait")
        elif not hasattr(builtins, node.id):
            remedy = REMEDIES.get(node.id) or _suggestion(node.id, [*own, *names])
            yield Mistake(node.lineno, f"{node.id}: is not defined{remedy}")


def _wrong_returns(function: ast.FunctionDef, law: type[Law]) -> Iterator[Mistake]:
    """A coupled controller sets commands in place of returning one."""
    nodes = list(ast.walk(function))
    values = [one for one in nodes if isinstance(one, ast.Return) and one.value is not None]
    if function.name == "output":
        returns = issubclass(law, Feedforward) or law.axes == 1
    else:
        returns = issubclass(law, Feedforward) and function.name == "update"
    if returns and not values and not any(isinstance(one, ast.Raise) for one in nodes):
        yield Mistake(function.lineno, f"{function.name} returns nothing; a `return` with a number is missing")
    if not returns and values:
        yield Mistake(values[0].lineno, f"{function.name} returns a value; it must return nothing")


def _suggestion(name: str, known: Collection[str]) -> str:
    """Suggest the known name that is like `name`; else list the known names, where they are few."""
    near = get_close_matches(name, [one for one in known if not one.startswith("_")], 1)
    return (
        f"; did you mean {near[0]}?"
        if near
        else f"; known: {', '.join(known)}"
        if 0 < len(known) <= MOST_LISTED
        else ""
    )
