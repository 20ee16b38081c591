"""Content of an HDF5 file: its datasets by path, each object once, or the variables that MATLAB stored in it.

Groups may hold themselves, by links or by references; a path is followed until it comes back. Links are followed here,
one name at a time, and never by the library: a link into another file, external storage and a virtual dataset would
bring in data of some other file of the user. They are left out, and named.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from rtloop.errors import MissingExtra
from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.groups import FileColumns
from rtloop.interchange.formats.scaling import SCOPE_ATTRIBUTES, unpack
from rtloop.interchange.formats.table import UnreadableData
from rtloop.interchange.hdf5_signals import descriptor_path

if TYPE_CHECKING:
    import h5py

MAX_DEPTH = 32
MAX_OBJECTS = 100_000
CONTROL = r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]"
"""Characters of a name that control a terminal, or that it cannot show."""
MATLAB_OBJECTS = "#subsystem#"
"""Group of the contents of MATLAB's objects."""
MATLAB_NUMBERS = (
    "double", "single", "logical", "char", "cell", "struct", "int8", "uint8", "int16", "uint16", "int32", "uint32",
    "int64", "uint64",
)  # fmt: skip
"""Classes of MATLAB whose arrays are what they seem."""


@contextmanager
def open_hdf5(columns: FileColumns) -> Iterator[Any]:
    """Open the file `columns.path` for reading; yield the h5py.File.

    An OSError, KeyError, ValueError, RuntimeError or TypeError of opening or in the block, as the library raises them
    for a damaged file, becomes UnreadableData. Raises MissingExtra without h5py.
    """
    try:
        import h5py
    except ImportError:
        raise MissingExtra("HDF5, and MAT of version 7.3, need h5py: pip install 'rtloop[data]'") from None
    try:
        with os.fdopen(open_user_file(columns.path), "rb") as opened, h5py.File(descriptor_path(opened), "r") as file:
            yield file
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as fault:
        raise UnreadableData(f"{columns.path}: not an HDF5 file, or damaged ({str(fault)[:200]})") from None


def collect_datasets(columns: FileColumns) -> None:
    """Add every dataset of numbers in the file to `columns`.

    Raises UnreadableData if the file is no HDF5 file, damaged, nested too deeply or too large; MissingExtra without
    h5py.
    """
    with open_hdf5(columns) as file:
        datasets: dict[str, h5py.Dataset] = {}
        _collect_group(columns, datasets, file, "", set(), 0)
        for name, dataset in datasets.items():
            columns.require_room(name, dataset.shape)
        for key, value in file.attrs.items():
            columns.single[key] = value
        for name, dataset in datasets.items():
            _read_dataset(columns, dataset, name)


def _collect_group(
    columns: FileColumns,
    datasets: dict[str, h5py.Dataset],
    group: Any,
    path: str,
    visited: set[tuple[int, int]],
    depth: int,
) -> None:
    """Add the datasets of a group and of the groups in it, except text, to `datasets`, by path.

    `visited` holds the objects that were met already, and grows. Links to such objects and links without a target are
    listed in `columns.left_out`, data in other files in `columns.in_other_files`. Raises UnreadableData for groups
    nested too deeply, and for too many objects.
    """
    import h5py

    if depth > MAX_DEPTH or len(visited) > MAX_OBJECTS:
        raise UnreadableData(
            f"{columns.path}: {path}: nested too deeply, or too many objects; allowed: up to {MAX_DEPTH} levels "
            f"and {MAX_OBJECTS} objects"
        )
    _visit(group, visited)
    for key in group:
        is_octave = key == "value" and "OCTAVE_NEW_FORMAT" in group.attrs
        name = path if is_octave else f"{path}/{key}".lstrip("/")
        if name == MATLAB_OBJECTS:
            continue
        member = _resolve_member(columns, group, key, name)
        if member is None:
            continue
        if not _visit(member, visited):
            columns.left_out.append(f"{name} (a link to an object that is already included)")
        elif isinstance(member, h5py.Group):
            _collect_group(columns, datasets, member, name, visited, depth + 1)
        elif (
            isinstance(member, h5py.Dataset)
            and not _is_in_other_files(columns, member, name)
            and member.shape is not None
            and member.dtype.kind not in "OSU"
        ):
            datasets[name] = member


def _resolve_member(columns: FileColumns, group: h5py.Group, key: str, name: str) -> h5py.HLObject | None:
    """Return the object of a group under `key`; None for a link into another file or without a target.

    A link into another file is listed as `name` in `columns.in_other_files`, one without a target in
    `columns.left_out`.
    """
    try:
        return _resolve_path(group, key, MAX_DEPTH)
    except _OtherFileLink:
        _report_other_file(columns, name, "a link into another file")
    except (KeyError, OSError, RuntimeError):
        columns.left_out.append(f"{name} (a link without a target)")
    return None


def _resolve_path(group: h5py.Group, path: str, links: int) -> h5py.HLObject:
    """Return the object at a path, reached by hard links and at most `links` nested soft links.

    Raises _OtherFileLink if the path leads into another file, KeyError if a link has no target or more are nested.
    """
    import h5py

    h5l = h5py.h5l  # type: ignore[attr-defined]
    member = group.file["/"] if path.startswith("/") else group
    for part in filter(lambda part: part not in ("", "."), path.split("/")):
        if not isinstance(member, h5py.Group):
            raise KeyError(part)
        key = part.encode("utf-8", "surrogateescape")
        kind = member.id.links.get_info(key).type
        if kind == h5l.TYPE_HARD:
            member = member[part]
        elif kind == h5l.TYPE_SOFT and links > 0:
            member = _resolve_path(member, member.id.links.get_val(key).decode("utf-8", "surrogateescape"), links - 1)
        elif kind == h5l.TYPE_SOFT:
            raise KeyError(part)
        else:
            raise _OtherFileLink(part)
    return member


def _is_in_other_files(columns: FileColumns, dataset: h5py.Dataset, name: str) -> bool:
    """Whether a dataset is virtual, or stores its values in other files; `in_other_files` then lists it as `name`."""
    import h5py

    creation = dataset.id.get_create_plist()
    if creation.get_layout() == h5py.h5d.VIRTUAL:
        _report_other_file(columns, name, "a virtual dataset, composed of other datasets")
    elif creation.get_external_count():
        _report_other_file(columns, name, "values stored in another file")
    else:
        return False
    return True


def _report_other_file(columns: FileColumns, name: str, reason: str) -> None:
    """List an object as `name`, without control characters, in `in_other_files`, with the reason."""
    columns.in_other_files.append(f"{re.sub(CONTROL, ' ', name)} ({reason})")


class _OtherFileLink(Exception):
    """Error of a path that leaves the file."""


def _read_dataset(columns: FileColumns, dataset: h5py.Dataset, name: str) -> None:
    """Add a dataset of numbers, by its attributes, to `columns`; a dataset of records adds its fields, without units.

    A scope's attributes may stand at its group. A MATLAB object is listed as left out.
    """
    attributes = {key: value for key, value in dataset.parent.attrs.items() if key in SCOPE_ATTRIBUTES} | dict(
        dataset.attrs
    )
    if is_matlab_object(dataset):
        columns.left_out.append(f"{name} (a MATLAB object, {_as_text(attributes['MATLAB_class'])})")
        return
    values = dataset[()]
    for field in dataset.dtype.names or ():
        columns.add_column(f"{name}/{field}", values[field])
    if not dataset.dtype.names:
        unpack(columns, name, values, attributes)


def is_matlab_object(dataset: h5py.Dataset) -> bool:
    """Whether a dataset is the marker of an object that MATLAB alone can read."""
    kind = _as_text(dataset.attrs.get("MATLAB_class", b"double"))
    return "MATLAB_object_decode" in dataset.attrs or (kind not in MATLAB_NUMBERS and "MATLAB_class" in dataset.attrs)


def _visit(member: h5py.HLObject, visited: set[tuple[int, int]]) -> bool:
    """Record an object as visited; return whether it was new."""
    import h5py

    info = h5py.h5o.get_info(member.id)  # type: ignore[attr-defined]
    address = (info.fileno, info.addr)
    is_new = address not in visited
    visited.add(address)
    return is_new


def _as_text(value: object) -> str:
    """Return a value as text: bytes are decoded as UTF-8, invalid ones replaced, any other value is passed to `str`."""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def matlab_variables(columns: FileColumns) -> dict[str, object]:
    """Return variables of a MAT file of version 7.3 by name: structures as dicts, arrays as in MATLAB, text as str.

    Raises UnreadableData if the file is damaged, nested too deeply or too large; MissingExtra without h5py.
    """
    with open_hdf5(columns) as file:
        return _group_values(columns, file, {key: key for key in file if not key.startswith("#")}, file, 0)


def _group_values(
    columns: FileColumns, file: h5py.File, names: dict[str, str], group: h5py.Group, depth: int
) -> dict[str, Any]:
    """Return the values of a group's members by key, each as `_member_value` returns it.

    `names` has the full name of each key to read; `depth` is the number of groups above. Links into other files or
    without a target are left out. Raises UnreadableData for members nested too deeply, and beyond the memory limit.
    """
    members = {key: _resolve_member(columns, group, key, name) for key, name in names.items()}
    return {
        key: _member_value(columns, file, member, names[key], depth)
        for key, member in members.items()
        if member is not None
    }


def _member_value(columns: FileColumns, file: h5py.File, member: Any, name: str, depth: int) -> object:
    """Return a structure as dict, a structure array as list of dicts, text as str, numbers as an array.

    An array of object references, such as a cell array, is a list of the values that they refer to, in MATLAB's order.
    A named type, an empty array and values in other files are an empty array, an empty text is "". Raises
    UnreadableData for members nested too deeply, and beyond the memory limit.
    """
    import h5py

    if depth > MAX_DEPTH:
        raise UnreadableData(
            f"{columns.path}: {name}: nested too deeply, or a reference to itself; allowed: up to {MAX_DEPTH} levels"
        )
    if isinstance(member, h5py.Group):
        fields = _group_values(columns, file, {str(key): f"{name}/{key}" for key in member}, member, depth + 1)
        lengths = {len(field) for field in fields.values() if isinstance(field, list)}
        if fields and len(lengths) == 1 and all(isinstance(field, list) for field in fields.values()):
            return [dict(zip(fields, values, strict=True)) for values in zip(*fields.values(), strict=True)]
        return fields
    if not isinstance(member, h5py.Dataset) or _is_in_other_files(columns, member, name):
        return np.empty(0)
    if is_matlab_object(member):
        columns.left_out.append(f"{name} (a MATLAB object, {_as_text(member.attrs['MATLAB_class'])})")
        return ""
    kind = _as_text(member.attrs.get("MATLAB_class", b"double"))
    if "MATLAB_empty" in member.attrs or member.shape is None:
        return "" if kind == "char" else np.empty(0)
    columns.require_room(name, member.shape)
    values = member[()]
    if member.dtype == h5py.ref_dtype:
        return [
            _member_value(columns, file, file[place], f"{name}({k})", depth + 1)
            for k, place in enumerate(values.T.ravel(), 1)
        ]
    if kind == "char":
        return "".join(map(chr, values.T.ravel()))
    return np.squeeze(values.T)
