"""What is wanted of a file of another program: by options, or by a small TOML file that is kept beside the data."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rtloop.configuration.text_files import parse_toml, read_text
from rtloop.errors import ConfigError
from rtloop.recording.file.topics.validation import HIGHEST_RATE_HZ, LOWEST_RATE_HZ

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,99}")
MAPPING_FILE_NAME = "map.toml"


@dataclass(frozen=True)
class ColumnSelection:
    """Signals by name, each with the words of its mapping; columns that keep their names; what stands for the time."""

    signals: dict[str, str] = field(default_factory=dict)
    keep: tuple[str, ...] = ()
    everything: bool = False
    time: str | None = None
    rate_hz: float | None = None
    group: str | None = None

    def __bool__(self) -> bool:
        """Whether any column is asked for."""
        return bool(self.signals or self.keep or self.everything)


class _MappingFile(BaseModel):
    """A mapping's file; `all` is `everything`."""

    model_config = ConfigDict(extra="forbid", strict=True)

    signals: dict[str, str] = {}
    keep: list[str] = []
    all: bool = False
    time: str | None = None
    rate_hz: float | None = Field(default=None, ge=LOWEST_RATE_HZ, le=HIGHEST_RATE_HZ)
    group: str | None = None


def extend_selection(maps: Sequence[str], selection: ColumnSelection) -> ColumnSelection:
    """`other`, and what `NAME=COLUMN` and `COLUMN` ask for besides."""
    signals, keep = dict(selection.signals), [*selection.keep]
    for text in maps:
        name, equals, source = text.partition("=")
        if equals and NAME.fullmatch(name.strip()):
            signals[name.strip()] = source.strip()
        else:
            keep.append(text)
    return ColumnSelection(
        signals, tuple(keep), selection.everything, selection.time, selection.rate_hz, selection.group
    )


def find_mapping(data: Path) -> Path | None:
    """The mapping that is kept beside a file: NAME.map.toml for NAME.mat, or map.toml for all in the folder."""
    return next(
        filter(Path.is_file, (data.with_suffix(f".{MAPPING_FILE_NAME}"), data.with_name(MAPPING_FILE_NAME))), None
    )


def read_mapping(path: Path) -> ColumnSelection:
    """What a mapping's file asks for. Raises InputFileError, ConfigError."""
    try:
        mapping = _MappingFile.model_validate(parse_toml(read_text(path)))
    except ValidationError as error:
        faults = [
            f"{'.'.join(map(str, error_detail['loc']))}: {error_detail['msg'].lower()}"
            for error_detail in error.errors()
        ]
        raise ConfigError(str(path), faults) from None
    except ValueError as error:
        raise ConfigError(str(path), [str(error)]) from None
    invalid_names = [name for name in mapping.signals if not NAME.fullmatch(name)]
    if invalid_names:
        raise ConfigError(
            str(path), [f"signals: {name!r}; letters, digits and _ make a name" for name in invalid_names]
        )
    return ColumnSelection(
        mapping.signals, tuple(mapping.keep), mapping.all, mapping.time, mapping.rate_hz, mapping.group
    )
