"""What is read of another program's file, before anybody says what its columns mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rtloop.errors import RtloopError
from rtloop.foundation.arrays import Real

MAX_ROWS = 1 << 28
"""Rows of one table; beyond them a file is cut with the program that wrote it, rather than read into all the memory."""


class UnreadableData(RtloopError):
    """A file of another program that cannot be taken; the message names it, what is wrong, what is possible."""

    exit_code = 1


class UnopenedData(UnreadableData):
    """A file that is not there, or that the system does not let be read."""

    exit_code = 66


@dataclass(frozen=True)
class Table:
    """Named columns of a file, each float64 of shape (rows,), that were sampled together.

    `units` as the file writes them, by column, where it does; `time` is the column that the file itself calls its time.
    `about` is what else the file says of itself, for people; `in_other_files` names what it only points to, with the
    reason: that is never read.
    """

    columns: Mapping[str, Real]
    units: Mapping[str, str] = field(default_factory=dict)
    time: str | None = None
    about: Mapping[str, str] = field(default_factory=dict)
    in_other_files: Sequence[str] = ()
