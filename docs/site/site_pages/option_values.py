"""Type, range and default of an option in words, from pydantic's JSON Schema of its model."""

from __future__ import annotations

import json
import math
from typing import Any

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

TYPES = {"number": "number", "integer": "integer", "boolean": "true or false", "string": "text", "object": "table"}
PLURALS = {"number": "numbers", "integer": "integers", "string": "texts", "boolean": "values true or false"}


def _variants(schema: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the schemas that a value may satisfy, without null."""
    variants = schema.get("anyOf") or schema.get("oneOf") or [schema]
    return [variant for variant in variants if variant.get("type") != "null"]


def type_text(schema: dict[str, Any]) -> str:
    """Return the type of a value in words: "number", "list of numbers", or the allowed constants as code."""
    return " or ".join(dict.fromkeys(_one_type(variant) for variant in _variants(schema)))


def _one_type(schema: dict[str, Any]) -> str:
    """Return the type of one variant in words."""
    constants = schema.get("enum") or ([schema["const"]] if "const" in schema else [])
    if constants:
        return ", ".join(f"`{json.dumps(value)}`" for value in constants)
    if schema.get("type") == "array":
        if "prefixItems" in schema:
            return f"list of {len(schema['prefixItems'])} numbers"
        return f"list of {_plural(schema.get('items', {}))}"
    if schema.get("type") == "object" and isinstance(values := schema.get("additionalProperties"), dict):
        inner = _plural(values)
        return f"table of {inner}"
    return TYPES.get(schema.get("type", "object"), "table")


def _plural(schema: dict[str, Any]) -> str:
    """Return the type of the entries of a list or table in words."""
    if schema.get("type") == "array":
        return "lists of " + _plural((schema.get("prefixItems") or [schema.get("items", {})])[0])
    if "anyOf" in schema:
        return "values"
    return PLURALS.get(schema.get("type", "object"), "tables")


def range_text(schema: dict[str, Any]) -> str:
    """Return the allowed range, length and pattern of a value in words; "" for any value of its type."""
    return "; ".join(dict.fromkeys(text for variant in _variants(schema) if (text := _one_range(variant))))


def _one_range(schema: dict[str, Any]) -> str:
    """Return the range, length and pattern of one variant, and the range of its entries."""
    texts = [_interval(schema)]
    least, most = schema.get("minItems"), schema.get("maxItems")
    if "prefixItems" not in schema and (least or most):
        texts.append(f"{least or 0} to {most} entries" if most else f"entries: {least} or more")
    if "pattern" in schema:
        texts.append(f"matches `{schema['pattern']}`")
    if isinstance(schema.get("items"), dict) and (inner := _interval(schema["items"])):
        texts.append(f"each {inner}")
    return "; ".join(text for text in texts if text)


def _interval(schema: dict[str, Any]) -> str:
    """Return the interval of a number in words; "" without bounds."""
    bounds = [
        (sign, schema[key])
        for key, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
        if key in schema
    ]
    return ", ".join(f"{sign} {_number(value)}" for sign, value in bounds)


def _number(value: float) -> str:
    """Return a bound without a fraction where it has none."""
    whole = math.isfinite(value) and value == int(value) and abs(value) < 1e15
    return f"{int(value):,}".replace(",", "\u202f") if whole else f"{value:g}"


def default_text(field: FieldInfo) -> str:
    """Return the default as TOML would write it, in code; "required", or "none" for a key that is absent."""
    if field.is_required():
        return "**required**"
    value = field.default if field.default is not PydanticUndefined else field.get_default(call_default_factory=True)
    if value is None or value == "":
        return "none"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, int | float | str):
        return f"`{json.dumps(value, ensure_ascii=False)}`"
    if isinstance(value, tuple | list | dict):
        return "empty" if not value else f"`{json.dumps(value)}`"
    return "its defaults"
