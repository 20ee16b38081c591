"""Mistakes in `output`, `update` and `enter` of a user law, found in its text.

They concern parameters, fields of the records, undefined names, returned values, and calls that would wait.
"""

from __future__ import annotations

import ast
import builtins
from collections.abc import Collection, Iterator, Mapping
from difflib import get_close_matches
from typing import NamedTuple

from rtloop.kernel.layout import control_dtype
from rtloop.laws.contract import Feedforward, Law

PER_TICK = ("output", "update", "enter")
"""Functions of a law that are compiled."""
WAITING = {"print", "open", "input", "exec", "eval", "__import__", "breakpoint"}
"""Builtin functions that may wait, which a tick must not."""
REMEDIES = {
    "np": "; add `import numpy as np` at the top of the file",
    "numpy": "; add `import numpy` at the top of the file",
    "math": "; add `import math` at the top of the file",
    "self": f"; {', '.join(PER_TICK)} have no self: let `build` return the number as a coefficient, and read c.NAME",
}
"""Remedy for a name that is often undefined."""
HIDDEN = {"reserved", "scratch"}
"""Fields of records that belong to the loop."""
MOST_LISTED = 12
"""Largest number of known names that a message lists."""


class Mistake(NamedTuple):
    """Mistake in the text of a law: line and message."""

    line: int
    message: str


class _Parameter(NamedTuple):
    """Record that a function receives: the noun for a field, the fields, and whether the function may set them.

    `undefined` are the fields without a value in the function.
    """

    noun: str
    fields: tuple[str, ...]
    settable: bool
    undefined: tuple[str, ...] = ()


def mistakes_in_function(function: ast.FunctionDef, law: type[Law], names: Mapping[str, object]) -> Iterator[Mistake]:
    """Yield the mistakes in one function of a law; if number or order of the parameters is wrong, this alone.

    `names` are the names that the function's module defines.
    """
    feedforward = issubclass(law, Feedforward)
    last = "told" if not feedforward else "command_um" if function.name == "output" else "drive_v"
    needed, parameters = ["c", "s", last], [argument.arg for argument in function.args.args]
    if len(parameters) != len(needed) or (set(parameters) == set(needed) and parameters != needed):
        without = ", without self" if parameters[:1] == ["self"] else ""
        signature, right = (f"{function.name}({', '.join(names)})" for names in (parameters, needed))
        yield Mistake(function.lineno, f"{signature}; allowed: {right}{without}")
        return
    records = law.records(max(law.axes, 1)) if not feedforward else law.records()
    kinds = [
        _Parameter("coefficient", records.coefficients.names or (), False),
        _Parameter("state", records.state.names or (), True),
    ]
    if not feedforward:
        signals = control_dtype(max(law.axes, 1)).names or ()
        kinds.append(_Parameter("signal", signals, False, _undefined_signals(function, law)))
    yield from _wrong_fields(function, dict(zip(parameters, kinds, strict=False)))
    yield from _unknown_names(function, parameters, names)
    yield from _wrong_returns(function, law)


def _undefined_signals(function: ast.FunctionDef, law: type[Law]) -> tuple[str, ...]:
    """Return the names of a controller's signals that have no value yet in a function: () for `update` and `enter`.

    In `output` they are command_um and applied_um; in a coupled controller's only applied_um, as it sets command_um.
    """
    if function.name != "output":
        return ()
    return ("command_um", "applied_um") if law.axes == 1 else ("applied_um",)


def _wrong_fields(function: ast.FunctionDef, parameters: Mapping[str, _Parameter]) -> Iterator[Mistake]:
    """Yield a mistake for each unknown field of a record, and for each field that must not be read or set."""
    for node in ast.walk(function):
        if not (isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in parameters):
            continue
        record, (noun, fields, settable, undefined) = node.value.id, parameters[node.value.id]
        field = f"{record}.{node.attr}"
        if node.attr not in fields:
            known_fields = [f"{record}.{name}" for name in fields if name not in HIDDEN]
            yield Mistake(node.lineno, f"{field}: unknown {noun}{_suggestion(field, known_fields)}")
        elif not settable and not isinstance(node.ctx, ast.Load):
            yield Mistake(node.lineno, f"{field}: a {noun} cannot be set; store the value in the state")
        elif node.attr in undefined:
            allowed = ", ".join(f"{record}.{name}" for name in fields if name not in (*undefined, "outputs"))
            message = (
                f"{field}: has no value in the function {function.name}, only in the functions update and enter; "
                f"allowed here: {allowed}"
            )
            yield Mistake(node.lineno, message)


def _unknown_names(
    function: ast.FunctionDef, parameters: Collection[str], names: Mapping[str, object]
) -> Iterator[Mistake]:
    """Yield a mistake for each name that is undefined, and for each builtin function of WAITING, such as `open`.

    Defined are the function's `parameters` and own variables, the `names` of its module, and Python's builtins.
    """
    nodes = [node for node in ast.walk(function) if isinstance(node, ast.Name)]
    local_names = {*parameters, *(node.id for node in nodes if not isinstance(node.ctx, ast.Load))}
    for node in nodes:
        if node.id in local_names or node.id in names:
            continue
        if node.id in WAITING:
            yield Mistake(node.lineno, f"{node.id} may wait, and a tick must not wait")
        elif not hasattr(builtins, node.id):
            remedy = REMEDIES.get(node.id) or _suggestion(node.id, [*local_names, *names])
            yield Mistake(node.lineno, f"{node.id} is not defined{remedy}")


def _wrong_returns(function: ast.FunctionDef, law: type[Law]) -> Iterator[Mistake]:
    """Yield a mistake if a function must return a number but has no `return` with a value and no `raise`, or if it must
    not return a value but does.

    `output`, except a coupled controller's, and a feedforward's `update` must return a number; no other function may.
    """
    nodes = list(ast.walk(function))
    values = [node for node in nodes if isinstance(node, ast.Return) and node.value is not None]
    feedforward = issubclass(law, Feedforward)
    returns = (function.name == "output" and (feedforward or law.axes == 1)) or (
        function.name == "update" and feedforward
    )
    if returns and not values and not any(isinstance(node, ast.Raise) for node in nodes):
        yield Mistake(function.lineno, f"{function.name} returns nothing; add a `return` with a number")
    if not returns and values:
        yield Mistake(values[0].lineno, f"{function.name} returns a value; allowed: no value")


def _suggestion(name: str, known_names: Collection[str]) -> str:
    """Return a hint with the known name that resembles `name`, else with all known names if they are few, else ""."""
    if near := get_close_matches(name, [known_name for known_name in known_names if not known_name.startswith("_")], 1):
        return f"; did you mean {near[0]}?"
    return f"; known: {', '.join(known_names)}" if 0 < len(known_names) <= MOST_LISTED else ""
