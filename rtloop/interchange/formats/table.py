"""A table of columns read from another program's file, before a mapping gives them meaning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

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


@dataclass(frozen=True)
class Table:
    """Named columns of a file, each float64 of shape (rows,), sampled together.

    `units` by column, as the file writes them; `time` is the file's own column of times. `about` is further information
    for people; `in_other_files` names data that the file only points to, with the reason: they are never read.
    """

    columns: Mapping[str, Real]
    units: Mapping[str, str] = field(default_factory=dict)
    time: str | None = None
    about: Mapping[str, str] = field(default_factory=dict)
    in_other_files: Sequence[str] = ()
