"""JSON Schema (draft 2020-12) of a configuration file, from the models that check it, for editors and other programs.

The schema knows every key, type and range that a model states. Relations between keys are left to `rtloop check`, as
are the options of laws and drivers that do not ship with rtloop: their tables may have any key.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from rtloop.configuration.field_texts import texts_below
from rtloop.configuration.file import ChannelOptions, FileOptions
from rtloop.configuration.laws import CONTROLLER, FEEDFORWARD
from rtloop.drivers.registry import BUILT_IN as DRIVERS
from rtloop.drivers.registry import driver_class
from rtloop.laws.contract import Controller, Feedforward, Law
from rtloop.laws.registry import BUILT_IN as LAWS
from rtloop.laws.registry import find_law, law_class

DIALECT = "https://json-schema.org/draft/2020-12/schema"
Schema = dict[str, Any]
KIND_TEXT = "Name of the driver, which decides the other keys of this table; `rtloop drivers` lists all drivers."
CHANNELS_TEXT = "Channels of each axis, by its name: [driver.channels.NAME]."
DRIVER_TEXT = "The hardware, or the simulated rig in its place."
"""Texts of keys that no model has."""


@cache
def schema_text() -> str:
    """Return the schema of a configuration as the text of a JSON file, with a newline at its end."""
    return json.dumps(configuration_schema(), indent=2, ensure_ascii=False) + "\n"


def configuration_schema() -> Schema:
    """Return the schema of a configuration with all laws and drivers that ship."""
    laws = {kind: law_class(find_law(kind)) for kind in LAWS}
    drivers = {kind: driver_class(kind).options_model for kind in DRIVERS}
    models = [FileOptions, ChannelOptions, *drivers.values(), *(law.options_model for law in laws.values())]
    schemas, shared = models_json_schema([(model, "validation") for model in models])
    definitions = shared["$defs"]
    for model in _models_within(models):
        _add_descriptions(definitions.get(model.__name__, {}), model)
    references: dict[type[BaseModel], Schema] = {model: schemas[model, "validation"] for model in models}
    definitions["ControllerOptions"] = _law_table(laws, references, Controller, CONTROLLER)
    definitions["FeedforwardOptions"] = _law_table(laws, references, Feedforward, FEEDFORWARD)
    definitions["Driver"] = _driver_table(drivers, references, definitions)
    file = definitions.pop(FileOptions.__name__)
    file["properties"]["driver"] = {"$ref": "#/$defs/Driver", "description": DRIVER_TEXT}
    file["required"] = ["driver", *file["required"]]
    return {"$schema": DIALECT, **file, "title": "Configuration of rtloop", "$defs": definitions}


def _law_table(
    laws: dict[str, type[Law]], references: Mapping[type[BaseModel], Schema], base: type[Law], default: str
) -> Schema:
    """Return the schema of a table that chooses a law derived from `base`, by `kind` or by the `file` that defines it.

    Any of `laws` by its kind and options, a file, or a kind that does not ship. A table without `kind` and `file` has
    the law `default`. `references` has the schema of each law's options.
    """
    kinds = {kind: law for kind, law in laws.items() if issubclass(law, base)}
    choices = [_choice(kind, references[law.options_model], kind != default) for kind, law in kinds.items()]
    own_file = {"title": "a law of a file", "required": ["file"], "properties": {"file": {"type": "string"}}}
    return {"type": "object", "anyOf": [*choices, own_file, _foreign(laws)]}


def _driver_table(
    drivers: Mapping[str, type[BaseModel]], references: Mapping[type[BaseModel], Schema], definitions: dict[str, Schema]
) -> Schema:
    """Return the schema of [driver].

    The schema of each driver's options in `definitions` is changed: it receives the keys `kind` and `channels`.
    """
    channels = {"type": "object", "description": CHANNELS_TEXT, "additionalProperties": references[ChannelOptions]}
    for kind, model in drivers.items():
        options = definitions[references[model]["$ref"].rpartition("/")[2]]
        options["properties"] = {
            "kind": {"const": kind, "description": KIND_TEXT},
            "channels": channels,
            **options.get("properties", {}),
        }
    choices = [_choice(kind, references[model], True) for kind, model in drivers.items()]
    return {"type": "object", "required": ["kind", "channels"], "anyOf": [*choices, _foreign(drivers)]}


def _choice(kind: str, reference: Schema, is_required: bool) -> Schema:
    """Return the schema of a table with `kind` and the options of `reference`; without `is_required`, kind may lack."""
    return {
        "title": kind,
        "properties": {"kind": {"const": kind}},
        "required": ["kind"] if is_required else [],
        "$ref": reference["$ref"],
    }


def _foreign(shipped: Iterable[str]) -> Schema:
    """Return the schema of a table whose kind does not ship: an installed package defines it."""
    kind = {"type": "string", "not": {"enum": list(shipped)}}
    return {"title": "of an installed package", "required": ["kind"], "properties": {"kind": kind}}


def _models_within(models: Iterable[type[BaseModel]]) -> Iterator[type[BaseModel]]:
    """Yield models and all models of their fields, at any depth, each once."""
    pending, visited = list(models), set()
    while pending:
        model = pending.pop()
        if model not in visited:
            visited.add(model)
            yield model
            pending += [part for field in model.model_fields.values() for part in _models_in(field.annotation)]


def _models_in(annotation: object) -> Iterator[type[BaseModel]]:
    """Yield the models that a type names, alone or as the parameter of another type."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in getattr(annotation, "__args__", ()):
        yield from _models_in(part)


def _add_descriptions(schema: Schema, model: type[BaseModel]) -> None:
    """Add to a model's schema the text below each field in the source, as its description."""
    for name, text in texts_below(model).items():
        if name in schema.get("properties", ()):
            schema["properties"][name]["description"] = " ".join(text.split())
