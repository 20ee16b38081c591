"""A table of columns read from another program's file, with the evidence on its meaning, before anything is decided."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from rtloop.errors import RtloopError
from rtloop.foundation.arrays import Real

MAX_ROWS = 1 << 28
"""Row limit of a table; a longer file is to be cut with the program that wrote it."""


class UnreadableData(RtloopError):
    """The file cannot be imported; the message names the file, the reason, and the possible remedies."""

    exit_code = 1


class UnopenedData(UnreadableData):
    """The file does not exist, or may not be read."""

    exit_code = 66


class AmbiguousData(UnreadableData):
    """The file has several readings: the user decides by one of the options that the message lists."""

    exit_code = 65


class Reading(NamedTuple):
    """One of several readings: the option that decides for it, such as "--decimal ,", and what it then gives."""

    option: str
    result: str


def ask(path: Path, question: str, *readings: Reading) -> AmbiguousData:
    """Return the error that asks for one of the readings."""
    width = max(len(reading.option) for reading in readings)
    lines = [f"  {reading.option:<{width}}  {reading.result}" for reading in readings]
    return AmbiguousData("\n".join([f"{path}: {question}. Decide with one of these options:", *lines]))


@dataclass(frozen=True)
class Hints:
    """Answers of the user to a reader's questions; None and () leave a matter to the evidence.

    `header_row` is the line, from 1, that holds the names, 0: no line does. `skip_rows` are lines to ignore. `missing`
    are texts or numbers that stand for a missing value; "none" alone: no text does, besides an empty field. `dates` is
    what a date such as 3/4/2024 begins with, "day" or "month".
    """

    group: str | None = None
    header_row: int | None = None
    skip_rows: Sequence[int] = ()
    delimiter: str | None = None
    decimal: str | None = None
    missing: Sequence[str] = ()
    clock: str | None = None
    dates: str | None = None


NO_HINTS = Hints()


@dataclass(frozen=True)
class Table:
    """Named columns of a file, each float64 of shape (rows,), sampled together; NaN where a value is missing.

    `units` by column, as the file writes them; `time` is the file's own column of times. `about` is further information
    for people; `in_other_files` names data that the file only points to, with the reason: they are never read.

    `rates` are sample rates that the file states, in Hz, with its words. `tick_hz` is the rate of the ticks that its
    times count. `unnamed` are columns whose names the reader made up. `origins` are whole numbers that
    the reader took from all values of a column, which would not fit into a float64. `notes` are the reader's
    assumptions and losses, one sentence each.
    """

    columns: Mapping[str, Real]
    units: Mapping[str, str] = field(default_factory=dict)
    time: str | None = None
    about: Mapping[str, str] = field(default_factory=dict)
    in_other_files: Sequence[str] = ()
    rates: Sequence[tuple[float, str]] = ()
    tick_hz: float | None = None
    unnamed: Sequence[str] = ()
    origins: Mapping[str, int] = field(default_factory=dict)
    notes: Sequence[str] = ()
