"""`rtloop import`: what was asked for on the command line and in the mapping beside the data, done to one file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rtloop.interchange.columns import ColumnSelection, find_mapping, read_mapping
from rtloop.interchange.importing import import_data, list_columns
from rtloop.interchange.isolated_reader import read_table
from rtloop.interchange.sampling import is_from_recording


class Shown(dict[str, Any]):
    """What is in a file of which nothing was asked for."""


def import_file(
    file: Path, given: ColumnSelection, mapping: Path | None, output: Path | None, progress: Callable[[int], None]
) -> dict[str, Any]:
    """What was written, by options and mapping, of which options go first; or else what is in the file, `Shown`.

    Raises what reading and writing do, and ConfigError for a mapping that is wrong.
    """
    beside = mapping or (None if given else find_mapping(file))
    wanted = given if beside is None else _both(given, read_mapping(beside))
    table = read_table(file, wanted.group)
    if not wanted and not is_from_recording(table):
        return Shown(list_columns(file, table, wanted))
    report = import_data(file, wanted, output, table=table, progress=progress)
    return report | {"mapping": None if beside is None else str(beside)}


def _both(given: ColumnSelection, kept: ColumnSelection) -> ColumnSelection:
    """What a mapping's file says, but for what is given."""
    by_hand = given.time is not None or given.rate_hz is not None
    return ColumnSelection(
        signals={**kept.signals, **given.signals},
        keep=(*kept.keep, *given.keep),
        all=kept.all or given.all,
        time=given.time if by_hand else kept.time,
        rate_hz=given.rate_hz if by_hand else kept.rate_hz,
        group=given.group or kept.group,
    )
