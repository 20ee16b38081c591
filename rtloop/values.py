"""Conversion of results to JSON values, counted nouns and HTML pages."""

from __future__ import annotations

import base64
import math
from dataclasses import is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def dataclass_fields(value: DataclassInstance) -> dict[str, Any]:
    """Return {name: value} of the fields of a dataclass instance; the values are neither converted nor copied."""
    return {name: getattr(value, name) for name in value.__dataclass_fields__}


def to_jsonable(value: Any) -> Any:
    """Return a value as JSON has it: numbers, text, lists, and dictionaries whose keys are text, nested ones too.

    Complex numbers become [real, imaginary], real numbers that are not finite None, dataclasses and named tuples
    dictionaries, paths text, arrays lists. An object with a method `for_json` is replaced by the result of that method,
    converted as well; any other value stays.
    """
    if hasattr(value, "for_json"):
        return to_jsonable(value.for_json())
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return to_jsonable(value._asdict())  # pyright: ignore[reportAttributeAccessIssue]
    if is_dataclass(value) and not isinstance(value, type):
        return to_jsonable(dataclass_fields(value))
    if isinstance(value, dict):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if (as_list := getattr(value, "tolist", None)) is not None:  # of numpy, which is not imported for this
        return to_jsonable(as_list())
    if isinstance(value, list | tuple):
        return [to_jsonable(item) for item in value]
    if isinstance(value, complex):
        return [to_jsonable(value.real), to_jsonable(value.imag)]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def count_text(number: int, singular: str, plural: str = "") -> str:
    """Return `number`, with commas between thousands, and its noun: `singular` for 1, else `plural`.

    Without `plural`, the plural is `singular` and an s.
    """
    return f"{number:,} {singular if number == 1 else plural or f'{singular}s'}"


def render_page(package: str | None, **values: object) -> str:
    """Return the jinja2 template `page.html` in the folder of `package` (its `__package__`), filled in with `values`.

    Text is escaped for HTML; the template's filter `png` turns PNG bytes into a data URL. Raises jinja2's
    UndefinedError for a value that the template needs and `values` lacks.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader(str(package), "")
    pages = Environment(autoescape=True, loader=loader, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    pages.filters["png"] = lambda content: f"data:image/png;base64,{base64.b64encode(content).decode('ascii')}"
    return pages.get_template("page.html").render(values)
