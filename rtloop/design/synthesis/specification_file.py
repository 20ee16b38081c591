"""The specification file, checked as a whole: every fault at once, each with its key and its allowed values."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration, describe
from rtloop.configuration.text_files import InputFileError, parse_toml, read_text
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.errors import ConfigError

CONFIGURATION = (
    "this file is a configuration; allowed: a specification, with the sections [specification] and [plant]. Use a "
    "configuration with `rtloop check`, `rtloop run`, `rtloop design verify` or `rtloop design shape`"
)


class SpecificationFile(NamedTuple):
    """A valid SPEC.toml, where it stands, and its text."""

    path: Path
    text: str
    design: DesignOptions


def load_axis_specification(configuration: Configuration, axis: AxisOptions) -> SpecificationFile:
    """Read and validate the specification that an axis names. Raises as `load_specification`; a file that cannot be
    read is named with the key that names it.
    """
    try:
        return load_specification(configuration.folder / (axis.specification or ""))
    except InputFileError as error:
        raise InputFileError(f"{configuration.source}: axis.{axis.name}.specification: {error}") from None


def load_specification(path: Path) -> SpecificationFile:
    """Read and validate a specification file. Raises InputFileError if it cannot be read, or ConfigError with all
    faults.
    """
    text = read_text(path)
    try:
        raw = parse_toml(text)
    except ValueError as error:
        raise ConfigError(str(path), [str(error)]) from None
    if "specification" not in raw and raw.keys() & {"loop", "driver", "axis"}:
        raise ConfigError(str(path), [CONFIGURATION])
    try:
        return SpecificationFile(path, text, DesignOptions.model_validate(raw))
    except ValidationError as error:
        raise ConfigError(str(path), describe(error, "", raw, _collect_keys())) from None


def _collect_keys() -> set[str]:
    """Return the names of all keys allowed in any section of a specification, for suggestions on unknown keys."""
    schema = DesignOptions.model_json_schema()
    parts = [schema, *schema.get("$defs", {}).values()]
    return set().union(*(part.get("properties", {}) for part in parts))
