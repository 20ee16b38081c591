"""Selection of columns from another program's file: by options, or by a small TOML file beside the data."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rtloop.configuration.text_files import parse_toml, read_text
from rtloop.errors import ConfigError
from rtloop.interchange.formats.table import Hints
from rtloop.recording.file.topics.validation import HIGHEST_RATE_HZ, LOWEST_RATE_HZ

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,99}")
MAPPING_FILE_NAME = "map.toml"
STATED = "stated"
"""The clock of a file that states its sample rate and has other times, too."""


class ColumnSelection(BaseModel):
    """Columns to import: `signals` by name, each with its mapping; `keep`, columns under their own names; the time.

    `all`: every other column too. `group` picks a raster, group or topic. `rate_hz` replaces the column `time`.
    `clock` and `time_unit` decide between several readings of the times; the others are those of `Hints`.
    `position_first`: in each row the position was sampled before the drive changed; else both at the same time. A
    mapping file has these keys.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    signals: dict[str, str] = {}
    keep: Annotated[tuple[str, ...], Field(strict=False)] = ()
    all: bool = False
    time: str | None = None
    rate_hz: float | None = Field(default=None, ge=LOWEST_RATE_HZ, le=HIGHEST_RATE_HZ)
    group: str | None = None
    position_first: bool = False
    clock: str | None = None
    time_unit: str | None = None
    header_row: int | None = Field(default=None, ge=0)
    skip_rows: Annotated[tuple[int, ...], Field(strict=False)] = ()
    delimiter: str | None = None
    decimal: str | None = None
    dates: Literal["day", "month"] | None = None
    missing: Annotated[tuple[str, ...], Field(strict=False)] = ()

    @property
    def hints(self) -> Hints:
        """Answers for the reader of the file."""
        return Hints(**{key.name: getattr(self, key.name) for key in fields(Hints)})

    def __bool__(self) -> bool:
        """Whether any column is selected."""
        return bool(self.signals or self.keep or self.all)


def extend_selection(maps: Sequence[str], selection: ColumnSelection) -> ColumnSelection:
    """Return a copy of `selection` with a further column for each of `maps`.

    A text `NAME=COLUMN` adds or replaces the mapping of the signal NAME, which has up to 100 ASCII letters, digits
    and _, and begins with no digit. Any other text is a column to keep under its own name.
    """
    signals, keep = dict(selection.signals), [*selection.keep]
    for text in maps:
        name, equals, source = text.partition("=")
        if equals and NAME.fullmatch(name.strip()):
            signals[name.strip()] = source.strip()
        else:
            keep.append(text)
    return selection.model_copy(update={"signals": signals, "keep": tuple(keep)})


def find_mapping(data: Path) -> Path | None:
    """Return the mapping file in the folder of `data`: NAME.map.toml for NAME.mat, else map.toml; None without one."""
    return next(
        filter(Path.is_file, (data.with_suffix(f".{MAPPING_FILE_NAME}"), data.with_name(MAPPING_FILE_NAME))), None
    )


def read_mapping(path: Path) -> ColumnSelection:
    """Return the selection in a mapping file.

    Raises InputFileError if it cannot be read; ConfigError if it is no TOML, a key or value is wrong, or a name is
    invalid.
    """
    try:
        selection = ColumnSelection.model_validate(parse_toml(read_text(path)))
    except ValidationError as error:
        faults = [
            f"{'.'.join(map(str, error_detail['loc']))}: {error_detail['msg'].lower()}"
            for error_detail in error.errors()
        ]
        raise ConfigError(str(path), faults) from None
    except ValueError as error:
        raise ConfigError(str(path), [str(error)]) from None
    invalid_names = [name for name in selection.signals if not NAME.fullmatch(name)]
    if invalid_names:
        raise ConfigError(
            str(path),
            [
                f"signals: {name!r}; allowed: a name of up to 100 letters, digits and _, with no digit first"
                for name in invalid_names
            ],
        )
    return selection
