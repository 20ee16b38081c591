"""Results as plain values, for JSON, in words and as pages."""

from __future__ import annotations

import base64
import math
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any


def fields_of(value: Any) -> dict[str, Any]:
    """A dataclass's fields as they are."""
    return {name: getattr(value, name) for name in value.__dataclass_fields__}


def plain(value: Any) -> Any:
    """For JSON: numbers, text, lists and dictionaries; roots as [real, imaginary], null for what is not finite.

    What has `for_json` says itself what it is there.
    """
    if hasattr(value, "for_json"):
        return plain(value.for_json())
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return plain(value._asdict())  # pyright: ignore[reportAttributeAccessIssue]
    if is_dataclass(value) and not isinstance(value, type):
        return plain(fields_of(value))
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if (as_list := getattr(value, "tolist", None)) is not None:  # of numpy, which is not imported for this
        return plain(as_list())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def counted(number: int, one: str, many: str = "") -> str:
    """The number and its noun, in the singular for 1; `many` where the plural is not made by an s."""
    return f"{number:,} {one if number == 1 else many or f'{one}s'}"


def rendered(package: str | None, **values: Any) -> str:
    """The `page.html` of a package, a jinja2 template, filled in: text is escaped, bytes of a PNG go through `png`."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader(str(package), "")
    pages = Environment(autoescape=True, loader=loader, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    pages.filters["png"] = lambda content: f"data:image/png;base64,{base64.b64encode(content).decode('ascii')}"
    return pages.get_template("page.html").render(values)
