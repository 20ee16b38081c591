"""Attributes that change the meaning of stored numbers: the CF conventions, and the axes of a scope's waveforms.

CF: value = scale_factor · code + add_offset; _FillValue and missing_value mark missing codes, valid_range, valid_min
and valid_max bound the valid ones (CF conventions 1.11, sections 2.5.1 and 8.1). A scope: value = YOrg + YInc · code.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.interchange.formats.groups import FileColumns

UNIT_ATTRIBUTES = ("unit", "units", "Unit", "Units", "YUnits", "unit_string", "NI_UnitDescription")
SCALES = (("scale_factor", "add_offset"), ("YInc", "YOrg"), ("YIncrement", "YOrigin"), ("yincrement", "yorigin"))
"""Attributes of a factor and an offset."""
SAMPLE_PERIODS = ("XInc", "XIncrement", "xincrement", "wf_increment")
SCOPE_ATTRIBUTES = frozenset(["YUnits", *SAMPLE_PERIODS, *(key for pair in SCALES[1:] for key in pair)])


def unpack(columns: FileColumns, name: str, values: npt.NDArray[Any], attributes: Mapping[str, object]) -> None:
    """Add an array to `columns`, as its attributes say; a note tells what they changed.

    A scope's factor counts for whole numbers alone: numbers with fractions are in the unit already.
    """
    plain = {key: _plain(value) for key, value in attributes.items()}
    unit = next((str(plain[key]) for key in UNIT_ATTRIBUTES if isinstance(plain.get(key), str)), None)
    for key in SAMPLE_PERIODS:
        if isinstance(plain.get(key), float | int) and plain[key]:
            columns.single[f"{name}/{key}"] = plain[key]
    for key, value in plain.items():
        if isinstance(value, float | int) and not isinstance(value, bool) and key not in SAMPLE_PERIODS:
            columns.single.setdefault(f"{name}/{key}", value)
    if np.asarray(values).dtype.kind not in "fiu":
        columns.add_column(name, values, unit)
        return
    numbers, changes = np.asarray(values), list[str]()
    is_missing = _missing(numbers, plain)
    for factor_key, offset_key in SCALES:
        factor, offset = plain.get(factor_key, 1.0), plain.get(offset_key, 0.0)
        is_scope = factor_key != "scale_factor"
        if not isinstance(factor, float | int) or not isinstance(offset, float | int) or (factor, offset) == (1, 0):
            continue
        if is_scope and numbers.dtype.kind == "f":
            columns.notes.append(f"{name}: {factor_key} {factor:g} is not applied to numbers with fractions")
            continue
        numbers = numbers.astype(np.float64) * float(factor) + float(offset)
        changes.append(f"{factor_key} {factor:g}, {offset_key} {offset:g}")
        break
    if is_missing.any():
        numbers = np.where(is_missing, np.nan, numbers.astype(np.float64))
        changes.append(f"{int(is_missing.sum())} missing")
    if changes:
        columns.notes.append(f"{name}: {', '.join(changes)}, as the file states")
    columns.add_column(name, numbers, unit)


def _missing(codes: npt.NDArray[Any], plain: Mapping[str, object]) -> npt.NDArray[np.bool_]:
    """Return which codes are missing, by the attributes of the CF conventions."""
    missing = np.zeros(codes.shape, bool)
    for key in ("_FillValue", "missing_value"):
        for value in np.atleast_1d(np.asarray(plain.get(key, []))):
            if np.asarray(value).dtype.kind in "fiu":
                missing |= codes == value
    low, high = plain.get("valid_min"), plain.get("valid_max")
    span = plain.get("valid_range")
    if isinstance(span, np.ndarray) and span.size == 2:
        low, high = span.tolist()
    if isinstance(low, float | int):
        missing |= codes < low
    if isinstance(high, float | int):
        missing |= codes > high
    return missing


def _plain(value: object) -> object:
    """Return an attribute as text, number or array."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    array = np.asarray(value)
    if array.dtype.kind == "S" and array.size == 1:
        return array.item().decode("utf-8", "replace")
    return array.item() if array.size == 1 else array
