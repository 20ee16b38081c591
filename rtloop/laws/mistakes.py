"""Mistakes in the text of a user law, found before the compiler runs: one sentence each, with its line.

They concern the records, options and functions of a class. `rtloop.laws.function_mistakes` reads the functions that are
compiled. The compiler finds these mistakes too, but its messages are long.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from typing import TypeGuard

from rtloop.laws.contract import Law, record_type
from rtloop.laws.function_mistakes import PER_TICK, Mistake, mistakes_in_function
from rtloop.laws.options import LawOptions

BASES = ("Controller", "CoupledController", "Feedforward")


def find_mistakes(text: str, names: Mapping[str, object]) -> Iterator[Mistake]:
    """Yield the mistakes in the laws of a text, law by law: of the records, or, if the records are right, of the
    options and then of the functions.

    `names` are the names that the text defines when it runs. The functions of a law whose `coefficients` are a dtype
    are not read.
    """
    for node, law in _classes(text, names):
        if not _is_law(law):
            continue
        wrong = list(_wrong_records(node, law))
        yield from wrong or _wrong_options(node, law, names)
        if wrong or not isinstance(getattr(law, "coefficients", None), Mapping):
            continue
        for function in node.body:
            if isinstance(function, ast.FunctionDef) and function.name in PER_TICK:
                yield from sorted(mistakes_in_function(function, law, names))


def missing_law(text: str, names: Mapping[str, object]) -> Mistake | None:
    """Return the mistake of the first class that resembles a law but is none; None if there is no such class.

    Such a class is a subclass of Law that lacks a function, or another class that has `build` and `output`. `names` are
    the names that the text defines when it runs.
    """
    for node, law in _classes(text, names):
        functions = {item.name: item.lineno for item in node.body if isinstance(item, ast.FunctionDef)}
        if _is_law(law):
            for absent in sorted(law.__abstractmethods__):
                meant = _suggestion(absent, {name: functions[name] for name in functions.keys() - {*PER_TICK, "build"}})
                return Mistake(node.lineno, f"class {node.name} has no function `{absent}`{meant}")
        elif functions.keys() >= {"build", "output"}:
            return Mistake(node.lineno, f"class {node.name} is not a law; allowed base classes: {', '.join(BASES)}")
    return None


def _classes(text: str, names: Mapping[str, object]) -> Iterator[tuple[ast.ClassDef, object]]:
    """Yield each class at the top level of a text with the object of its name in `names`, None if it is absent."""
    for node in ast.parse(text).body:
        if isinstance(node, ast.ClassDef):
            yield node, names.get(node.name)


def _suggestion(name: str, lines: Mapping[str, int]) -> str:
    """Return a hint with the name in `lines` that resembles `name`, and its line; empty without one."""
    near = get_close_matches(name, lines, 1)
    return f"; is `{near[0]}` in line {lines[near[0]]} meant?" if near else ""


def _is_law(candidate: object) -> TypeGuard[type[Law]]:
    """Whether an object is a subclass of Law."""
    return isinstance(candidate, type) and issubclass(candidate, Law)


def _wrong_records(node: ast.ClassDef, law: type[Law]) -> Iterator[Mistake]:
    """Yield a mistake for `coefficients` or `state` that describes no record, or is missing in a class that is not
    abstract."""
    lines = {target.id: item.lineno for item in node.body if isinstance(item, ast.Assign)
             for target in item.targets if isinstance(target, ast.Name)}  # fmt: skip
    for name in ("coefficients", "state"):
        if not hasattr(law, name):
            if not inspect.isabstract(law):
                yield Mistake(node.lineno, f"class {node.name} has no `{name}`{_suggestion(name, lines)}")
            continue
        try:
            record_type(getattr(law, name))
        except TypeError as error:
            yield Mistake(lines.get(name, node.lineno), f"{name}: {error}")


def _wrong_options(node: ast.ClassDef, law: type[Law], names: Mapping[str, object]) -> Iterator[Mistake]:
    """Yield a mistake if the law's text defines a class of options but the law's `options_model` is from elsewhere."""
    classes = [item for item in names.values() if isinstance(item, type) and item.__module__ == law.__module__]
    options = [item.__name__ for item in classes if issubclass(item, LawOptions)]
    if options and law.options_model.__module__ != law.__module__:
        yield Mistake(
            node.lineno, f"class {node.name} names no options; add `options_model = {options[-1]}` to the class"
        )
