"""The law that a table of a configuration names, and its options by that law's own model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, SerializeAsAny, ValidationError, ValidationInfo
from pydantic_core import PydanticCustomError

from rtloop.configuration.text_files import InputFileError, read_text
from rtloop.kernel.layout import MAX_COUPLED
from rtloop.laws.contract import ANY_NUMBER, Controller, CoupledController, Feedforward, Law
from rtloop.laws.helpers import read_helpers
from rtloop.laws.options import ControllerOptions, FeedforwardOptions
from rtloop.laws.registry import BUILT_IN, LawReference, find_law, kinds, law_class, law_from_text

FEEDFORWARD, CONTROLLER = "prandtl_ishlinskii", "transfer"
"""Laws of a table that names none."""
DEFAULT_LAWS = (LawReference(FEEDFORWARD), LawReference(CONTROLLER))
"""Laws that every loop loads. An axis without a controller has the last one, with coefficients and command of 0."""


@dataclass(frozen=True)
class Library:
    """Sources of laws: shipped and installed ones, and files, whose relative paths start at `folder`.

    For a running loop, the laws that it has `loaded` are the only source.
    """

    folder: Path = Path()
    loaded: tuple[LawReference, ...] | None = None

    def find(self, named: Mapping[str, Any], default: str) -> LawReference:
        """Return the law that a table names by `kind`, `file` or neither.

        `kind` beside `file` picks a law within the file. `default` is the kind where neither is named. Raises
        ValueError for a wrong type, an unreadable file, and a law that is missing, invalid, or not loaded by a running
        loop.
        """
        kind, file = named.get("kind") or None, named.get("file")
        for value, key in ((kind, "kind"), (file, "file")):
            if value is not None and not isinstance(value, str):
                raise ValueError(f"{key}: {value!r}; allowed: a name, as a string")
        path = str(self.folder / file) if file else ""
        if self.loaded is None:
            if not file:
                return find_law(kind or default)
            text = _text(Path(path))
            return law_from_text(text, path, kind, read_helpers(text, path))
        loaded = dict.fromkeys(replace(law, axes=0) for law in self.loaded)
        matches = [law for law in loaded if (law.file == path if file else law.kind == (kind or default))]
        matches = [law for law in matches if kind is None or law.kind == kind]
        if not matches:
            loaded_kinds = ", ".join(law.kind for law in loaded)
            raise ValueError(
                f"law {file or kind or default!r} is not loaded in the running loop; loaded: {loaded_kinds}. "
                "To use it, add it to [loop] laws and restart the service"
            )
        if len(matches) > 1:
            choices = ", ".join(law.kind for law in matches)
            raise ValueError(
                f"kind: missing; {file or default!r} matches several laws that are loaded in the running loop; set "
                f"kind to one of {choices}"
            )
        return matches[0]


def names_own_laws(raw: Mapping[str, object]) -> bool:
    """Whether a configuration's plain values name a law that is not shipped: a file, or an installed kind."""
    axes, loop = raw.get("axis"), raw.get("loop")
    tables = [table for axis in (axes if isinstance(axes, list) else ()) if isinstance(axis, Mapping)
              for table in (axis.get("feedforward"), axis.get("controller")) if isinstance(table, Mapping)]  # fmt: skip
    spare_laws = loop.get("laws") if isinstance(loop, Mapping) else None
    names = [*(table.get("kind") for table in tables), *(spare_laws if isinstance(spare_laws, list) else ())]
    unshipped = {name for name in names if isinstance(name, str)} - BUILT_IN.keys()
    return (
        any(table.get("file") for table in tables)
        or any(name.endswith(".py") for name in unshipped)
        or not unshipped.isdisjoint(kinds() if unshipped else ())
    )


HERE = Library()


def _text(path: Path) -> str:
    """Return a file's text. Raises ValueError if it cannot be read or is no text."""
    try:
        return read_text(path)
    except InputFileError as error:
        raise ValueError(str(error)) from None


def select_options(value: object, info: ValidationInfo, base: type[Law], default: str) -> object:
    """Return a table as options of the law that it names, bound to this law; a value that is no table unchanged.

    Raises ValueError for a law that is missing, is no subclass of `base`, does not allow so many axes, or is not loaded
    by the running loop; ValidationError for wrong options, with one fault more where the table names no law and has
    no or unknown keys.
    """
    if not isinstance(value, Mapping):
        return value
    library = (info.context or {}).get("library", HERE)
    law = library.find(value, default)
    law_type = law_class(law)
    if not issubclass(law_type, base):
        raise ValueError(f"law {law.kind!r} is not a {base.__name__.lower()}; allowed: {_shipped_kinds(base)}")
    try:
        options = law_type.options_model.model_validate(dict(value), context=info.context)
    except ValidationError as error:
        keys = sorted(law_type.options_model.model_fields)
        unknown = PydanticCustomError("extra_forbidden", "unknown key", {"keys": keys})
        faults: list[Any] = [
            fault | {"type": unknown} if fault["type"] == "extra_forbidden" else fault for fault in error.errors()
        ]
        is_of_another_law = not value or any(fault["type"] is unknown for fault in faults)
        if is_of_another_law and not (value.get("kind") or value.get("file")):
            message = f"kind: missing, which means {default!r}; allowed: {_shipped_kinds(base)}"
            faults.append({"type": "value_error", "ctx": {"error": message}, "input": value})
        raise ValidationError.from_exception_data(error.title, faults) from None
    law = replace(law, axes=_axes(law, law_type, options))
    if library.loaded is not None and law not in library.loaded:
        raise ValueError(
            f"law {law.kind!r} for {law.axes} axes is not loaded in the running loop. To use it, restart the "
            "service with a configuration in which it controls these axes"
        )
    options.bind(law)
    return options


def _shipped_kinds(base: type[Law]) -> str:
    """Return the kinds of the shipped laws that are subclasses of `base`, and the key for another law, as text."""
    shipped = [kind for kind in BUILT_IN if issubclass(law_class(LawReference(kind)), base)]
    return ", ".join([*shipped, "an installed law, or a file with file = …"])


def _axes(law: LawReference, kind: type[Law], options: Any) -> int:
    """Return the number of axes in `options` for a law whose class leaves this number open; 0 for any other law.

    Raises ValueError for a number that the law does not allow.
    """
    if not issubclass(kind, Controller):
        return 0
    count = len(options.axes)
    if not issubclass(kind, CoupledController):
        if count > 1:
            raise ValueError(f"axes: {count} axes; allowed for law {law.kind!r}: 1")
        return 0
    minimum, maximum = (2, MAX_COUPLED) if kind.axes == ANY_NUMBER else (kind.axes, kind.axes)
    if not minimum <= count <= maximum:
        allowed = f"{minimum} to {maximum}" if minimum < maximum else f"{minimum}"
        raise ValueError(f"axes: {count} axes; allowed for law {law.kind!r}: {allowed}")
    return count if kind.axes == ANY_NUMBER else 0


def _controller(value: object, info: ValidationInfo) -> object:
    """Return a table [axis.controller] as options of its law, as `select_options`."""
    return select_options(value, info, Controller, CONTROLLER)


def _feedforward(value: object, info: ValidationInfo) -> object:
    """Return a table [axis.feedforward] as options of its law, as `select_options`."""
    return select_options(value, info, Feedforward, FEEDFORWARD)


ControllerTable = Annotated[SerializeAsAny[ControllerOptions], BeforeValidator(_controller)]
FeedforwardTable = Annotated[SerializeAsAny[FeedforwardOptions], BeforeValidator(_feedforward)]
