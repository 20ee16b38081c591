"""Tables of a TOML file and their keys, from the pydantic models of the options."""

from __future__ import annotations

import typing
from collections.abc import Iterator
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from rtloop.configuration.field_texts import texts_below
from site_pages.option_values import default_text, range_text, type_text
from site_pages.texts import anchored, escape, own_docstring, table, unit_of


@dataclass(frozen=True)
class Section:
    """Table of a file: its header in the file, the anchor of its heading, and the model of its keys."""

    header: str
    anchor: str
    model: type[BaseModel]
    kind: str = ""
    """Value of `kind` that selects this model among several."""

    @property
    def path(self) -> str:
        """The header without its brackets."""
        return self.header.strip("[]")


Sections = dict[type[BaseModel], Section]
"""First section of each model."""


def nested_models(annotation: Any) -> list[type[BaseModel]]:
    """Return the models within an annotation, in order."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    arguments = get_args(annotation)
    if get_origin(annotation) is Annotated:
        arguments = arguments[:1]
    return [model for argument in arguments for model in nested_models(argument)]


def _containers(annotation: Any) -> set[Any]:
    """Return the origins of the containers in an annotation that hold its models: tuple, dict, or none."""
    origin = get_origin(annotation)
    if origin is None or not nested_models(annotation):
        return set()
    inner = set().union(*(_containers(argument) for argument in get_args(annotation)))
    return inner if origin in (Annotated, UnionType, typing.Union) else {origin, *inner}


def _header(parent: str, name: str, annotation: Any) -> str:
    """Return the header of a key's table: [a.b], [[a.b]] for a list of tables, [a.b.NAME] for a table of tables."""
    path = f"{parent}.{name}" if parent else name
    containers = _containers(annotation)
    if dict in containers:
        return f"[{path}.NAME]"
    return f"[[{path}]]" if tuple in containers else f"[{path}]"


def nested_sections(parent: Section, name: str, field: FieldInfo) -> Iterator[Section]:
    """Yield the section of each model that a key may contain."""
    header = _header(parent.path, name, field.annotation)
    models = nested_models(field.annotation)
    for model in models:
        kind_field = model.model_fields.get("kind")
        kinds = get_args(kind_field.annotation) if kind_field is not None and len(models) > 1 else ()
        anchor = ".".join((header.strip("[]"), *kinds[:1]))
        yield Section(header, anchor, model, '" or "'.join(kinds))


def walk(section: Section, seen: Sections) -> Iterator[Section]:
    """Yield a section and those below it, each model once; `seen` collects the first section of each model."""
    if section.model in seen:
        return
    seen[section.model] = section
    yield section
    for name, field in section.model.model_fields.items():
        for below in nested_sections(section, name, field):
            yield from walk(below, seen)


def section_markdown(section: Section, seen: Sections) -> str:
    """Return heading, docstring and table of keys of a section."""
    title = f"`{section.header}`" if section.path else "Keys of the file itself"
    if section.kind:
        title += f' with `kind = "{section.kind}"`'
    anchor = f"{{ #{section.anchor or 'file'} data-model={section.model.__name__} }}"
    description = escape(own_docstring(section.model))
    lines = [f"## {title} {anchor}", "", description, ""]
    schema = section.model.model_json_schema()
    properties = schema["properties"]
    texts = texts_below(section.model)
    rows = [
        _row(section, name, field, properties[name], texts.get(name, ""), seen)
        for name, field in section.model.model_fields.items()
    ]
    return "\n".join(lines) + table(("key", "value", "default", "unit", "meaning"), rows)


def _row(
    section: Section, name: str, field: FieldInfo, schema: dict[str, Any], text: str, seen: Sections
) -> tuple[str, ...]:
    """Return the cells of one key."""
    models = nested_models(field.annotation)
    targets = [target for model, target in seen.items() if any(issubclass(model, base) for base in models)]
    value = ", ".join(_link(target) for target in targets) if models else type_text(schema)
    if limits := range_text(schema):
        value += f"<br>{limits}"
    key = f"<code>{name}</code>" if models else anchored(name, f"{section.anchor or 'file'}.{name}")
    return key, value, default_text(field), unit_of(name), escape(text)


def _link(target: Section) -> str:
    """Return a link to a section."""
    label = f'`{target.header}` "{target.kind}"' if target.kind else f"`{target.header}`"
    return f"[{label}](#{target.anchor})"
