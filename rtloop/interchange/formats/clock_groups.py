"""Several columns of times in one table: each with the columns behind it, as a group of its own."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.interchange.formats.table import Table
from rtloop.interchange.names import is_counter_name, is_time_name, is_time_unit, name_without_unit, unit_in_name


def split_clocks(table: Table) -> dict[str, Table]:
    """Return the groups of a table by the name of their times; one group where the times belong to all columns.

    Times belong to the columns between them and the next times. A group ends with its last time. Equal times are one
    clock, and times beside each other give no groups.
    """
    names = [*table.columns]
    clocks = [name for name in names if _is_clock(table, name)]
    first = next((name for name in names if name not in clocks and not is_counter_name(name)), None)
    if len(clocks) < 2 or first is None or names.index(first) < names.index(clocks[0]):
        return {clocks[0] if clocks else "": table}
    begins = [names.index(clock) for clock in clocks]
    blocks = [names[begin:end] for begin, end in zip(begins, [*begins[1:], len(names)], strict=True)]
    is_repeated = all(_equal_times(table, clocks[0], clock) for clock in clocks)
    if is_repeated or any(len(block) < 2 for block in blocks):
        return {clocks[0]: table}
    groups = {}
    for clock, block in zip(clocks, blocks, strict=True):
        rows = int(np.flatnonzero(np.isfinite(table.columns[clock]))[-1]) + 1
        own = {name: _own_name(name, table) for name in block}
        groups[clock] = replace(
            table,
            columns={own[name]: np.ascontiguousarray(table.columns[name][:rows]) for name in block},
            units={own[name]: table.units[name] for name in block if name in table.units},
            time=own[clock],
            unnamed=tuple(own[name] for name in block if name in table.unnamed),
            origins={own[name]: table.origins[name] for name in block if name in table.origins},
        )
    return groups


def _own_name(name: str, table: Table) -> str:
    """Return a name without the number that made it unique in the whole table."""
    plain = re.sub(r" \(\d+\)$", "", name)
    return plain if plain in table.columns else name


def _is_clock(table: Table, name: str) -> bool:
    unit = table.units.get(name) or unit_in_name(name)
    if not (is_time_unit(unit) or (not unit and is_time_name(name_without_unit(_own_name(name, table))))):
        return False
    times = table.columns[name]
    known = times[np.isfinite(times)]
    is_filled = known.size > 1 and bool(np.all(np.isfinite(times[: known.size])))
    return is_filled and bool(np.all(np.diff(known) >= 0)) and known[-1] > known[0]


def _equal_times(table: Table, first: str, second: str) -> bool:
    """Whether two columns hold the same times, from their first value on."""
    a, b = table.columns[first], table.columns[second]
    return bool(np.array_equal(_from_first(a), _from_first(b), equal_nan=True))


def _from_first(times: Real) -> Real:
    return times - times[0]
