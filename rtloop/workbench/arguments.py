"""Arguments of the functions: files, recordings, numbers and choices, each refused with RtloopError.

`argument` names the function and its argument, for the message.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtloop.errors import RtloopError
from rtloop.recording.load import Recording

if TYPE_CHECKING:
    from rtloop.configuration.file import Configuration

FileName = str | Path
"""The name of a file."""


def as_path(value: object, argument: str) -> Path:
    """Return a file's name as a path. Raises RtloopError, which begins with `argument`, for a value that is no text or
    Path, is empty or contains a NUL character.
    """
    if not isinstance(value, str | Path) or "\0" in str(value) or not str(value):
        raise RtloopError(f"{argument}: value is {value!r}; allowed: the name of a file")
    return Path(value)


def as_paths(value: object, argument: str) -> list[Path]:
    """Return one file's name, or a sequence of names, as a list of paths; [] for an empty sequence.

    Raises RtloopError, which begins with `argument`, for other values.
    """
    if isinstance(value, str | Path):
        return [as_path(value, argument)]
    if not isinstance(value, Sequence) or isinstance(value, bytes):
        raise RtloopError(f"{argument}: value is {value!r}; allowed: the name of a file, or a list of names")
    return [as_path(item, argument) for item in value]


def load_configuration(configuration: FileName | Configuration, argument: str) -> Configuration:
    """Return a configuration, read from its file if `configuration` is a name.

    `argument` is the name of the calling function, for messages. Raises InputFileError for a file that cannot be read,
    ConfigError with all faults of its contents, RtloopError for a value that is neither a configuration nor a name.
    """
    from rtloop.configuration.file import Configuration, load

    if isinstance(configuration, Configuration):
        return configuration
    return load(as_path(configuration, f"{argument}: configuration"))


def recording_paths(value: object, argument: str) -> list[Path]:
    """Return the files of a recording: of a loaded one, or of the name or names of its files.

    Raises RtloopError, which begins with `argument`, for another value, for an empty list, and for a part of a
    recording by time.
    """
    if isinstance(value, Recording):
        if value.is_part:
            raise RtloopError(
                f"{argument}: value is {value!r}; allowed: a whole recording. To use a part, "
                "write this part to a file with `rtloop cut`"
            )
        return list(value.paths)
    if not (paths := as_paths(value, argument)):
        raise RtloopError(f"{argument}: value is {value!r}; allowed: a recording, or the names of its files")
    return paths


def single_files(value: object, argument: str) -> list[Path]:
    """Return the one file of each recording in `value`: a recording, the name of its file, or a list of these.

    Raises RtloopError, which begins with `argument`, for another value, an empty list, a part of a recording, and a
    recording of several files.
    """
    items = [value] if isinstance(value, str | Path | Recording) else value
    if not isinstance(items, Sequence) or isinstance(items, bytes) or not items:
        raise RtloopError(f"{argument}: value is {value!r}; allowed: a recording, or a list of one or more recordings")
    paths = []
    for item in items:
        files = recording_paths(item, argument)
        if len(files) > 1:
            raise RtloopError(
                f"{argument}: value is {item!r}; allowed: recordings of one file each. "
                "`rtloop cut` joins the files of a recording"
            )
        paths += files
    return paths


def require_seconds(value: object, argument: str) -> float:
    """Return a finite number of seconds above 0 as float. Raises RtloopError, naming `argument`, for another value."""
    if not isinstance(value, Real) or isinstance(value, bool) or not 0 < float(value) < math.inf:
        raise RtloopError(f"{argument}: value is {value!r}; allowed: a finite number of seconds above 0")
    return float(value)


def require_count(value: object, argument: str, least: int, largest: int | None = None) -> None:
    """Raise RtloopError, naming `argument`, unless `value` is a whole number from `least` to `largest`, both included.

    `largest` None: there is no largest one.
    """
    count = int(value) if isinstance(value, Integral) and not isinstance(value, bool) else None
    if count is None or count < least or (largest is not None and count > largest):
        allowed = f"from {least} on" if largest is None else f"{least} to {largest}"
        raise RtloopError(f"{argument}: value is {value!r}; allowed: a whole number, {allowed}")


def require_numbers(value: Any, argument: str) -> list[float]:
    """Return a sequence of finite numbers as a list of floats, an empty one as [].

    Raises RtloopError, naming `argument`, for any other value, None and a single number too.
    """
    try:
        numbers = [math.nan] if isinstance(value, str | bytes) else [float(number) for number in value]
    except (TypeError, ValueError):
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise RtloopError(f"{argument}: value is {value!r}; allowed: a list of finite numbers")
    return numbers


def require_names(value: object, argument: str) -> list[str]:
    """Return one name, or a list or tuple of names, as a list. Raises RtloopError, naming `argument`, for others."""
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise RtloopError(f"{argument}: value is {value!r}; allowed: a name, or a list of names")
    return list(names)


def require_choice(value: object, argument: str, allowed: Sequence[str]) -> None:
    """Raise RtloopError, naming `argument`, for a value that is not one of `allowed`."""
    if value not in allowed:
        raise RtloopError(f"{argument}: value is {value!r}; allowed: {', '.join(map(repr, allowed))}")
