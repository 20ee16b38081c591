"""Mistakes in the text of somebody's own law, found before anything of it is compiled: one sentence, with its line.

A class is searched for its records, its options and its functions. `rtloop.laws.function_mistakes` reads the functions
that are compiled. The compiler finds the same, and more, in words of its own.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from typing import Any

from rtloop.laws.contract import Law, record_type
from rtloop.laws.function_mistakes import PER_TICK, Mistake, mistakes_in_function
from rtloop.laws.options import LawOptions

BASES = ("Controller", "CoupledController", "Feedforward")


def find_mistakes(text: str, names: Mapping[str, Any]) -> Iterator[Mistake]:
    """Yield the mistakes in the laws of a text, in the order of their lines.

    `names` are those that the text defines when it is run.
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


def missing_law(text: str, names: Mapping[str, Any]) -> Mistake | None:
    """Return the reason why the first class that looks like a law is none; None where no class looks like one."""
    for node, law in _classes(text, names):
        functions = {one.name: one.lineno for one in node.body if isinstance(one, ast.FunctionDef)}
        if _is_law(law):
            for absent in sorted(law.__abstractmethods__):
                near = get_close_matches(absent, functions.keys() - {*PER_TICK, "build"}, 1)
                meant = f"; is `{near[0]}` in line {functions[near[0]]} meant?" if near else ""
                return Mistake(node.lineno, f"class {node.name} has no function `{absent}`{meant}")
        elif functions.keys() >= {"build", "output"}:
            return Mistake(node.lineno, f"class {node.name} is no law; its base must be one of {', '.join(BASES)}")
    return None


def _classes(text: str, names: Mapping[str, Any]) -> Iterator[tuple[ast.ClassDef, Any]]:
    """Yield each class of a text with the object that its name stands for."""
    for node in ast.parse(text).body:
        if isinstance(node, ast.ClassDef):
            yield node, names.get(node.name)


def _is_law(candidate: Any) -> bool:
    return isinstance(candidate, type) and issubclass(candidate, Law)


def _wrong_records(node: ast.ClassDef, law: type[Law]) -> Iterator[Mistake]:
    """Yield a mistake for `coefficients` or `state` where it is missing or describes no record."""
    lines = {target.id: one.lineno for one in node.body if isinstance(one, ast.Assign)
             for target in one.targets if isinstance(target, ast.Name)}  # fmt: skip
    for name in ("coefficients", "state"):
        if not hasattr(law, name):
            near = get_close_matches(name, lines, 1)
            meant = f"; is `{near[0]}` in line {lines[near[0]]} meant?" if near else ""
            if not inspect.isabstract(law):
                yield Mistake(node.lineno, f"class {node.name} has no `{name}`{meant}")
            continue
        try:
            record_type(getattr(law, name))
        except TypeError as error:
            yield Mistake(lines.get(name, node.lineno), f"{name}: {error}")


def _wrong_options(node: ast.ClassDef, law: type[Law], names: Mapping[str, Any]) -> Iterator[Mistake]:
    """Yield a mistake where a text defines the options of its law and the law does not name them."""
    own = [one for one in names.values() if isinstance(one, type) and one.__module__ == law.__module__]
    options = [one.__name__ for one in own if issubclass(one, LawOptions)]
    if options and law.options_model.__module__ != law.__module__:
        yield Mistake(node.lineno, f"class {node.name} names no options; add `options_model = {options[-1]}` to it")
