"""Mistakes that can be planted in a module: cosmic-ray's operators, at the places where they change behaviour.

Left out, because they change no promised behaviour: annotations and unions of types, messages (f-strings and the
arguments of what is raised), `__repr__` and `__str__`, log calls, docstrings and other texts, decorators. Left out too:
operators that programmers do not confuse, such as `+` and `<<`: almost every such mutant raises a TypeError.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from typing import Any

import cosmic_ray.plugins
from cosmic_ray.ast import Visitor, get_ast
from cosmic_ray.mutating import mutate_code

from tests.mutants.mutant import Change

BINARY = ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_FloorDiv", "Pow_Mul", "BitAnd_BitOr",
          "BitOr_BitAnd", "BitXor_BitAnd", "LShift_RShift", "RShift_LShift")  # fmt: skip
COMPARISON = ("Lt_LtE", "Lt_GtE", "LtE_Lt", "LtE_Gt", "Gt_GtE", "Gt_LtE", "GtE_Gt", "GtE_Lt", "Eq_NotEq", "NotEq_Eq",
              "Is_IsNot", "IsNot_Is")  # fmt: skip
OTHERS = ("ReplaceUnaryOperator_Delete_Not", "ReplaceUnaryOperator_Delete_USub", "ReplaceUnaryOperator_Delete_Invert",
          "AddNot", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd",
          "ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "ExceptionReplacer", "NumberReplacer",
          "ZeroIterationForLoop")  # fmt: skip
OPERATORS = (
    *(f"ReplaceBinaryOperator_{change}" for change in BINARY),
    *(f"ReplaceComparisonOperator_{change}" for change in COMPARISON),
    *OTHERS,
)
PUNCTUATION = frozenset("()[]{},.:=")
LOGS = {"log", "logger", "logging", "warnings"}
Position = tuple[int, int]
"""Line from 1 and column in characters from 0, as cosmic-ray counts."""


class _Positions(Visitor):
    """A visitor that collects the start of every place where an operator can act, in the order of occurrence."""

    def __init__(self) -> None:
        self._operators = [(name, _operator(name)) for name in OPERATORS]
        self.starts: dict[str, list[Position]] = {name: [] for name in OPERATORS}

    def visit(self, node: Any) -> Any:
        """Add the positions of the operators that act on `node`; return the node unchanged."""
        if node.type in ("name", "string", "newline") or getattr(node, "value", "") in PUNCTUATION:
            return node  # No operator acts on these nodes, which are most of a module.
        for name, operator in self._operators:
            self.starts[name] += [start for start, _ in operator.mutation_positions(node)]
        return node


@cache
def _operator(name: str) -> Any:
    """Return an operator of cosmic-ray by its name."""
    return cosmic_ray.plugins.get_operator(f"core/{name}")()


def places(source: str) -> dict[Position, list[Change]]:
    """Return the places of a module where a mistake changes behaviour, in order, with the possible changes of each."""
    positions, excluded = _Positions(), _excluded_spans(source)
    positions.walk(get_ast(source))
    changes_at: dict[Position, list[Change]] = {}
    for name, starts in positions.starts.items():
        for occurrence, start in enumerate(starts):
            if not any(first <= start < last for first, last in excluded):
                changes_at.setdefault(start, []).append(Change(name, occurrence))
    return dict(sorted(changes_at.items()))


def apply_change(source: str, change: Change) -> str | None:
    """Return the module's source with one change; None if it is no valid Python or does not change."""
    try:
        text = mutate_code(source, _operator(change.operator), change.occurrence)
    except AttributeError:  # cosmic-ray raises it for an exception with the name of its module.
        return None
    try:
        ast.parse(text or "")
    except SyntaxError:
        return None
    return None if text is None else text.replace("CosmicRayTestingException", "GeneratorExit")  # No code raises it.


def _excluded_spans(source: str) -> list[tuple[Position, Position]]:
    """Return the (start, end) of the parts of a module in which no mistake is planted."""
    lines = source.splitlines()

    def position(line: int, byte: int) -> Position:
        return line, len(lines[line - 1].encode()[:byte].decode())

    return [
        (position(node.lineno, node.col_offset), position(node.end_lineno, node.end_col_offset))
        for node in _excluded_nodes(ast.parse(source))
    ]


def _excluded_nodes(tree: ast.AST) -> Iterator[Any]:
    """Yield the nodes that the module's docstring leaves out."""
    for node in ast.walk(tree):
        match node:
            case ast.JoinedStr():
                yield node
            case ast.Raise(exc=exception) if exception is not None:
                yield exception
            case ast.arg(annotation=annotation) | ast.AnnAssign(annotation=annotation) if annotation is not None:
                yield annotation
            case ast.BinOp(op=ast.BitOr(), left=left, right=right) if _is_type(left) and _is_type(right):
                yield node
            case ast.Expr(value=ast.Call(func=ast.Attribute(value=ast.Name(id=name)))) if name.lstrip("_") in LOGS:
                yield node
            case ast.If(test=ast.Name(id="TYPE_CHECKING")):
                yield node
            case ast.If(test=ast.Compare(left=ast.Name(id="__name__"))):
                yield node
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield from node.decorator_list
            if node.name in ("__repr__", "__str__"):
                yield node
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.returns is not None:
            yield node.returns


def _is_type(node: ast.AST) -> bool:
    """Whether a part of a union is a type: None, a builtin type, or a name in CapitalisedWords."""
    match node:
        case ast.Constant(value=None):
            return True
        case ast.Name(id=name):
            return name in {"str", "int", "float", "bool", "bytes", "list", "dict", "tuple"} or (
                name[0].isupper() and not name.isupper()
            )
        case ast.Subscript(value=value):
            return _is_type(value)
        case ast.Attribute(attr=attr):
            return attr[0].isupper() and not attr.isupper()
        case ast.BinOp(op=ast.BitOr(), left=left, right=right):
            return _is_type(left) and _is_type(right)
    return False
