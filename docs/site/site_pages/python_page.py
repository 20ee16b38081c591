"""Page of the public Python names: functions and classes of `rtloop`, the objects that they return, and laws."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import rtloop
import rtloop.laws
from site_pages.texts import docstring_markdown

INTRODUCTION = """# Python

`import rtloop` loads no library; each name is imported when it is first used. A mistake of the user raises
`rtloop.errors.RtloopError`, whose text names the place, the value and what is allowed.

"""
MODULES = (rtloop, rtloop.laws)


def public_names(module: ModuleType) -> list[str]:
    """Return the public functions and classes of a module, sorted."""
    return sorted((name for name in module.__all__ if not name.startswith("_")), key=str.lower)


def python_page() -> str:
    """Return the page of all public Python names."""
    parts = [INTRODUCTION]
    documented: set[Any] = set()
    returned: list[type] = []
    for module in MODULES:
        parts.append(f"## `{module.__name__}` {{ #{module.__name__} }}\n")
        for name in public_names(module):
            value = getattr(module, name)
            documented.add(value)
            parts.append(_entry(f"{module.__name__}.{name}", value))
            returned += _returned_classes(value)
    classes = [owner for owner in dict.fromkeys(returned) if owner not in documented]
    parts += [
        "## Objects that functions return { #objects }\n",
        *(_entry(_full_name(owner), owner) for owner in classes),
    ]
    return "\n".join(parts)


def _full_name(owner: type) -> str:
    """Return module and name of a class."""
    return f"{owner.__module__}.{owner.__qualname__}"


def _returned_classes(value: Any) -> Iterator[type]:
    """Yield the classes of rtloop that a function returns, and those that their methods and properties return."""
    waiting = [value]
    seen: set[Any] = set()
    while waiting:
        for owner in _returns(waiting.pop()):
            if owner not in seen:
                seen.add(owner)
                yield owner
                waiting += [member for _, member in _members(owner)]


def _returns(function: Any) -> list[type]:
    """Return the classes of rtloop in the return annotation of a function or property; [] for anything else."""
    function = function.fget if isinstance(function, property) else function
    if not inspect.isfunction(function):
        return []
    try:
        annotation = typing.get_type_hints(function).get("return")
    except NameError:
        return []  # A name that only the type checker imports.
    candidates = [annotation, *typing.get_args(annotation)]
    return [
        owner for owner in candidates if isinstance(owner, type) and owner.__module__.startswith("rtloop.")
        and "pydantic" not in str(owner.__mro__)
    ]  # fmt: skip


def _members(owner: type) -> list[tuple[str, Any]]:
    """Return (name, member) of the public functions and properties that a class defines or inherits from rtloop."""
    members: dict[str, Any] = {}
    for base in reversed(owner.__mro__):
        if base.__module__.startswith("rtloop"):
            members |= {name: value for name, value in vars(base).items() if not name.startswith("_")}
    return [(name, value) for name, value in members.items() if _is_described(value)]


def _is_described(value: Any) -> bool:
    """Whether a member of a class has an entry: a function, a property or a class method."""
    return inspect.isfunction(value) or isinstance(value, property | classmethod | staticmethod)


def _entry(path: str, value: Any) -> str:
    """Return heading, signature, docstring and members of a public name."""
    name = path.rpartition(".")[2]
    lines = [f"### `{path}` {{ #{path} }}", ""]
    lines += ["```python", _signature(name, value), "```", "", docstring_markdown(_docstring(value)), ""]
    if isinstance(value, type):
        for member_name, member in _members(value):
            lines += _member(path, member_name, member)
    return "\n".join(lines)


def _member(path: str, name: str, member: Any) -> list[str]:
    """Return the lines of a method or property of a class."""
    member = member.__func__ if isinstance(member, classmethod | staticmethod) else member
    heading = f"#### `{name}` {{ #{path}.{name} }}"
    if isinstance(member, property):
        return [heading, "", f"Property. {docstring_markdown(_docstring(member))}", ""]
    return [heading, "", "```python", _signature(name, member), "```", "", docstring_markdown(_docstring(member)), ""]


def _signature(name: str, value: Any) -> str:
    """Return the call of a function or class with its parameters, wrapped where it is long."""
    prefix = f"class {name}" if isinstance(value, type) else name
    try:
        signature = inspect.signature(value)
    except ValueError:
        return prefix
    parameters = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
    signature = signature.replace(parameters=parameters)
    line = f"{prefix}{signature}".replace("'", "")
    if len(line) <= 88 or not parameters:
        return line
    one_line_each = "".join(f"    {parameter},\n" for parameter in _with_markers(parameters))
    end = str(signature.replace(parameters=[]))[1:]
    return f"{prefix}(\n{one_line_each}{end}".replace("'", "")


def _with_markers(parameters: list[inspect.Parameter]) -> Iterator[str]:
    """Yield the parameters as text, with `*` before the first one that is passed by name alone."""
    marked = any(parameter.kind is inspect.Parameter.VAR_POSITIONAL for parameter in parameters)
    for parameter in parameters:
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY and not marked:
            marked = True
            yield "*"
        yield str(parameter)


def _docstring(value: Any) -> str:
    """Return the docstring of a name; "" for none."""
    return inspect.getdoc(value) or ""
