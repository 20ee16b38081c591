"""Results as plain values, for JSON, in words and as pages."""

from __future__ import annotations

import base64
import math
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any


def dataclass_fields(value: Any) -> dict[str, Any]:
    """A dataclass's fields as they are."""
    return {name: getattr(value, name) for name in value.__dataclass_fields__}


def to_jsonable(value: Any) -> Any:
    """For JSON: numbers, text, lists and dictionaries; roots as [real, imaginary], null for what is not finite.

    What has `for_json` says itself what it is there.
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
        return [value.real, value.imag]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def count_text(number: int, singular: str, plural: str = "") -> str:
    """The number and its noun, in the singular for 1; `many` where the plural is not made by an s."""
    return f"{number:,} {singular if number == 1 else plural or f'{singular}s'}"


def render_page(package: str | None, **values: Any) -> str:
    """The `page.html` of a package, a jinja2 template, filled in: text is escaped, bytes of a PNG go through `png`."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader(str(package), "")
    pages = Environment(autoescape=True, loader=loader, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    pages.filters["png"] = lambda content: f"data:image/png;base64,{base64.b64encode(content).decode('ascii')}"
    return pages.get_template("page.html").render(values)
