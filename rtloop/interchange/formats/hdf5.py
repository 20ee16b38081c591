"""What an HDF5 file holds: its datasets by path, each object once, or the variables that MATLAB put into it.

Groups may hold themselves, by links or by references; a path is followed to where it comes back.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from rtloop.errors import MissingExtra
from rtloop.interchange.formats.groups import Found
from rtloop.interchange.formats.table import UnreadableData

DEEPEST = 32
OBJECTS_AT_MOST = 100_000
UNITS = ("unit", "units", "Unit", "Units")


@contextmanager
def opened(found: Found) -> Iterator[Any]:
    """The file; what goes wrong in reading it is an UnreadableData. Raises MissingExtra."""
    try:
        import h5py
    except ImportError:
        raise MissingExtra("HDF5, and MAT of version 7.3, need h5py: pip install 'rtloop[data]'") from None
    try:
        with h5py.File(found.path, "r") as file:
            yield file
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as fault:
        raise UnreadableData(f"{found.path}: not an HDF5 file, or damaged ({str(fault)[:200]})") from None


def collect(found: Found) -> None:
    """Put every dataset of numbers into `found`. Raises UnreadableData, MissingExtra."""
    with opened(found) as file:
        datasets: dict[str, Any] = {}
        _collect(found, datasets, file, "", set(), 0)
        for name, dataset in datasets.items():
            found.room(name, dataset.shape)
        for name, dataset in datasets.items():
            _read(found, dataset, name)


def _collect(found: Found, datasets: dict[str, Any], group: Any, path: str, seen: set[Any], depth: int) -> None:
    """The datasets of a group and of those in it, without the text."""
    import h5py

    if depth > DEEPEST or len(seen) > OBJECTS_AT_MOST:
        raise UnreadableData(f"{found.path}: {path}: nested more than {DEEPEST} deep, or of too many objects")
    _see(group, seen)
    for key in group:
        name = f"{path}/{key}".lstrip("/")
        try:
            one = group.get(key)
        except (KeyError, OSError, RuntimeError):
            one = None
        if one is None:
            found.left_out.append(f"{name} (a link that leads nowhere)")
        elif not _see(one, seen):
            found.left_out.append(f"{name} (a link back to what is there already)")
        elif isinstance(one, h5py.Group):
            _collect(found, datasets, one, name, seen, depth + 1)
        elif isinstance(one, h5py.Dataset) and one.shape is not None and one.dtype.kind not in "OSU":
            datasets[name] = one


def _read(found: Found, dataset: Any, name: str) -> None:
    """A dataset of numbers, or the fields of one of records."""
    unit = next((_word(dataset.attrs[key]) for key in UNITS if key in dataset.attrs), None)
    values = dataset[()]
    for field in dataset.dtype.names or ():
        found.add(f"{name}/{field}", values[field])
    if not dataset.dtype.names:
        found.add(name, values, unit)


def _see(one: Any, seen: set[Any]) -> bool:
    """Whether an object is met for the first time."""
    import h5py

    info = h5py.h5o.get_info(one.id)  # type: ignore[attr-defined]
    place = (info.fileno, info.addr)
    new = place not in seen
    seen.add(place)
    return new


def _word(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def matlab_variables(found: Found) -> dict[str, Any]:
    """Variables of a MAT file of version 7.3: structures as dicts, arrays as MATLAB shows them, text as str."""
    with opened(found) as file:
        return {key: _value(found, file, file[key], key, 0) for key in file if not key.startswith("#")}


def _value(found: Found, file: Any, one: Any, name: str, depth: int) -> Any:
    import h5py

    if depth > DEEPEST:
        raise UnreadableData(f"{found.path}: {name}: nested more than {DEEPEST} deep: a reference leads back to itself")
    if isinstance(one, h5py.Group):
        fields = {key: _value(found, file, one[key], f"{name}/{key}", depth + 1) for key in one}
        lengths = {len(field) for field in fields.values() if isinstance(field, list)}
        if fields and len(lengths) == 1 and all(isinstance(field, list) for field in fields.values()):
            return [dict(zip(fields, values, strict=True)) for values in zip(*fields.values(), strict=True)]
        return fields
    kind = _word(one.attrs.get("MATLAB_class", b"double"))
    if "MATLAB_empty" in one.attrs or one.shape is None:
        return "" if kind == "char" else np.empty(0)
    found.room(name, one.shape)
    values = one[()]
    if one.dtype == h5py.ref_dtype:
        return [
            _value(found, file, file[place], f"{name}({k})", depth + 1) for k, place in enumerate(values.T.ravel(), 1)
        ]
    if kind == "char":
        return "".join(map(chr, values.T.ravel()))
    return np.squeeze(values.T)
